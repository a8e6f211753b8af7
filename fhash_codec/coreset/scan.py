"""The first pass over a series: its range, its mean, and where values are missing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.measure.sums import range_and_sum
from fhash_codec.measure.value_range import Mean, ValueRange, pieces, power_of_two
from fhash_codec.progress import Progress
from fhash_formats.errors import InputError
from fhash_formats.series import Series


@dataclass(frozen=True, kw_only=True)
class Scan:
    """What one pass over all steps of a series tells.

    Attributes:
        value_range: of all finite values, in data units.
        mean: of all finite values, in data units, within the range.
        finite_count: number of finite values.
        missing: for each step that has NaN or infinite values, one bit per vertex, 1 = missing: np.packbits of the frame in C order.
    """

    value_range: ValueRange
    mean: float
    finite_count: int
    missing: Mapping[int, npt.NDArray[np.uint8]]

    def finite(self, step: int, shape: tuple[int, int, int]) -> npt.NDArray[np.bool_] | None:
        """Which vertices of a step are finite, bool of the frame's shape (z, y, x); None where all are."""
        if step not in self.missing:
            return None
        missing = np.unpackbits(self.missing[step], count=prod(shape)).view(np.bool_)
        return ~missing.reshape(shape)


def scan(series: Series, progress: Progress) -> Scan:
    """Read every frame once; raises InputError if no value at all is finite, or if the series changed. Progress stage: "scanning"."""
    low, high, mean = np.inf, -np.inf, Mean()
    missing: dict[int, npt.NDArray[np.uint8]] = {}
    last: npt.NDArray[np.uint8] | None = None
    steps = series.shape[0]
    for step, frame in enumerate(series.frames()):
        count = 0
        for part in pieces(frame):
            found = _part(part, mean)
            count, low, high = count + found[0], min(low, found[1]), max(high, found[2])
        if count < frame.size:
            bits = np.packbits(~np.isfinite(frame))
            # A land mask is the same at every step: keep one copy of it.
            last = last if last is not None and np.array_equal(bits, last) else bits
            missing[step] = last
        progress("scanning", step + 1, steps, "")
    series.check()
    if mean.count == 0:
        raise InputError(
            f"{series.source}: '{series.name}' has no finite value in any of its {steps} steps; there is nothing to encode"
        )
    value_range = ValueRange(low, high)
    return Scan(
        value_range=value_range,
        mean=min(max(mean.value(), low), high),
        finite_count=mean.count,
        missing=missing,
    )


def _part(part: npt.NDArray[Any], mean: Mean) -> tuple[int, float, float]:
    """Number, least and greatest of the finite values of a piece, which the mean takes in."""
    if part.dtype.kind != "f":
        mean.add(part)
        return part.size, float(part.min()), float(part.max())
    wide = part.astype(np.float32 if part.dtype.itemsize <= 4 else np.float64, copy=False)
    # A sum of float32 values does not overflow, one of float64 values is taken after scaling.
    count, low, high, total = range_and_sum(wide)
    scale = 1.0
    if count and wide.dtype == np.float64:
        scale = power_of_two(max(abs(low), abs(high)))
        total = range_and_sum(wide, scale)[3]
    mean.add_sum(count, total, scale)
    return count, low, high


def finite_values(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """The finite ones of the values, one-dimensional; the array itself where all are."""
    if values.dtype.kind != "f":
        return values
    finite = np.isfinite(values)
    return values if finite.all() else values[finite]
