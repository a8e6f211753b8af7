"""Scenes: what is asked of a picture, as records and text without arrays."""
