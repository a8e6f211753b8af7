"""A series as tiles, and some of the tiles as a sample."""
