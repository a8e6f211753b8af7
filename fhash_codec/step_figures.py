"""Figures of single steps in a file (FORMAT.md, Quality): whole hundredths of a dB below the range.

They stand in the header, or of many steps in an array of their own.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from decimal import ROUND_CEILING, Context
from typing import Any

import numpy as np

from fhash_formats.container import ContainerWriter
from fhash_formats.container.header import LOWEST, STEP_BYTES, STEP_FIGURES, STEPS

__all__ = ["read_steps", "write_steps"]

MAX_LISTED = 512
"""Steps whose figures stand in the header; an array of its own takes some 400 bytes."""
HUNDREDTHS = 2000
"""Hundredths of a dB of a factor of ten."""
EXACT = -1
"""Number in place of the decibels of a figure that is 0."""
UNKNOWN = -2
"""Number in place of the decibels of a figure without a finite value."""
DIGITS = 5
"""Significant digits of a figure that comes back from decibels."""


def write_steps(
    writer: ContainerWriter, figures: Mapping[str, Sequence[float | None]], data_range: float
) -> dict[str, list[int]]:
    """Write the figures of all steps, or return what the header's `quality.steps` is.

    Args:
        writer: of the container; it gets an array for more than MAX_LISTED steps.
        figures: one for each step, by the names STEP_FIGURES.
        data_range: width of the header's value range.

    Returns an empty object where there is an array.
    """
    levels = {name: _levels(figures[name], data_range) for name in STEP_FIGURES}
    if len(levels[STEP_FIGURES[0]]) <= MAX_LISTED + 1:
        return levels
    numbers = np.array([listed[1:] for listed in levels.values()]) - UNKNOWN
    planes = np.moveaxis(numbers.astype("<u4").view(np.uint8).reshape(*numbers.shape, 4), -1, 0)
    lowest = [listed[0] for listed in levels.values()]
    writer.add_whole(STEPS, planes[:STEP_BYTES], attributes={LOWEST: lowest})
    return {}


def read_steps(
    header: Mapping[str, Any], arrays: Mapping[str, Any]
) -> list[dict[str, float | None]]:
    """The figures of each step by name, rounded to the worse side; none where the file has none.

    Args:
        header: of a variable.
        arrays: StoredArray by name.
    """
    quality = header["quality"]
    if "steps" in quality:
        lists = [quality["steps"][name] for name in STEP_FIGURES]
    elif STEPS in arrays:
        array = arrays[STEPS]
        weights = 256 ** np.arange(STEP_BYTES)
        numbers = np.tensordot(weights, array.read().astype(np.int64), 1) + UNKNOWN
        pairs = zip(array.attributes[LOWEST], numbers.tolist(), strict=True)
        lists = [[lowest, *levels] for lowest, levels in pairs]
    else:
        return []
    low, high = header["value_range"]
    # Rounding must not pass the largest error of all steps.
    limits = (None, quality.get("max_abs_error"))
    columns = [
        [_figure(first, level, high - low, limit) for level in levels]
        for (first, *levels), limit in zip(lists, limits, strict=True)
    ]
    return [dict(zip(STEP_FIGURES, row, strict=True)) for row in zip(*columns, strict=True)]


def _levels(figures: Sequence[float | None], data_range: float) -> list[int]:
    """The smallest level, then each level counted from it, or EXACT or UNKNOWN."""
    width = _decades(data_range)
    levels: list[int | None] = []
    for figure in figures:
        if figure is not None and 0 < figure < math.inf:
            levels.append(math.floor(HUNDREDTHS * (width - math.log10(figure))))
        else:
            levels.append(None)
    lowest = min((level for level in levels if level is not None), default=0)
    result = [lowest]
    for figure, level in zip(figures, levels, strict=True):
        unlike = EXACT if figure == 0 else UNKNOWN
        result.append(unlike if level is None else level - lowest)
    return result


def _decades(data_range: float) -> float:
    """The decimal logarithm of a range; of the largest float64 for one beyond it."""
    return math.log10(min(data_range or 1.0, sys.float_info.max))


def _figure(lowest: int, level: int, data_range: float, limit: float | None) -> float | None:
    """The figure that is so many hundredths of a dB below a range, rounded up."""
    if level < 0:
        return 0.0 if level == EXACT else None
    exponent = _decades(data_range) - (lowest + level) / HUNDREDTHS
    if not -323 < exponent < 308:
        return None
    value = math.pow(10.0, exponent)
    if limit is not None and value >= limit:
        return float(limit)
    context = Context(prec=DIGITS, rounding=ROUND_CEILING)
    rounded = float(context.create_decimal_from_float(value))
    return rounded if limit is None else min(rounded, float(limit))
