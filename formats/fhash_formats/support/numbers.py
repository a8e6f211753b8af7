"""Numbers as text."""

from __future__ import annotations

__all__ = ["is_number"]


def is_number(text: str) -> bool:
    """Whether a text is a number as `float` reads it, infinities and NaN included."""
    try:
        float(text)
    except ValueError:
        return False
    return True
