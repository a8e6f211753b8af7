"""Counters of the work for a picture, the same for every marcher, by name and as text."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

__all__ = ["COUNTERS", "complete", "rows"]

COUNTERS: Mapping[str, str] = MappingProxyType(
    {
        "rays": "that meet the volume",
        "passes": "of samples; for packets, those of each packet",
        "samples": "values looked up along rays",
        "evaluations": "of the model itself: a network, or a lattice without a cache",
        "gradients": "at lit samples and surfaces",
        "secondary_rays": "towards light and surroundings",
        "skipped_bricks": "places where rays leapt over what cannot be seen",
        "decoded_vertices": "of the decoded frame, kept ones included",
    }
)
"""Names of the counters and what they count."""


def complete(*parts: Mapping[str, int]) -> dict[str, int]:
    """Sums of counters in the order of COUNTERS, 0 where none is given.

    Raises KeyError for a name that is not among COUNTERS.
    """
    total = dict.fromkeys(COUNTERS, 0)
    for part in parts:
        for name, count in part.items():
            total[name] += int(count)
    return total


def rows(counters: Mapping[str, int]) -> list[tuple[str, str, str]]:
    """Rows (name, count, what it counts) for people to read."""
    return [
        (name.replace("_", " "), f"{counters.get(name, 0):,}", text)
        for name, text in COUNTERS.items()
    ]
