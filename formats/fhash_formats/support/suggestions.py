"""The nearest of several names, for messages about a name that is unknown."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

LIKENESS = 0.6
"""Likeness of two names, 0 to 1, from which on one may stand for the other by mistake."""


def suggestion(name: str, allowed: Iterable[str]) -> str:
    """A clause that names what was probably meant, or else all that is allowed."""
    names = list(allowed)
    near = difflib.get_close_matches(name[:100], names, n=1, cutoff=LIKENESS)
    return f"did you mean '{near[0]}'?" if near else f"known: {', '.join(names)}"
