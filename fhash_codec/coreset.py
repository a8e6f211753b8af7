"""The training samples: the vertices of the dilated features, gathered in bricks of the feature bounding box (paper, Coreset Selection).

Two passes over the key frames, one frame at a time. The first keeps one bit per vertex of the domain and finds the box; the second
crops, normalises and gathers the values of the selected vertices brick by brick.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from math import prod
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from fhash_codec import occupancy
from fhash_codec.features import Everything, Feature, dilate
from fhash_codec.normalise import Mean
from fhash_codec.progress import Progress
from fhash_codec.scan import Scan
from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.series import Series

Box = tuple[tuple[int, int], tuple[int, int], tuple[int, int]]
"""((z0, z1), (y0, y1), (x0, x1)) in vertices of the domain, half-open."""
Sizes = tuple[int, int, int]
"""One number per axis, (z, y, x)."""
Scalar = TypeVar("Scalar", bound=np.generic)
BRICK_BITS = (3, 3, 4)
"""The usual brick, 8 x 8 x 16 vertices (z, y, x), as exponents of two."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Coreset:
    """The samples of all key frames, brick by brick.

    Attributes:
        box: the feature bounding box, fused over the key frames.
        key_frames: steps that the samples are from.
        brick_shape: vertices of a brick (z, y, x), 1024 or fewer in all by default.
        brick_grid: bricks along each axis of the box (z, y, x); the last of an axis may reach beyond the box.
        bricks: int32 (n, 4), (key index, z, y, x) in the brick grid, of the bricks that hold a sample, ascending.
        mask_bits: uint8 (n, ceil(vertices of a brick / 8)), np.packbits of each brick in C order, 1 = sample.
        values: float32 (samples,) in [0, 1], brick by brick, in C order within a brick, samples only.
        offsets: int64 (n + 1,), where each brick begins in `values`.
        occupancy: one grid per key frame, ragged Morton over the box; its voxels are the samples.
        fraction: samples / (key frames * vertices of the domain).
        background: mean of the finite values outside the coreset over the key frames, in data units; of all values if none is outside.
    """

    box: Box
    key_frames: tuple[int, ...]
    brick_shape: Sizes
    brick_grid: Sizes
    bricks: npt.NDArray[np.int32]
    mask_bits: npt.NDArray[np.uint8]
    values: npt.NDArray[np.float32]
    offsets: npt.NDArray[np.int64]
    occupancy: tuple[npt.NDArray[np.uint8], ...]
    fraction: float
    background: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Extent:
    """Where the coreset lies, one bit per vertex of the domain.

    Attributes:
        box: the feature bounding box, fused over the key frames.
        key_frames: steps at which the features were found.
        packed: np.packbits of the mask (z, y, x) of the domain at each key frame.
        domain: its shape (z, y, x).
        samples: vertices of the coreset over all key frames.
        background: mean of the finite values outside the coreset over the key frames, in data units; of all values if none is outside.
    """

    box: Box
    key_frames: tuple[int, ...]
    packed: list[npt.NDArray[np.uint8]]
    domain: Sizes
    samples: int
    background: float

    @property
    def fraction(self) -> float:
        """samples / (key frames * vertices of the domain)."""
        return self.samples / (len(self.key_frames) * prod(self.domain))

    def mask(self, key: int) -> npt.NDArray[np.bool_]:
        """Which vertices (z, y, x) of the box are in the coreset at a key frame."""
        whole = (
            np.unpackbits(self.packed[key], count=prod(self.domain))
            .view(np.bool_)
            .reshape(self.domain)
        )
        return crop(whole, self.box)


