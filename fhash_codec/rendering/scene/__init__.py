"""What is asked of a picture, as records and text. No arrays."""
