"""The unit of the values that are marched through."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.colour.opacity import about
from fhash_codec.volume import Volume
from fhash_formats.errors import InputError

__all__ = ["Units"]

Floats = npt.NDArray[np.float64]

LARGE_OFFSET = 2.0**9
"""Largest magnitude of float32 values that are marched as they are, in halves of the value range.
The range then has 15 bits of the significand left.
"""


@dataclass(frozen=True, kw_only=True)
class Units:
    """Marched values, (value - shift) * factor.

    They let float32 hold data whose range is small beside their offset.
    """

    shift: float = 0.0
    factor: float = 1.0

    @classmethod
    def of(cls, volume: Volume) -> Units:
        """The units of a volume: the middle of its value range, and a power of two near its size.

        float32 values are marched as they are, unless they are so much larger than their range that
        the values between them would be coarse.

        Raises InputError for 64-bit integers that float64, of which pictures are, has all in one.
        """
        low, high = volume.value_range.low, volume.value_range.high
        if isinstance(low, int) and low < high and high - low < 2 * math.ulp(max(-low, high)):
            raise InputError(
                f"pictures are of float64, which cannot tell values from {low} to {high} apart;"
                " encode their differences from one of them to draw them"
            )
        if low == high:
            low, high = about(low)
        extent = high / 2 - low / 2
        if volume.float_dtype == np.float32 and max(abs(low), abs(high)) <= LARGE_OFFSET * extent:
            return cls()
        exponent = math.frexp(extent)[1]
        return cls(
            shift=low / 2 + high / 2, factor=math.ldexp(1.0, -max(-1000, min(1000, exponent)))
        )

    def to(self, values: npt.ArrayLike) -> Floats:
        """Convert data units to marched units, float64."""
        return np.asarray(
            (np.asarray(values, dtype=np.float64) - self.shift) * self.factor, dtype=np.float64
        )
