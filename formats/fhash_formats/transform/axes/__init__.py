"""The transform along each axis, and the bands that it leaves."""
