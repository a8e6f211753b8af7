"""Integers and masks to bytes, and back."""
