"""Resolutions of the tesseract tables, by integer arithmetic only (paper, Spatial and Temporal Multi-Resolution Configuration)."""

from __future__ import annotations

from collections.abc import Sequence
from math import prod

Resolution = tuple[int, int, int, int]
"""Vertices per axis of one level, (t, z, y, x)."""


def ceil_log(n: int, base: int) -> int:
    """The smallest L with base**L >= n, for n >= 1 and base >= 2; exact, where a floating logarithm is not (216, 6)."""
    exponent, power = 0, 1
    while power < n:
        power *= base
        exponent += 1
    return exponent


def axis_resolutions(size: int, fold: int, levels: int) -> list[int]:
    """Vertices of one axis at each level, finest first: divide by `fold`, rounding up, then pad with 2; a single vertex stays 1."""
    if size == 1:
        return [1] * levels
    column = [size]
    while len(column) < levels:
        last = column[-1]
        column.append(-(-last // fold) if last > fold else 2)
    return column


def level_resolutions(box: Sequence[int], key_frames: int, fold: int) -> tuple[Resolution, ...]:
    """Resolution of each level, finest first, for a feature bounding box (z, y, x) and a number of key frames.

    The number of levels is the largest ceil(log_fold S) over the three spatial axes, and at least 1.
    Time has its own column by the same rule, from the number of key frames.
    """
    levels = max(1, *(ceil_log(size, fold) for size in box))
    columns = [axis_resolutions(size, fold, levels) for size in (key_frames, *box)]
    return tuple(zip(*columns, strict=True))


def parameter_count(levels: Sequence[Resolution], embedding_size: int) -> int:
    """Trained numbers in the tables of all levels (the network not counted)."""
    return embedding_size * sum(prod(level) for level in levels)
