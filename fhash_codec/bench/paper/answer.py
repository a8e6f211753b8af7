"""The answer to a claim, and the test of its figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median

__all__ = ["CONFIRMED", "NOT_TESTABLE", "REFUTED", "Answer", "spread", "verdict"]

CONFIRMED = "confirmed"
"""Verdict where the figures bear a claim out."""
REFUTED = "refuted"
"""Verdict where the figures contradict a claim."""
NOT_TESTABLE = "not testable here"
"""Verdict where the cells hold no figure about a claim."""


@dataclass(frozen=True)
class Answer:
    """A claim, the protocol that it was tested in, the verdict, and the figures."""

    claim: str
    protocol: str
    verdict: str
    figures: str


def verdict(values: Sequence[float], holds: Callable[[Sequence[float]], bool]) -> str:
    """The verdict of a test on values; not testable without any."""
    if not values:
        return NOT_TESTABLE
    return CONFIRMED if holds(values) else REFUTED


def spread(values: Sequence[float], unit: str) -> str:
    """The median of values with the smallest and the largest, three digits; a dash without any."""
    if not values:
        return "-"
    middle, low, high = (f"{value:.3g}" for value in (median(values), min(values), max(values)))
    return f"{middle}{unit}" if low == high else f"{middle}{unit} ({low} to {high})"
