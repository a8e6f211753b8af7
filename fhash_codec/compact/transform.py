"""Transforms of tiles: the data's own bases, wavelets by shape, and histograms of coefficients."""

from __future__ import annotations

import math
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec import native
from fhash_codec.compact.sample import Sample
from fhash_codec.compact.tiles import MIN_STEP_SHARE, Blocks
from fhash_codec.measure.value_range import power_of_two
from fhash_codec.native import pointer
from fhash_codec.progress import stage
from fhash_formats.transform.spec import (
    MAX_LENGTH,
    AxisTransform,
    Basis,
    TransformSpec,
    checked,
    fit_basis,
)
from fhash_formats.transform.tile import forward, plain_step
from fhash_formats.transform.tile_format import Shape, TileSettings
from fhash_formats.transform.values import all_finite

Gram = npt.NDArray[np.float64]
"""Products of lines (length, length)."""


def gram_of(planes: npt.NDArray[Any], center: float) -> Gram:
    """Return the sum of v v^T over the lines v along the middle axis of planes.

    planes: values (before, length, after) of any real type. Each counts less the centre, and as 0
        where that is not finite.
    """
    if planes.dtype not in (np.float32, np.float64):
        planes = planes.astype(np.float64)
    planes = np.ascontiguousarray(planes)
    before, length, after = planes.shape
    sums: Gram = np.empty((length, length))
    function = getattr(native.library(), f"fhash_gram_f{planes.itemsize * 8}")
    checked(function(pointer(planes), before, length, after, center, pointer(sums)))
    return sums


MAX_BASIS_LENGTH = 128
"""Longest axis in vertices that gets a basis of the data's own: longer factors cost too much."""


BASIS_STEPS = 1.4
"""Quantiser steps that a basis is as precise as: of one, more bytes were lost than won."""


class Bases:
    """The data's own bases along the axes of a tile, computed when they are asked for."""

    def __init__(self, sample: Sample, settings: TileSettings) -> None:
        self._sample, self._settings = sample, settings
        self._allowed = sample.allows_bases
        self._cache: dict[int, AxisTransform] = {}

    def possible(self, *lengths: int) -> bool:
        """Whether axes of these lengths can have a basis; only a series in memory can."""
        return self._allowed and min(lengths) > 1 and max(lengths) <= MAX_BASIS_LENGTH

    def along(self, axis: int) -> AxisTransform:
        """Return the basis along an axis, as precise as the step of the settings needs."""
        if axis not in self._cache:
            with stage("bases", "the data's own bases, which compete as transforms of short axes"):
                basis = self._fitted(axis)
            self._cache[axis] = AxisTransform(kind="klt", basis=basis)
        return self._cache[axis]

    def _fitted(self, axis: int) -> Basis:
        """Return the basis of all tiles.

        A direction that the basis drops cannot be restored by any coefficient.
        """
        grams, key = self._sample.grams, (axis, self._settings.center)
        if key not in grams:
            length = self._sample.tiles[0].values.shape[axis]
            gram = np.zeros((length, length))
            for tile_gram in self._sample.map_all(lambda tile: self._gram(tile.values, axis)):
                gram += tile_gram
            grams[key] = gram
        return fit_basis(grams[key], BASIS_STEPS * plain_step(self._settings))

    def _gram(self, values: npt.NDArray[np.generic], axis: int) -> Gram:
        """Return the products of the lines of a tile along an axis, (length, length)."""
        # Values that do not count are kept: zeroing them would create an edge that dominates.
        planes = values.reshape(math.prod(values.shape[:axis]), values.shape[axis], -1)
        return gram_of(planes, self._settings.center)


assert MAX_BASIS_LENGTH <= MAX_LENGTH


NONE = AxisTransform(kind="none")
"""Marks an axis without a transform."""


def wavelet(kind: str, depth: int, length: int) -> AxisTransform:
    """Return a wavelet of at most this depth for an axis of `length` vertices.

    It is less deep on a short axis; an axis of one vertex gets no transform.
    """
    depth = min(depth, max(0, (length - 1).bit_length()))
    return AxisTransform(kind=kind, depth=depth) if depth else NONE


