"""The range of a series, which maps values to [0, 1] and back, and exact means of many values.

Source of the normalisation: the paper, Coreset Selection.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.support.number_types import exact_number, integer_origin, is_wide_integer
from fhash_formats.transform.values.elementwise import about_origin

PIECE = 2**20
"""Values that are converted to float64 at a time; they take 8 MiB."""


def pieces(values: npt.NDArray[Any]) -> Iterator[npt.NDArray[Any]]:
    """The values in C order, as one-dimensional views of at most PIECE values.

    An array that is not C-contiguous is copied once.
    """
    flat = values.reshape(-1)
    for start in range(0, flat.size, PIECE):
        yield flat[start : start + PIECE]


def power_of_two(peak: float) -> float:
    """A power of two that brings `peak` >= 0 near 1.

    Multiplying by it is exact. Differences and squares of values up to `peak` then neither overflow
    nor vanish. It is clamped to 2**+-1000, so that its reciprocal is a normal number too.
    """
    exponent = math.frexp(peak)[1]
    return math.ldexp(1.0, -max(-1000, min(1000, exponent)))


class Mean:
    """The mean of many finite values that are added piece by piece.

    It does not overflow, and does not drift with the order or the number of pieces: each piece is
    summed in float64 after exact scaling, and the sums are added as exact fractions.
    """

    def __init__(self) -> None:
        self.count = 0
        self._total = Fraction(0)
        self._whole = False

    def add(self, values: npt.NDArray[Any]) -> None:
        """Add finite values of any shape and number type; cut large arrays with `pieces` first."""
        if values.size == 0:
            return
        origin = 0
        if is_wide_integer(values.dtype):
            low, high = int(values.min()), int(values.max())
            origin = integer_origin(low, high, values.dtype)
            values = about_origin(values, origin) if origin else values
        wide = values.astype(np.float64)
        scale = power_of_two(max(abs(float(wide.min())), abs(float(wide.max()))))
        wide *= scale
        self.add_sum(values.size, float(wide.sum()), scale)
        self._total += origin * values.size
        self._whole |= origin != 0

    def add_sum(self, count: int, total: float, scale: float) -> None:
        """Add `count` values by their sum: `total` is their sum times `scale`."""
        self._total += Fraction(total) / Fraction(scale)
        self.count += count

    def join(self, other: Mean) -> None:
        """Add the values of another mean."""
        self._total += other._total
        self.count += other.count
        self._whole |= other._whole

    def value(self) -> float:
        """The mean of all values added; there must be at least one.

        It is a whole number for integers of 64 bits some of which are beyond 2^53.
        """
        mean = self._total / self.count
        return exact_number(round(mean)) if self._whole else float(mean)


@dataclass(frozen=True)
class ValueRange:
    """The range of a series: finite numbers `low` <= `high` in data units.

    Differences that could overflow or be denormal are computed after scaling by an exact power of
    two, so that +-1.7e308 and denormal ranges work like any other range. Where an end is an integer
    beyond 2^53, both are integers, and their difference is exact. Raises InputError for other
    numbers.
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low <= self.high):
            raise InputError(
                f"value range is {self.low!r} to {self.high!r}; "
                "two finite numbers, the lower first, are needed"
            )
        ends = [exact_number(end) for end in self.ends]
        if any(isinstance(end, int) for end in ends):
            ends = [int(end) for end in ends]
        for name, end in zip(("low", "high"), ends, strict=True):
            object.__setattr__(self, name, end)

    @property
    def ends(self) -> tuple[float, float]:
        """Both ends."""
        return self.low, self.high

    @property
    def floats(self) -> tuple[float, float]:
        """The least and the greatest float64 within the range; its rounded ends if none is."""
        low, high = float(self.low), float(self.high)
        inner = (
            low if low >= self.low else math.nextafter(low, math.inf),
            high if high <= self.high else math.nextafter(high, -math.inf),
        )
        return inner if inner[0] <= inner[1] else (low, high)

    def is_far(self, dtype: np.dtype[Any]) -> bool:
        """Whether values of a type may be integers that float64 has not."""
        return is_wide_integer(dtype) and max(map(abs, self.ends)) > 1 << 53

    def origin(self, dtype: np.dtype[Any]) -> int:
        """The integer that is subtracted from values of a type before they become floats."""
        return integer_origin(self.low, self.high, dtype)

    def moved(self, distance: int) -> ValueRange:
        """The range of the values plus an integer; integers stay exact."""
        if not distance:
            return self
        return ValueRange(*(exact_number(int(end) + distance) for end in self.ends))

    @property
    def scale(self) -> float:
        """A power of two: both ends are multiplied by it before they are subtracted.

        It is 1 for every ordinary range.
        """
        peak = max(abs(self.low), abs(self.high))
        return 1.0 if 2.0**-900 < peak < 2.0**1022 else power_of_two(peak)

    def to_unit(self, values: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """(value - low) / (high - low) as float32 in [0, 1], of the same shape.

        `low` gives exactly 0 and `high` exactly 1. Values outside the range are clipped. NaN and
        both infinities give NaN. A constant range gives 0. Computed in float64, PIECE values at a
        time.
        """
        source = np.asarray(values)
        origin = self.origin(source.dtype)
        if origin:
            differences = about_origin(np.clip(source, int(self.low), int(self.high)), origin)
            return self.moved(-origin).to_unit(differences)
        unit = np.empty(source.shape, dtype=np.float32)
        for piece, out in zip(pieces(source), pieces(unit), strict=True):
            out[:] = self._piece_to_unit(piece.astype(np.float64))
        return unit

    def _piece_to_unit(self, wide: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """`to_unit` of float64 values, in place."""
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
        """low + unit * (high - low) in data units, float64 of the same shape.

        Values are clipped to the range; NaN stays NaN. Error law, for every x in the range:
        |from_unit(to_unit(x)) - x| <= 2**-25 (high - low) + 2 float64 spacings of the larger end.
        """
        low, high = self.low * self.scale, self.high * self.scale
        values = np.asarray(unit, dtype=np.float64) * (high - low)
        values = np.asarray(values + low)
        np.clip(values, low, high, out=values)
        values /= self.scale
        # If the ends differ by 300 orders of magnitude, scaling takes digits from the smaller one:
        # clip in data units as well.
        return np.clip(values, *self.floats, out=values)
