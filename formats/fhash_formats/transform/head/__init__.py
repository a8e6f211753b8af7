"""The trained correction of decoded values."""
