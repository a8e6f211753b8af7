"""A part of a series around its middle, for measurements of a series that is too large."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.boxes import Box
from fhash_formats.series import Series

MIN_STEPS = 8
"""Steps that a part keeps at least where the series has them: time is what is compressed, too."""


class CroppedSeries(Series):
    """Some steps and a region of another series, which closes it."""

    def __init__(self, series: Series, steps: range, region: Box) -> None:
        """Take steps, and a region (z, y, x) in vertices of the domain."""
        self.series, self.steps, self.region = series, steps, region
        self.source, self.name, self.units = series.source, series.name, series.units
        self.dtype, self.attributes, self.files = series.dtype, series.attributes, series.files
        self.inherit(series)
        self.shape = (len(steps), *region.shape)
        ends = {"t": (steps[0], steps[-1] + 1), **dict(zip("zyx", region, strict=True))}
        self.coords = {
            axis: replace(series.coords[axis], values=series.coords[axis].values[slice(*span)])
            for axis, span in ends.items()
        }

    def read(self, step: int) -> npt.NDArray[Any]:
        self.require_step(step)
        return np.ascontiguousarray(self.series.read(self.steps[step])[self.region.slices()])

    def check(self) -> None:
        self.series.check()

    def close(self) -> None:
        self.series.close()


def cropped(series: Series, vertices: int) -> Series:
    """The series itself, or a part of it with at most about as many vertices as given.

    Steps in the middle are taken first, down to MIN_STEPS; then all axes in space are shortened
    alike around the middle of the domain.
    """
    steps, *space = series.shape
    if prod(series.shape) <= vertices:
        return series
    kept = max(min(MIN_STEPS, steps), min(steps, vertices // prod(space)))
    lengths = _shortened(space, vertices / kept)
    first = (steps - kept) // 2
    region = Box.of(
        ((n - length) // 2, (n - length) // 2 + length)
        for n, length in zip(space, lengths, strict=True)
    )
    return CroppedSeries(series, range(first, first + kept), region)


def _shortened(space: Sequence[int], vertices: float) -> list[int]:
    """Lengths of a box of about so many vertices, in the proportions of another one."""
    if prod(space) <= vertices:
        return list(space)
    free = [n for n in space if n > 1]
    share = (vertices / prod(space)) ** (1 / len(free)) if free else 1.0
    return [max(1, round(n * share)) if n > 1 else 1 for n in space]


def described(series: Series) -> str:
    """The part of the source that a series is, in words."""
    if not isinstance(series, CroppedSeries):
        return "the whole series"
    share = prod(series.shape) / prod(series.series.shape)
    region = ", ".join(
        f"{axis} {low}:{high}" for axis, (low, high) in zip("zyx", series.region, strict=True)
    )
    first, end = series.steps[0], series.steps[-1] + 1
    return f"a crop, {share:.2%} of the series: steps {first}:{end}, {region}"
