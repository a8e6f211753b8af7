"""Cost of accuracy on a series: seconds and bytes of encodings, reads and pictures."""
