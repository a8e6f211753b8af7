"""Operations on each value of a tile by itself: quantising, comparing, casting."""
