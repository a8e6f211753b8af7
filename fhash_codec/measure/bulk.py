"""The bulk of a series: the range of its middle values, without the 1 % at either end.

Few extreme values can make the range of a series many times as wide as what most of its vertices
show: a PSNR over the whole range then says little of them. The PSNR of the bulk is
20 log10(width of the bulk / RMSE over the vertices whose original value lies in the bulk).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal

import numpy as np
import numpy.typing as npt

from fhash_codec.measure.ranks import Ranks
from fhash_codec.measure.sums import Values, histogram
from fhash_codec.measure.value_range import ValueRange
from fhash_formats.support.number_types import exact_number

__all__ = ["BULK_SHARE", "bulk_of_ranks", "find_bulk", "is_wide", "whole_psnr"]

ONE_IN = 100
"""Values of which one is left out at either end of the bulk."""
BULK_SHARE = 0.98
"""Share of the values that lie in the bulk, at least."""
BINS = 1 << 16
"""Bins of the histogram that the ends of the bulk are found by."""
MIN_BINS = 1 << 10
"""Bins that the bulk must span at least: its width is then known to 0.2 %, or 0.02 dB."""
PASSES = 2
"""Histograms that are made at most, the second of the bins that the first found."""
DIGITS = 3
"""Decimal digits of the width to which both ends are rounded outwards."""
MIN_SHARE = 0.01
"""Share of the range of the series that a wide bulk spans at least."""

Passes = Callable[[], Iterable[Values]]
"""Function that gives all counted values of a series, in arrays of any shape, once a call."""


def find_bulk(passes: Passes, value_range: ValueRange, *, whole: bool = False) -> ValueRange | None:
    """The bulk: the range from the 1st to the 99th percentile of the finite values of a series.

    passes: called once or twice; memory is bounded by one of its arrays.
    value_range: of the series, in data units.
    whole: whether the values are whole numbers, as the ends of the bulk then are.

    Both ends are found to 1/1000 of the width and rounded outwards; the result does not depend on
    the order of the values. None where the bulk has no width, or less than 2^-21 of the range: at
    least 98 % of the values are then the same, or there are none.
    """
    scale = value_range.scale
    low, high = value_range.low * scale, value_range.high * scale
    for _ in range(PASSES):
        width = (high - low) / BINS
        if not 0 < width < math.inf or not math.isfinite(BINS / (high - low)):
            return None
        counts = np.zeros(BINS, np.int64)
        for values in passes():
            histogram(values, counts, scale=scale, low=low, factor=BINS / (high - low))
        first, last = _ends(counts)
        # A thousandth of a bin more than the bins span, for the rounding of the bins themselves.
        low, high = low + (first - 0.001) * width, low + (last + 1.001) * width
        if last + 1 - first >= MIN_BINS or (whole and width < 0.5):
            return _rounded(low / scale, high / scale, value_range, whole=whole)
    return None


def bulk_of_ranks(
    ranks: Ranks, value_range: ValueRange, *, whole: bool = False
) -> ValueRange | None:
    """The bulk of values whose ranks were taken in one pass; arguments as in `find_bulk`.

    At least 98 % of the values lie in it, and at most another 3 errors of `ranks`, which are below
    1/10,000 of the values. The ends are rounded outwards to 1/1000 of the width.
    """
    width = value_range.high - value_range.low
    if not ranks.count or not math.isfinite(width):
        return None
    low, high = ranks.middle((ranks.count - 1) // ONE_IN)
    low, high = max(low, value_range.low), min(high, value_range.high)
    if not high - low >= width / (BINS * BINS / (2 * MIN_BINS)):
        return None
    return _rounded(low, high, value_range, whole=whole)


def is_wide(bulk: ValueRange, value_range: ValueRange) -> bool:
    """Whether a bulk spans at least MIN_SHARE of the range of the series."""
    return bulk.high - bulk.low >= MIN_SHARE * (value_range.high - value_range.low)


def whole_psnr(psnr: float, bulk: ValueRange, data_range: float) -> float:
    """The PSNR (dB) over the range of a series with the same RMSE as a PSNR over its bulk.

    data_range: of the series, in data units, more than 0.
    """
    return psnr + 20 * (math.log10(data_range) - math.log10(bulk.high - bulk.low))


def _ends(counts: npt.NDArray[np.int64]) -> tuple[int, int]:
    """Bins of the 1st and the 99th percentile, by the nearest ranks outside."""
    so_far = np.cumsum(counts)
    total = int(so_far[-1])
    beyond = max(total - 1, 0) // ONE_IN
    ranks = (beyond, max(total - 1, 0) - beyond)
    first, last = np.searchsorted(so_far, ranks, side="right")
    return int(first), min(int(last), BINS - 1)


def _rounded(low: float, high: float, limits: ValueRange, *, whole: bool) -> ValueRange | None:
    """The ends as short decimals, rounded outwards within the limits; whole ones inwards.

    None if no width is left.
    """
    low, high = max(low, limits.low), min(high, limits.high)
    if not 0 < high - low < math.inf:
        return None
    if whole:
        # The ends lie less than one bin outside of the whole numbers that they stand for.
        low, high = math.ceil(low), math.floor(high)
    else:
        exact = Context(prec=700)
        unit = Decimal(1).scaleb(math.floor(math.log10(high - low)) - DIGITS)
        low = float(Decimal(low).quantize(unit, ROUND_FLOOR, exact))
        high = float(Decimal(high).quantize(unit, ROUND_CEILING, exact))
    low, high = max(exact_number(low), limits.low), min(exact_number(high), limits.high)
    return ValueRange(low, high) if math.isfinite(high - low) and high > low else None
