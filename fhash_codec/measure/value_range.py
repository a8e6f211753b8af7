"""Values to [0, 1] by one global range, positions to [-1, 1] by the feature bounding box, and exact means (paper, Coreset Selection)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError

PIECE = 2**20
"""Values that are held as float64 at a time: 8 MiB."""


def pieces(values: npt.NDArray[Any]) -> Iterator[npt.NDArray[Any]]:
    """The values in C order as one-dimensional views of at most PIECE each; an array that is not C-contiguous is copied once."""
    flat = values.reshape(-1)
    for start in range(0, flat.size, PIECE):
        yield flat[start : start + PIECE]


def power_of_two(peak: float) -> float:
    """A power of two that brings `peak` >= 0 near 1, clamped to 2**+-1000 so that its reciprocal is a normal number too.

    Multiplying by it is exact, and differences and squares of values up to `peak` then neither overflow nor vanish.
    """
    exponent = math.frexp(peak)[1]
    return math.ldexp(1.0, -max(-1000, min(1000, exponent)))


class Mean:
    """The mean of many finite values, given piece by piece: no overflow, no drift from the order or the number of pieces.

    Each piece is summed in float64 after exact scaling; the sums are then added as exact fractions.
    """

    def __init__(self) -> None:
        self.count = 0
        self._total = Fraction(0)

    def add(self, values: npt.NDArray[Any]) -> None:
        """Take in finite values of any shape and number type; cut large arrays with `pieces` first."""
        if values.size == 0:
            return
        wide = values.astype(np.float64)
        scale = power_of_two(max(abs(float(wide.min())), abs(float(wide.max()))))
        wide *= scale
        self.add_sum(values.size, float(wide.sum()), scale)

    def add_sum(self, count: int, total: float, scale: float) -> None:
        """Take in so many values whose sum, times `scale`, is known."""
        self._total += Fraction(total) / Fraction(scale)
        self.count += count

    def value(self) -> float:
        """The mean of everything taken in; there must be something."""
        return float(self._total / self.count)


@dataclass(frozen=True)
class ValueRange:
    """The global range of the data, `low` <= `high`, finite, in data units; raises InputError for any other pair.

    Where a difference could overflow or be denormal it is taken after scaling by an exact power of two, so that +-1.7e308 and
    denormal ranges work like any other.
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low <= self.high):
            raise InputError(
                f"value range is {self.low!r} to {self.high!r}; two finite numbers, the lower first, are needed"
            )

    @property
    def scale(self) -> float:
        """The power of two by which both ends are multiplied before they are subtracted; 1 for every ordinary range."""
        peak = max(abs(self.low), abs(self.high))
        return 1.0 if 2.0**-900 < peak < 2.0**1022 else power_of_two(peak)

    def to_unit(self, values: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """(value - low) / (high - low) as float32 in [0, 1], of the same shape; computed in float64, PIECE values at a time.

        `low` gives exactly 0 and `high` exactly 1; values beyond are clipped; NaN and both infinities give NaN; a constant range gives 0.
        """
        source = np.asarray(values)
        unit = np.empty(source.shape, dtype=np.float32)
        for part, out in zip(pieces(source), pieces(unit), strict=True):
            out[:] = self._part_to_unit(part.astype(np.float64))
        return unit

    def _part_to_unit(self, wide: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        wide[np.isinf(wide)] = np.nan
        np.clip(wide, self.low, self.high, out=wide)
        low = self.low * self.scale
        span = self.high * self.scale - low
        wide *= self.scale
        wide -= low
        if span > 0:
            wide /= span
        return wide

    def from_unit(self, unit: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """low + unit * (high - low) in data units, float64 of the same shape, clipped to the range; NaN stays NaN.

        Error law: |from_unit(to_unit(x)) - x| <= 2**-25 (high - low) + 2 float64 spacings of the larger end, for every x of the range.
        """
        low, high = self.low * self.scale, self.high * self.scale
        values = np.asarray(unit, dtype=np.float64) * (high - low)
        values = np.asarray(values + low)
        np.clip(values, low, high, out=values)
        values /= self.scale
        # Ends that differ by 300 orders of magnitude lose digits of the small one while scaled: clip in data units, too.
        return np.clip(values, self.low, self.high, out=values)


def unit_position(index: npt.ArrayLike, size: int) -> npt.NDArray[np.float64]:
    """Position in [-1, 1] of a vertex index within a box axis of `size` vertices (paper, Position Translation and Scaling).

    Measured from the centroid of the box in units of half its extent (size - 1 cells), so that vertex 0 is at -1 and vertex
    size - 1 at +1 (align-corners); the only vertex of an axis of one is at 0. Fractional indices are allowed.
    """
    positions = np.asarray(index, dtype=np.float64)
    return np.zeros_like(positions) if size == 1 else np.asarray(2.0 * positions / (size - 1) - 1.0)


def position_index(position: npt.ArrayLike, size: int) -> npt.NDArray[np.float64]:
    """The fractional vertex index at a position in [-1, 1]: the inverse of `unit_position`; 0 for an axis of one vertex."""
    return np.asarray((np.asarray(position, dtype=np.float64) + 1.0) * (0.5 * (size - 1)))
