"""The training samples: the vertices of the dilated features, gathered in bricks of the feature bounding box (paper, Coreset Selection).

Two passes over the key frames, one frame at a time. The first keeps one bit per vertex of the domain and finds the box; the second
crops, normalises and gathers the values of the selected vertices brick by brick.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset import occupancy
from fhash_codec.coreset.boxes import Box, Sizes
from fhash_codec.coreset.extent import find_extent
from fhash_codec.coreset.features import Feature
from fhash_codec.coreset.scan import Scan
from fhash_codec.progress import Progress
from fhash_formats.series import Series

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
    size = box.shape
    shape = brick or brick_shape(size)
    grid = (-(-size[0] // shape[0]), -(-size[1] // shape[1]), -(-size[2] // shape[2]))
    values = np.empty(samples, dtype=np.float32)
    grids, layers, filled = [], [], 0
    for key, step in enumerate(key_frames):
        mask = extent.mask(key)
        grids.append(occupancy.pack(mask))
        frame = series.read(step)[box.slices()]
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


def tile(layer: npt.NDArray[Scalar], shape: Sizes) -> npt.NDArray[Scalar]:
    """One layer of bricks of a box, (up to brick z, y, x), as (grid y, grid x, brick z, y, x); zeros fill the bricks beyond the box."""
    _, y, x = layer.shape
    rows, columns = -(-y // shape[1]), -(-x // shape[2])
    whole = np.zeros((shape[0], rows * shape[1], columns * shape[2]), dtype=layer.dtype)
    whole[: layer.shape[0], :y, :x] = layer
    return whole.reshape(shape[0], rows, shape[1], columns, shape[2]).transpose(1, 3, 0, 2, 4)


def _layer_bricks(
    tiles: npt.NDArray[np.bool_], key: int, layer: int
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.uint8], npt.NDArray[np.int64]]:
    """Coordinates (n, 4), packed masks and numbers of samples of the bricks of one layer that hold a sample."""
    flat = tiles.reshape(*tiles.shape[:2], -1)
    y, x = np.nonzero(flat.any(axis=2))
    kept = flat[y, x]
    coordinates = np.stack([np.full_like(y, key), np.full_like(y, layer), y, x], axis=1)
    return coordinates.astype(np.int32), np.packbits(kept, axis=1), kept.sum(axis=1, dtype=np.int64)
