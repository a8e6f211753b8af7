"""A series cut into tiles, a sample of them, and the coding of one tile."""