def find_extent(
    series: Series,
    scan: Scan,
    key_frames: Sequence[int],
    features: Sequence[Feature],
    dilation: int,
    progress: Progress,
) -> Extent:
    """Where the coreset lies: finite vertices of the merged features, dilated, at every key frame; raises and warns as `build_coreset`."""
    packed: list[npt.NDArray[np.uint8]] = []
    bounds, outside, samples = [], Mean(), 0
    z, y, x = series.shape[1:]
    if not scan.missing and any(isinstance(feature, Everything) for feature in features):
        # Nothing to look at: one mask of ones for all.
        whole = np.packbits(np.ones((z, y, x), dtype=bool))
        for done in range(len(key_frames)):
            progress("selecting", done + 1, len(key_frames), "")
        return Extent(
            box=((0, z), (0, y), (0, x)),
            key_frames=tuple(key_frames),
            packed=[whole] * len(key_frames),
            domain=(z, y, x),
            samples=len(key_frames) * z * y * x,
            background=scan.mean,
        )
    idle = set(features)
    for done, step in enumerate(key_frames):
        frame = series.read(step)
        selected = [feature.select(frame, step) for feature in features]
        idle -= {feature for feature, found in zip(features, selected, strict=True) if found.any()}
        mask, finite = _dilated(np.logical_or.reduce(selected), step, scan, dilation)
        packed.append(np.packbits(mask))
        bounds.append(bounding_box(mask))
        samples += int(np.count_nonzero(mask))
        _add_outside(outside, frame, mask, finite)
        progress("selecting", done + 1, len(key_frames), "")
    box = fuse(bounds)
    if box is None:
        low, high = scan.value_range.low, scan.value_range.high
        names = ", ".join(str(feature) for feature in features)
        raise InputError(
            f"feature {names} selects nothing; values range from {low:.9g} to {high:.9g}"
        )

    for feature in sorted(map(str, idle)):
        warnings.warn(
            f"feature {feature} selects nothing; the others do", FhashWarning, stacklevel=2
        )
    return Extent(
        box=box,
        key_frames=tuple(key_frames),
        packed=packed,
        domain=(z, y, x),
        samples=samples,
        background=outside.value() if outside.count else scan.mean,
    )


