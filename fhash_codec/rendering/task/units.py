"""The unit of the values that are drawn."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.colour.opacity import about
from fhash_codec.volume import Volume

Floats = npt.NDArray[np.float64]

LARGE_OFFSET = 2.0**9
"""Half ranges that float32 values may be large: 15 bits are left for the range then."""


@dataclass(frozen=True, kw_only=True)
class Units:
    """Values as they are marched: (value - shift) * factor, so that float32 holds data whose range is small beside their offset."""

    shift: float = 0.0
    factor: float = 1.0

    @classmethod
    def of(cls, volume: Volume) -> Units:
        """Of float64 volumes the middle and the size of the value range, a power of two.

        float32 values stay what they are unless they are so much larger than their range that what lies between them would be coarse.
        """
        low, high = volume.value_range.low, volume.value_range.high
        if low == high:
            low, high = about(low)
        extent = high / 2 - low / 2
        if volume.dtype == np.float32 and max(abs(low), abs(high)) <= LARGE_OFFSET * extent:
            return cls()
        exponent = math.frexp(extent)[1]
        return cls(
            shift=low / 2 + high / 2, factor=math.ldexp(1.0, -max(-1000, min(1000, exponent)))
        )

    def to(self, values: npt.ArrayLike) -> Floats:
        """Data units to marched units, float64."""
        return np.asarray(
            (np.asarray(values, dtype=np.float64) - self.shift) * self.factor, dtype=np.float64
        )
