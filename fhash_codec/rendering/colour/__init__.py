"""Colour and opacity of a value."""
