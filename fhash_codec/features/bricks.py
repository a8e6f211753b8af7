"""Coreset of the paper: the samples inside the features, brick by brick."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from math import prod
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from fhash_codec.boxes import Box, Sizes
from fhash_codec.features import occupancy
from fhash_codec.features.features import Extent, FeatureChoice, find_extent
from fhash_codec.features.key_frames import KeyTimes
from fhash_codec.features.scan import Scan
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.progress import Progress
from fhash_formats.errors import InputError
from fhash_formats.series import Series

Scalar = TypeVar("Scalar", bound=np.generic)

BRICK_BITS = (3, 3, 4)
"""Exponents of two of the usual brick: 8 x 8 x 16 vertices (z, y, x)."""
MAX_BRICK_VERTICES = 1 << 15
"""Vertices of a brick that is asked for: the engines hold all inputs of a batch at once."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Coreset:
    """The samples of all key frames, brick by brick.

    Attributes:
        box: the feature bounding box, fused over the key frames.
        key_frames: steps that the samples are from.
        brick_shape: vertices of a brick (z, y, x), at most 1024 in all by default.
        brick_grid: bricks along each axis of the box (z, y, x). The last brick of an axis may reach
            beyond the box.
        bricks: int32 (n, 4), one row (step, z, y, x) in the brick grid for each brick that
            holds a sample, ascending.
        mask_bits: uint8 (n, ceil(vertices of a brick / 8)), np.packbits of each brick in C order,
            1 = sample. Samples are the vertices of the coreset, and of its fringe if that is asked.
        values: float32 (samples,) in [0, 1], samples only: brick by brick, in C order in a brick.
        offsets: int64 (n + 1,), the place in `values` where each brick begins, and their end.
        occupancy: one grid per key frame, in ragged Morton order over the box, 1 = in the coreset.
        fraction: vertices of the coreset / (key frames * vertices of the domain).
        background: mean of the finite values outside the coreset over the key frames, in data
            units; the mean of all values if none is outside.
        apart: `occupancy` of each feature alone; empty if there is only one.
        fringe: bool (samples,), which samples are of the fringe; None if none was asked for.
        key_places: place of each step of the samples among the key frames, float64 (steps,);
            brick coordinates count these steps. Fractional for steps between two key frames.
        lattice: the samples at the key frames alone, which the finest table has, where the others
            are those of more steps; None where there are no others.
    """

    box: Box
    key_frames: tuple[int, ...]
    brick_shape: Sizes
    brick_grid: Sizes
    bricks: npt.NDArray[np.int32]
    mask_bits: npt.NDArray[np.uint8]
    values: npt.NDArray[np.float32]
    offsets: npt.NDArray[np.int64]
    key_places: npt.NDArray[np.float64]
    occupancy: tuple[npt.NDArray[np.uint8], ...]
    fraction: float
    background: float
    apart: tuple[tuple[npt.NDArray[np.uint8], ...], ...] = ()
    fringe: npt.NDArray[np.bool_] | None = None
    lattice: Coreset | None = None

    @property
    def grids(self) -> tuple[tuple[npt.NDArray[np.uint8], ...], ...]:
        """Grids of each feature at each key frame, as `occupancy` has those of all together."""
        return self.apart or (self.occupancy,)

    @property
    def counts(self) -> npt.NDArray[np.int64]:
        """Samples of each brick without those of the fringe, int64 (n,)."""
        if self.fringe is None:
            return np.diff(self.offsets)
        ends = np.concatenate([[0], np.cumsum(~self.fringe, dtype=np.int64)])
        return np.asarray(np.diff(ends[self.offsets]))

    def sample_indices(self, chosen: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Places (n,) in `values` of the samples of some bricks, in their order."""
        first = self.offsets[chosen]
        counts = self.offsets[chosen + 1] - first
        starts = np.cumsum(counts) - counts
        places: npt.NDArray[np.int64] = np.arange(counts.sum()) + np.repeat(first - starts, counts)
        return places


def build_coreset(
    series: Series,
    scan: Scan,
    choice: FeatureChoice,
    progress: Progress,
    *,
    fringe: bool = False,
    brick: Sizes | None = None,
) -> Coreset:
    """The coreset of a series: finite vertices of the merged features, dilated, at every key frame.

    fringe: whether vertices in the coreset of a neighbouring key frame only are samples as well
        (`Extent.with_fringe`). One without a finite value has that of the neighbour.
    brick: the shape of a brick (z, y, x); `brick_shape` of the box if None.

    Raises InputError if the features select nothing at all; single key frames may be empty. Warns
    of a feature that selects nothing while others do. Progress stages: "selecting", "gathering".
    """
    key_frames = choice.key_frames
    extent = find_extent(series, scan, choice, progress, apart=len(choice.features) > 1)
    box, size = extent.box, extent.box.shape
    shape = brick or brick_shape(size)
    grid = (-(-size[0] // shape[0]), -(-size[1] // shape[1]), -(-size[2] // shape[2]))
    samples = _Samples(
        extent.samples_with_fringe() if fringe else extent.samples, shape, grid, fringe=fringe
    )
    grids = []
    for key, step in enumerate(key_frames):
        mask = of_key = extent.mask(key)
        grids.append(occupancy.pack(mask))
        frame = series.frame(step)[box.slices()]
        if fringe:
            mask = extent.with_fringe(key)
            frame = _finite_at(mask, frame, series, extent, key)
        samples.add(key, frame, mask, scan.value_range, of_key)
        progress("gathering", key + 1, len(key_frames), "")
    return Coreset(
        box=box,
        key_frames=tuple(key_frames),
        brick_shape=shape,
        brick_grid=grid,
        **samples.arrays()._asdict(),
        key_places=np.arange(len(key_frames), dtype=np.float64),
        occupancy=tuple(grids),
        fraction=extent.fraction,
        background=extent.background,
        apart=tuple(
            tuple(occupancy.pack(extent.mask_of(number, key)) for key in range(len(key_frames)))
            for number in range(len(extent.apart))
        ),
    )


class _Arrays(NamedTuple):
    """Arrays of a `Coreset`."""

    bricks: npt.NDArray[np.int32]
    mask_bits: npt.NDArray[np.uint8]
    values: npt.NDArray[np.float32]
    offsets: npt.NDArray[np.int64]
    fringe: npt.NDArray[np.bool_] | None


class _Samples:
    """Samples that are gathered step by step, as the arrays of a `Coreset`."""

    def __init__(self, most: int, shape: Sizes, grid: Sizes, *, fringe: bool = False) -> None:
        """Make room. most: samples at most. shape, grid: vertices of a brick, and bricks."""
        self._values, self._end = np.empty(most, np.float32), 0
        self._fringe = np.zeros(most, np.bool_) if fringe else None
        self._shape, self._grid = shape, grid
        self._layers: list[tuple[npt.NDArray[Any], ...]] = []

    def add(
        self,
        number: int,
        frame: npt.NDArray[Any],
        mask: npt.NDArray[np.bool_],
        value_range: ValueRange,
        of_key: npt.NDArray[np.bool_] | None = None,
    ) -> None:
        """Add the samples of a step.

        Args:
            number: number of the step among those of the samples.
            frame: values (z, y, x) of the box.
            mask: which vertices are samples.
            value_range: range of the series.
            of_key: which of them are no fringe; None for all.
        """
        height = self._shape[0]
        for layer in range(self._grid[0]):
            rows = slice(layer * height, (layer + 1) * height)
            in_coreset = tile(mask[rows], self._shape)
            # Boolean indexing walks brick by brick, in C order within a brick.
            samples = value_range.to_unit(tile(frame[rows], self._shape)[in_coreset])
            start, self._end = self._end, self._end + samples.size
            self._values[start : self._end] = samples
            if self._fringe is not None and of_key is not None:
                of_layer = tile(of_key[rows], self._shape)[in_coreset]
                self._fringe[start : self._end] = ~of_layer
            self._layers.append(_layer_bricks(in_coreset, number, layer))

    def arrays(self) -> _Arrays:
        """Return what was gathered, fringe where that was asked for."""
        bricks, bits, counts = (np.concatenate(all_) for all_ in zip(*self._layers, strict=True))
        return _Arrays(
            bricks=bricks,
            mask_bits=bits,
            values=self._values[: self._end],
            offsets=np.concatenate([np.zeros(1, np.int64), np.cumsum(counts)]),
            fringe=None if self._fringe is None else self._fringe[: self._end],
        )


def with_steps_between(
    coreset: Coreset, series: Series, value_range: ValueRange, times: KeyTimes, progress: Progress
) -> Coreset:
    """Return a coreset with samples of the steps between its key frames, too.

    Such a sample is a vertex with a finite value that is in the coreset of a key frame around the
    step. Both must have embeddings of it: the coreset has its fringe.
    """
    keys, box = coreset.key_frames, coreset.box
    steps = sorted(set(range(keys[0], keys[-1] + 1)).difference(keys))
    if not steps:
        return coreset
    grids = list(itertools.starmap(occupancy.between, itertools.pairwise(coreset.occupancy)))
    places = times.key_indices(steps)
    most = sum(int(np.bitwise_count(grids[int(place)]).sum()) for place in places)
    samples = _Samples(most, coreset.brick_shape, coreset.brick_grid)
    for number, (step, place) in enumerate(zip(steps, places, strict=True)):
        frame = series.frame(step)[box.slices()]
        mask = occupancy.unpack(grids[int(place)], box.shape) & np.isfinite(frame)
        samples.add(len(keys) + number, frame, mask, value_range)
        progress("gathering", number + 1, len(steps), "between key frames")
    more = samples.arrays()
    assert coreset.fringe is not None
    return replace(
        coreset,
        bricks=np.concatenate([coreset.bricks, more.bricks]),
        mask_bits=np.concatenate([coreset.mask_bits, more.mask_bits]),
        values=np.concatenate([coreset.values, more.values]),
        offsets=np.concatenate([coreset.offsets, coreset.offsets[-1] + more.offsets[1:]]),
        fringe=np.concatenate([coreset.fringe, np.zeros(len(more.values), np.bool_)]),
        key_places=np.concatenate([coreset.key_places, places]),
        lattice=coreset,
    )


def sample_places(coreset: Coreset) -> npt.NDArray[np.int32]:
    """Places (samples, 4) of the samples in their order: (key, z, y, x) in vertices of the box."""
    vertices = prod(coreset.brick_shape)
    mask = np.unpackbits(coreset.mask_bits, axis=1, count=vertices).astype(bool)
    brick, vertex = np.nonzero(mask)
    inside = np.stack(np.unravel_index(vertex, coreset.brick_shape), axis=1)
    corner = coreset.bricks[brick, 1:] * np.array(coreset.brick_shape, np.int32)
    return np.concatenate(
        [coreset.bricks[brick, :1], (corner + inside).astype(np.int32)], axis=1, dtype=np.int32
    )


def brick_shape(size: Sizes) -> Sizes:
    """Vertices of a brick (z, y, x) for a box of some size: 8 x 8 x 16 for a box that is not thin.

    A shorter axis passes its factors of two on to the other axes. No axis gets more than the power
    of two that covers it. The product is 1024, or less if the box is smaller. In the end the bricks
    of an axis are made as short as their number allows, so that few vertices lie beyond the box.
    """
    max_bits = [(length - 1).bit_length() for length in size]
    bits = [min(usual, limit) for usual, limit in zip(BRICK_BITS, max_bits, strict=True)]
    while sum(bits) < sum(BRICK_BITS) and bits != max_bits:
        # The thinnest axis that may grow; x before y before z if equal, since x is contiguous.
        growing = [axis for axis in (2, 1, 0) if bits[axis] < max_bits[axis]]
        bits[min(growing, key=lambda axis: bits[axis])] += 1
    counts = [-(-length // 2**bit) for length, bit in zip(size, bits, strict=True)]
    z, y, x = (-(-length // count) for length, count in zip(size, counts, strict=True))
    return z, y, x


def parse_brick(text: str) -> Sizes | None:
    """The shape (z, y, x) of a brick that a setting names; None for 'auto'.

    Raises InputError for another text and for a brick that is too large.
    """
    if text == "auto":
        return None
    try:
        numbers = [int(number) for number in text.split("x")]
    except ValueError:
        numbers = []
    if len(numbers) != 3 or min(numbers) < 1 or prod(numbers) > MAX_BRICK_VERTICES:
        raise InputError(
            f"brick is '{text}'; allowed: auto, or three whole numbers (z, y, x) as in 8x8x16,"
            f" {MAX_BRICK_VERTICES:,} vertices at most"
        )
    z, y, x = numbers
    return z, y, x


def _finite_at(
    mask: npt.NDArray[np.bool_],
    frame: npt.NDArray[Scalar],
    series: Series,
    extent: Extent,
    key: int,
) -> npt.NDArray[Scalar]:
    """A frame (z, y, x) of the box with a finite value at every vertex of a mask with fringe.

    Where the series has none, it is that of the neighbouring key frame whose coreset has the
    vertex, the one before if both have it.
    """
    gaps = mask & ~np.isfinite(frame)
    for other in (key - 1, key + 1):
        if gaps.any() and 0 <= other < len(extent.key_frames):
            held = gaps & extent.mask(other)
            values = series.frame(extent.key_frames[other])[extent.box.slices()]
            frame = np.where(held, values, frame)
            gaps &= ~held
    return frame


def tile(layer: npt.NDArray[Scalar], shape: Sizes) -> npt.NDArray[Scalar]:
    """One layer of a box, cut into bricks: (grid y, grid x, brick z, brick y, brick x).

    layer: (z, y, x) of the box, with z at most the height of a brick.
    shape: vertices of a brick (z, y, x). Zeros fill the bricks that reach beyond the box.
    """
    _, y, x = layer.shape
    rows, columns = -(-y // shape[1]), -(-x // shape[2])
    padded = np.zeros((shape[0], rows * shape[1], columns * shape[2]), dtype=layer.dtype)
    padded[: layer.shape[0], :y, :x] = layer
    return padded.reshape(shape[0], rows, shape[1], columns, shape[2]).transpose(1, 3, 0, 2, 4)


def _layer_bricks(
    in_coreset: npt.NDArray[np.bool_], key: int, layer: int
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.uint8], npt.NDArray[np.int64]]:
    """Coordinates (n, 4), packed masks and sample counts of the bricks of a layer with a sample."""
    flat = in_coreset.reshape(*in_coreset.shape[:2], -1)
    y, x = np.nonzero(flat.any(axis=2))
    masks = flat[y, x]
    coordinates = np.stack([np.full_like(y, key), np.full_like(y, layer), y, x], axis=1)
    counts = masks.sum(axis=1, dtype=np.int64)
    return coordinates.astype(np.int32), np.packbits(masks, axis=1), counts
