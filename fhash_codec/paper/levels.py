"""Resolutions of the levels, by integer arithmetic only (paper, sections 3.2.1 and 3.2.2)."""

from __future__ import annotations

from collections.abc import Sequence
from math import prod

Resolution = tuple[int, int, int, int]
"""Vertices per axis of one level, (t, z, y, x)."""


def ceil_log(n: int, base: int) -> int:
    """Return the smallest L with base**L >= n, for n >= 1 and base >= 2 (paper, equation 5).

    The result is exact. A floating-point logarithm is not, for example for n = 216 and base = 6.
    """
    exponent, power = 0, 1
    while power < n:
        power *= base
        exponent += 1
    return exponent


def axis_resolutions(size: int, fold: int, levels: int) -> list[int]:
    """Return the vertices of one axis at each level, finest first (paper, equations 4, 7 and 8).

    Each level divides the one before by `fold`, rounding up, down to a tail of levels with 2
    vertices. An axis of a single vertex has 1 at every level.
    """
    if size == 1:
        return [1] * levels
    resolutions = [size]
    while len(resolutions) < levels:
        previous = resolutions[-1]
        resolutions.append(-(-previous // fold) if previous > fold else 2)
    return resolutions


def level_resolutions(box: Sequence[int], key_frames: int, fold: int) -> tuple[Resolution, ...]:
    """Return the resolution of each level, finest first.

    The number of levels is the largest ceil(log_fold S) over the three spatial axes (paper,
    equations 5 and 6), and at least 1. Time follows the same rule as the spatial axes, from the
    number of key frames (paper, section 3.2.2).

    Args:
        box: vertices (z, y, x) of the feature bounding box.
        key_frames: number of key frames.
        fold: ratio between neighbouring levels, at least 2.
    """
    levels = max(1, *(ceil_log(size, fold) for size in box))
    columns = [axis_resolutions(size, fold, levels) for size in (key_frames, *box)]
    return tuple(zip(*columns, strict=True))


def parameter_count(levels: Sequence[Resolution], embedding_size: int) -> int:
    """Return the number of trained numbers in the tables of all levels, without the network."""
    return embedding_size * sum(prod(level) for level in levels)
