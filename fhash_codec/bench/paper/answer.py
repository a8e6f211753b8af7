"""The answer to a claim, and the test of its figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

__all__ = ["CONFIRMED", "NOT_REACHED", "NOT_TESTABLE", "REFUTED", "Answer", "spread", "verdict"]

CONFIRMED = "confirmed"
"""Verdict where the figures bear a claim out."""
REFUTED = "refuted"
"""Verdict where the figures contradict a claim."""
NOT_REACHED = "not reached here"
"""Verdict where the figures neither bear a claim out nor contradict it."""
NOT_TESTABLE = "not testable here"
"""Verdict where the cells hold no figure about a claim."""


@dataclass(frozen=True)
class Answer:
    """A claim, the protocol that it was tested in, the verdict, and the figures."""

    claim: str
    protocol: str
    verdict: str
    figures: str


def verdict(values: Sequence[float], claimed: float, opposite: float) -> str:
    """The verdict on values of which a claim says that they are large; not testable without any.

    Args:
        values: what was measured.
        claimed: the median that confirms the claim, or any larger one.
        opposite: a median below it refutes the claim.
    """
    if not values:
        return NOT_TESTABLE
    middle = median(values)
    return CONFIRMED if middle >= claimed else REFUTED if middle < opposite else NOT_REACHED


def spread(values: Sequence[float], unit: str) -> str:
    """The median of values with the smallest and the largest, three digits; a dash without any."""
    if not values:
        return "-"
    middle, low, high = (f"{value:.3g}" for value in (median(values), min(values), max(values)))
    return f"{middle}{unit}" if low == high else f"{middle}{unit} ({low} to {high})"