def usual_transform(shape: Shape) -> TransformSpec:
    """Return a good guess without trial: 9/7 along all axes, deepest in the plane."""
    t, z, y, x = shape
    along_t, along_z = wavelet("9/7", 2, t), wavelet("9/7", 2, z)
    depth = min(4, max(1, max(y, x).bit_length() - 2))
    of_plane = in_plane("9/7", depth, shape)
    return TransformSpec(axes=(along_t, along_z, of_plane[2], of_plane[3]))


def moved_transform(sample: Sample, settings: TileSettings) -> TileSettings:
    """Return settings with the same kinds of transforms for the tiles of a sample."""
    bases = Bases(sample, settings)
    shape = sample.tiles[0].values.shape
    t, z, y, x = (
        bases.along(axis)
        if transform.basis is not None and bases.possible(shape[axis])
        else _fitted(transform, shape[axis])
        for axis, transform in enumerate(settings.transform.axes)
    )
    return replace(settings, transform=TransformSpec(axes=(t, z, y, x)))


def refit(sample: Sample, settings: TileSettings) -> TileSettings:
    """Return settings with the data's own bases made anew for their step.

    Settings without such bases are returned themselves, the same object.
    """
    axes = settings.transform.axes
    if not any(axis.basis is not None for axis in axes):
        return settings
    bases = Bases(sample, settings)
    t, z, y, x = (
        axis if axis.basis is None else bases.along(number) for number, axis in enumerate(axes)
    )
    return replace(settings, transform=TransformSpec(axes=(t, z, y, x)))


def _fitted(axis: AxisTransform, length: int) -> AxisTransform:
    """Return the same kind for another length; 9/7 for a basis, which fits one length only."""
    if axis.basis is not None:
        return wavelet("9/7", 2, length)
    return wavelet(axis.kind, axis.depth, length) if axis.wavelet else axis


def in_plane(kind: str, depth: int, shape: Shape) -> dict[int, AxisTransform]:
    """Return a wavelet by the axes y and x, of one depth where both have more than one vertex."""
    y, x = shape[2:]
    if min(y, x) > 1:
        depth = min(depth, max(1, (max(y, x) - 1).bit_length()))
        return dict.fromkeys((2, 3), AxisTransform(kind=kind, depth=depth))
    return {2: wavelet(kind, depth, y), 3: wavelet(kind, depth, x)}


DEAD_ZONE = 0.8
"""Share of the step below which a coefficient becomes 0."""
SPREAD = 0.1
"""Mean square of the error of the other coefficients, in squared steps."""
SHIFT = 21
"""Low bits of a float32 that a bin leaves out.

The rest is the exponent and two bits of the mantissa: a bin is a quarter of an octave.
"""
BINS = 1 << (31 - SHIFT)
"""Number of bins of magnitudes."""

with np.errstate(invalid="ignore"):
    _EDGES = (np.arange(BINS, dtype=np.uint32) << SHIFT).view(np.float32).astype(np.float64)
_EDGES[~np.isfinite(_EDGES)] = np.inf


