"""Several pictures: animations, films and tracked features."""
