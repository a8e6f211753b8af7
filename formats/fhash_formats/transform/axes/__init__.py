"""The transform along each axis of a tile, and the bands of its coefficients."""
