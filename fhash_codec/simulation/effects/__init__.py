"""Effects of a simulated scene, one file each, and the list of them all."""
