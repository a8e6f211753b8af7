"""Transforms element by element: quantising and comparing."""