@dataclass(frozen=True, kw_only=True)
class Magnitudes:
    """Histogram of the magnitudes of coefficients, with logarithmic bins."""

    counts: npt.NDArray[np.int64]
    """Number of coefficients in each bin."""
    squares: npt.NDArray[np.float64]
    """Sum of the squares of the coefficients in each bin."""

    def error(self, step: float) -> float:
        """Return the approximate sum of the squared errors at a step."""
        limit = DEAD_ZONE * step
        number = self._bin_of(limit)
        share = (limit - _EDGES[number]) / (_EDGES[number + 1] - _EDGES[number])
        zeroed = math.fsum(self.squares[:number]) + float(share * self.squares[number])
        kept = float(self.counts[number:].sum() - share * self.counts[number])
        return zeroed + kept * SPREAD * step * step

    def step(self, error: float, min_step: float) -> float:
        """Return the step for a sum of squared errors, at least `min_step`."""
        low, high = min_step, min_step * 2
        while self.error(high) < error and high < min_step * 2.0**60:
            low, high = high, high * 2
        for _ in range(30):
            middle = math.sqrt(low * high)
            low, high = (middle, high) if self.error(middle) < error else (low, middle)
        return low

    def step_of(self, error: float, settings: TileSettings) -> float:
        """Return the step in data units for a sum of squared errors, times `scale_of` squared."""
        scale = scale_of(settings)
        least = (settings.high - settings.low) * scale * MIN_STEP_SHARE
        return self.step(error, least) / scale

    def ratio(self, error: float, settings: TileSettings) -> float:
        """Return such an error as a multiple of that at the step of the settings; 0 of none."""
        predicted = self.error(settings.step * scale_of(settings))
        return error / predicted if predicted > 0 else 0.0

    @staticmethod
    def _bin_of(magnitude: float) -> int:
        """Return the bin that holds a magnitude."""
        return int(np.searchsorted(_EDGES, min(magnitude, 1e38), side="right")) - 1


def magnitudes(coefficients: npt.NDArray[np.float32]) -> Magnitudes:
    """Return the histogram of coefficients (fhash_codec/native/quality.cpp)."""
    flat = np.ascontiguousarray(coefficients, dtype=np.float32).reshape(-1)
    histogram = Magnitudes(counts=np.zeros(BINS, np.int64), squares=np.zeros(BINS))
    native.library().fhash_magnitudes(
        pointer(flat), flat.size, SHIFT, pointer(histogram.counts), pointer(histogram.squares)
    )
    return histogram


def squared_error(vertices: int, psnr: float, data_range: float) -> float:
    """Return the sum of the squared errors over so many vertices at a PSNR (dB)."""
    return vertices * data_range**2 * 10 ** (-psnr / 10)


def magnitudes_of(values: npt.NDArray[Any], settings: TileSettings) -> Magnitudes:
    """Return the magnitudes of the coefficients of a tile (t, z, y, x), times `scale_of`.

    Only the kinds of the transform matter; float32 is precise enough.
    """
    kinds = replace(settings, double=False, step=1.0)
    return magnitudes(forward(about_center(values, settings), kinds))


def scale_of(settings: TileSettings) -> float:
    """Return the power of two that makes float32 hold the range of the values, however wide."""
    return power_of_two(settings.high - settings.low)


USUAL_SCALES = 2.0**-60, 2.0**60
"""Scales within which float32 itself holds values less their centre."""


def about_center(values: npt.NDArray[Any], settings: TileSettings) -> npt.NDArray[np.float32]:
    """Return values less the centre, times `scale_of`, as float32; 0 where they are not finite.

    Numbers of more digits than float32 has are subtracted first.
    """
    scale = scale_of(settings)
    wide = values.dtype.itemsize > 2 and values.dtype != np.float32
    wide |= not USUAL_SCALES[0] < scale < USUAL_SCALES[1]
    working = np.dtype(np.float64 if wide else np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        less = np.subtract(values, settings.center, dtype=working, casting="unsafe")
        less *= working.type(scale)
        about: npt.NDArray[np.float32] = np.ascontiguousarray(less, dtype=np.float32)
    if not all_finite(about):
        about[~np.isfinite(about)] = 0
    return about


def magnitudes_of_all(
    blocks: Blocks, settings: TileSettings, workers: ThreadPoolExecutor
) -> Magnitudes:
    """Return the magnitudes of the coefficients of all tiles together."""
    indices = list(blocks.indices())
    work = workers.map(lambda index: magnitudes_of(blocks.read(index).values, settings), indices)
    return weighted(work, map(blocks.weight, indices))


def weighted(tiles: Iterable[Magnitudes], weights: Iterable[int]) -> Magnitudes:
    """Return the histogram of tiles together, each of which stands for some."""
    counts, squares = np.zeros(BINS, np.int64), np.zeros(BINS)
    for tile, weight in zip(tiles, weights, strict=True):
        counts += weight * tile.counts
        squares += weight * tile.squares
    return Magnitudes(counts=counts, squares=squares)
