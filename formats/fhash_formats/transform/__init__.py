"""The compact profile's arithmetic: transforms of a tile, their coefficients' coding, and back, in numpy or the native library with equal
bits."""