def build_coreset(
    series: Series,
    scan: Scan,
    key_frames: Sequence[int],
    features: Sequence[Feature],
    dilation: int,
    progress: Progress,
    *,
    brick: Sizes | None = None,
) -> Coreset:
    """The coreset of a series: finite vertices of the merged features, dilated, at every key frame.

    `features` are resolved, `dilation` is in vertices, `brick` replaces the default brick shape. Raises InputError if the features
    select nothing at all; single key frames may be empty. Warns of a feature
    that selects nothing while others do. Progress stages: "selecting", "gathering".
    """
    extent = find_extent(series, scan, key_frames, features, dilation, progress)
    box, samples = extent.box, extent.samples
    size = box_size(box)
    shape = brick or brick_shape(size)
    grid = (-(-size[0] // shape[0]), -(-size[1] // shape[1]), -(-size[2] // shape[2]))
    values = np.empty(samples, dtype=np.float32)
    grids, layers, filled = [], [], 0
    for key, step in enumerate(key_frames):
        mask = extent.mask(key)
        grids.append(occupancy.pack(mask))
        frame = crop(series.read(step), box)
        for layer in range(grid[0]):
            rows = slice(layer * shape[0], (layer + 1) * shape[0])
            tiles = tile(mask[rows], shape)
            # Boolean indexing walks brick by brick, in C order within a brick.
            found = scan.value_range.to_unit(tile(frame[rows], shape)[tiles])
            values[filled : filled + found.size] = found
            filled += found.size
            layers.append(_layer_bricks(tiles, key, layer))
        progress("gathering", key + 1, len(key_frames), "")
    return Coreset(
        box=box,
        key_frames=tuple(key_frames),
        brick_shape=shape,
        brick_grid=grid,
        bricks=np.concatenate([coordinates for coordinates, _, _ in layers]),
        mask_bits=np.concatenate([bits for _, bits, _ in layers]),
        values=values,
        offsets=np.cumsum(
            np.concatenate([np.zeros(1, dtype=np.int64), *(counts for _, _, counts in layers)])
        ),
        occupancy=tuple(grids),
        fraction=extent.fraction,
        background=extent.background,
    )


def brick_shape(size: Sizes) -> Sizes:
    """Vertices of a brick (z, y, x) for a box of that size: 8 x 8 x 16, and where an axis is shorter the factors of two go to the others.

    No axis gets more than the power of two that covers it; the product is 1024, or less where the whole box is smaller. Then the
    bricks of an axis are made as short as their number allows, so that few of their vertices lie beyond the box.
    """
    room = [(axis - 1).bit_length() for axis in size]
    bits = [min(usual, most) for usual, most in zip(BRICK_BITS, room, strict=True)]
    while sum(bits) < sum(BRICK_BITS) and bits != room:
        # The thinnest axis that has room; x before y before z where equal, since x is contiguous.
        axis = min(
            (axis for axis in (2, 1, 0) if bits[axis] < room[axis]), key=lambda axis: bits[axis]
        )
        bits[axis] += 1
    counts = [-(-axis // 2**bit) for axis, bit in zip(size, bits, strict=True)]
    z, y, x = (-(-axis // count) for axis, count in zip(size, counts, strict=True))
    return z, y, x


def bounding_box(mask: npt.NDArray[np.bool_]) -> Box | None:
    """The smallest box around the vertices of a mask (z, y, x), or None if there are none (paper, Bounding Box)."""
    plane: npt.NDArray[np.bool_] = np.any(mask, axis=0)
    lines = [np.any(mask, axis=(1, 2)), np.any(plane, axis=1), np.any(plane, axis=0)]
    if not plane.any():
        return None
    z, y, x = ((int(line.argmax()), int(line.size - line[::-1].argmax())) for line in lines)
    return z, y, x


def fuse(boxes: Sequence[Box | None]) -> Box | None:
    """The smallest box that holds all the boxes (paper, Temporal Fusion); None if there are none."""
    there = [box for box in boxes if box is not None]
    if not there:
        return None
    z, y, x = (
        (min(low for low, _ in spans), max(high for _, high in spans))
        for spans in zip(*there, strict=True)
    )
    return z, y, x


def box_size(box: Box) -> Sizes:
    """Vertices of a box along each axis."""
    (z0, z1), (y0, y1), (x0, x1) = box
    return z1 - z0, y1 - y0, x1 - x0


def crop(frame: npt.NDArray[Any], box: Box) -> npt.NDArray[Any]:
    """The part of a frame (z, y, x) inside a box, a view."""
    return frame[tuple(slice(low, high) for low, high in box)]


def tile(layer: npt.NDArray[Scalar], shape: Sizes) -> npt.NDArray[Scalar]:
    """One layer of bricks of a box, (up to brick z, y, x), as (grid y, grid x, brick z, y, x); zeros fill the bricks beyond the box."""
    _, y, x = layer.shape
    rows, columns = -(-y // shape[1]), -(-x // shape[2])
    whole = np.zeros((shape[0], rows * shape[1], columns * shape[2]), dtype=layer.dtype)
    whole[: layer.shape[0], :y, :x] = layer
    return whole.reshape(shape[0], rows, shape[1], columns, shape[2]).transpose(1, 3, 0, 2, 4)


def _dilated(
    mask: npt.NDArray[np.bool_], step: int, scan: Scan, dilation: int
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_] | None]:
    """The finite vertices of a feature once it has grown, and which vertices are finite at all (None: all)."""
    mask = dilate(mask, dilation)
    z, y, x = mask.shape
    finite = scan.finite(step, (z, y, x))
    if finite is not None:
        mask &= finite
    return mask, finite


def _add_outside(
    mean: Mean,
    frame: npt.NDArray[Any],
    mask: npt.NDArray[np.bool_],
    finite: npt.NDArray[np.bool_] | None,
) -> None:
    """Take the finite values outside the coreset into a mean, plane by plane so that their float64 copy stays small."""
    for z, plane in enumerate(frame):
        outside = ~mask[z] if finite is None else finite[z] & ~mask[z]
        mean.add(plane[outside])


def _layer_bricks(
    tiles: npt.NDArray[np.bool_], key: int, layer: int
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.uint8], npt.NDArray[np.int64]]:
    """Coordinates (n, 4), packed masks and numbers of samples of the bricks of one layer that hold a sample."""
    flat = tiles.reshape(*tiles.shape[:2], -1)
    y, x = np.nonzero(flat.any(axis=2))
    kept = flat[y, x]
    coordinates = np.stack([np.full_like(y, key), np.full_like(y, layer), y, x], axis=1)
    return coordinates.astype(np.int32), np.packbits(kept, axis=1), kept.sum(axis=1, dtype=np.int64)
