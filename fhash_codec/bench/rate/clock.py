"""Times of work: on the wall, and of the processor in user mode, children included."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass

__all__ = ["Spent", "spent", "user_seconds"]

LEAST = 1e-6
"""Seconds that work takes at least, so that a rate of it is finite."""


@dataclass(frozen=True, kw_only=True)
class Spent:
    """Seconds of some work.

    Attributes:
        wall: from its beginning to its end.
        core: of all cores in user mode, together, those of programs that it ran included.
    """

    wall: float
    core: float


def spent(work: Callable[[], object]) -> Spent:
    """Do some work and return the seconds that it took."""
    wall, core = time.perf_counter(), user_seconds()
    work()
    return Spent(
        wall=max(LEAST, time.perf_counter() - wall), core=max(LEAST, user_seconds() - core)
    )


def user_seconds() -> float:
    """Seconds in user mode of this process and of the programs that it ran, so far."""
    try:
        import resource
    except ImportError:  # only Unix has it
        times = os.times()
        return times.user + times.children_user
    kinds = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return sum(resource.getrusage(kind).ru_utime for kind in kinds)
