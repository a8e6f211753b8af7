"""Several pictures: animations, evolutions and tracked features."""
