"""Decoding a region of lattice vertices, with numpy alone.

The law: a region holds the same bits as that slice of the whole frame, whatever the number of threads. It holds by construction:
vertices are computed in blocks at fixed places in the box, always whole blocks by the same products of the same shapes, then cropped.

On the lattice a level is a separable upsampling of a small part of its table, so that a block costs a few small matrix products per level
instead of 16 gathers per vertex.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.boxes import Spans
from fhash_codec.paper.network import ArrayTable, DenseLayers, Floats, Network, TableSource
from fhash_codec.paper.points import sample_points
from fhash_formats.errors import InputError, RegionError
from fhash_formats.support.threads import share_out, usable_threads

__all__ = [
    "ArrayTable",
    "Network",
    "TableSource",
    "block_shape",
    "decode_region",
    "sample_points",
]

BLOCK_VERTICES = 8192
READ_NUMBERS = 2**24
"""Numbers of a table that are read at once for one time node."""


@dataclass(frozen=True)
class AxisPart:
    """What a block needs of one axis of one level: vertices [first, stop) of the table and their weights, float32 (block, stop - first)."""

    first: int
    stop: int
    weights: Floats


@dataclass(frozen=True)
class Piece:
    """The part of one level that a region needs, interpolated in time: float32 (E, z, y, x), and where it begins in the table."""

    values: Floats
    first: tuple[int, int, int]


def decode_region(
    network: Network,
    key_index: float,
    region: Spans,
    *,
    wanted: npt.NDArray[np.bool_] | None = None,
    threads: int | None = None,
) -> Floats:
    """Normalised values float32 (z, y, x) of the vertices of a region at a key index in [0, key_frames - 1], fractional between key frames.

    `wanted` (z, y, x), bool: blocks without a wanted vertex are left NaN and cost nothing; other vertices that are not wanted may
    hold a value or NaN. Threads: None is one per processor. Holds one frame of the region (rounded to blocks) per level.
    Raises RegionError for a region or key index outside the box, InputError for `wanted` of another shape.
    """
    _check(network, key_index, region, wanted)
    threads = usable_threads(threads)
    shape = block_shape(network.box_size)
    result = np.full([stop - start for start, stop in region], np.nan, np.float32)
    blocks = _blocks(shape, region, wanted)
    if not blocks:
        return result
    numbers = [sorted({block[axis] for block in blocks}) for axis in range(3)]
    parts = [
        [
            _axis_parts(network.box_size[axis], level[axis + 1], shape[axis], numbers[axis])
            for axis in range(3)
        ]
        for level in network.levels
    ]
    pieces = [_piece(network, level, key_index, axes) for level, axes in enumerate(parts)]

    def work(share: Sequence[tuple[int, int, int]]) -> None:
        head = DenseLayers(network, math.prod(shape))
        for block in share:
            _encode(network, block, shape, pieces, parts, head)
            values = head.run()[: math.prod(shape)].reshape(shape)
            inside, outside = _crop(block, shape, region)
            result[outside] = values[inside]

    share_out(work, blocks, threads)
    return result


def block_shape(box_size: tuple[int, int, int]) -> tuple[int, int, int]:
    """Vertices (z, y, x) of the blocks of a box: 8 x 16 x 32, doubled along the shortest axes that can grow up to BLOCK_VERTICES together.

    Each axis is split evenly, so that little of the last block hangs over the end. It depends on the box alone.
    """
    shape = [min(size, limit) for size, limit in zip(box_size, (8, 16, 32), strict=True)]
    while (
        growing := [axis for axis in (2, 1, 0) if shape[axis] < box_size[axis]]
    ) and 2 * math.prod(shape) <= BLOCK_VERTICES:
        axis = min(growing, key=lambda axis: shape[axis])
        shape[axis] = min(2 * shape[axis], box_size[axis])
    z, y, x = (-(-size // -(-size // limit)) for size, limit in zip(box_size, shape, strict=True))
    return z, y, x


def _check(
    network: Network, key_index: float, region: Spans, wanted: npt.NDArray[np.bool_] | None
) -> None:
    if not 0 <= key_index <= network.key_frames - 1:
        raise RegionError(f"key index {key_index} is outside 0..{network.key_frames - 1}")
    for axis, (start, stop), size in zip("zyx", region, network.box_size, strict=True):
        if not 0 <= start < stop <= size:
            raise RegionError(f"region {axis} {start}:{stop} is empty or outside the box, 0:{size}")
    shape = tuple(stop - start for start, stop in region)
    if wanted is not None and (wanted.shape != shape or wanted.dtype != np.bool_):
        raise InputError(
            f"wanted is {wanted.dtype} {wanted.shape}; a bool array {shape} is needed, as large as the region"
        )


def _blocks(
    shape: Sequence[int], region: Spans, wanted: npt.NDArray[np.bool_] | None
) -> list[tuple[int, int, int]]:
    """Numbers (z, y, x) of the blocks that touch the region and hold a wanted vertex."""
    z, y, x = (
        range(start // length, (stop - 1) // length + 1)
        for (start, stop), length in zip(region, shape, strict=True)
    )
    blocks = list(product(z, y, x))
    if wanted is None:
        return blocks
    return [block for block in blocks if wanted[_crop(block, shape, region)[1]].any()]


def _crop(
    block: Sequence[int], shape: Sequence[int], region: Spans
) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Where a block and a region meet: slices of the block and slices of the region."""
    inside, outside = [], []
    for number, length, (start, stop) in zip(block, shape, region, strict=True):
        first, last = max(number * length, start), min((number + 1) * length, stop)
        inside.append(slice(first - number * length, last - number * length))
        outside.append(slice(first - start, last - start))
    return tuple(inside), tuple(outside)


def _axis_parts(
    size: int, resolution: int, length: int, numbers: Iterable[int]
) -> dict[int, AxisPart]:
    """The parts that blocks of a length need of one axis, by number of the block.

    Vertex i lies at i (R - 1) / (S - 1), in whole numbers, so that a vertex on a corner has exactly its embedding.
    Weights are computed in float64.
    """
    span = max(size - 1, 1)
    corner, rest = np.divmod(np.arange(size) * (resolution - 1), span)
    parts = {}
    for number in numbers:
        vertices = slice(number * length, min((number + 1) * length, size))
        before, after = corner[vertices], rest[vertices] / span
        first = int(before[0])
        stop = int(before[-1]) + (2 if after[-1] > 0 else 1)
        # A column to spare, for the corner after the last, which may not be needed. Rows past the end of the box stay zero and are cropped.
        weights = np.zeros((length, stop - first + 1))
        row = np.arange(len(before))
        weights[row, before - first] = 1 - after
        weights[row, before - first + 1] = after
        parts[number] = AxisPart(first, stop, weights[:, :-1].astype(np.float32))
    return parts


def _piece(
    network: Network, level: int, key_index: float, axes: Sequence[dict[int, AxisPart]]
) -> Piece:
    """Read what all blocks need of a level, a few large reads at the one or two time nodes, and interpolate it in time."""
    nodes = network.levels[level][0]
    position = key_index * (nodes - 1) / max(network.key_frames - 1, 1)
    node = min(int(position), nodes - 1)
    weight = np.float32(position - node)
    time = slice(node, node + 1 if weight == 0 else node + 2)
    (z0, z1), (y0, y1), (x0, x1) = (
        (min(p.first for p in parts.values()), max(p.stop for p in parts.values()))
        for parts in axes
    )
    values = np.empty((network.embedding_size, z1 - z0, y1 - y0, x1 - x0), np.float32)
    planes = max(1, READ_NUMBERS // values[:, 0].size)
    for start in range(z0, z1, planes):
        stop = min(start + planes, z1)
        nodes_read = network.read(level, (time, slice(start, stop), slice(y0, y1), slice(x0, x1)))
        frame = nodes_read[0].astype(np.float32, copy=False)
        if weight != 0:
            frame = frame * (1 - weight) + nodes_read[1] * weight
        values[:, start - z0 : stop - z0] = np.moveaxis(frame, -1, 0)
    return Piece(values, (z0, y0, x0))


def _encode(
    network: Network,
    block: tuple[int, int, int],
    shape: tuple[int, int, int],
    pieces: Sequence[Piece],
    parts: Sequence[Sequence[dict[int, AxisPart]]],
    head: DenseLayers,
) -> None:
    """Fill the head's inputs with the interpolated embeddings of a block: x first, while the part is smallest, then y, then z."""
    size, (bz, by, bx) = network.embedding_size, shape
    for level, (piece, axes) in enumerate(zip(pieces, parts, strict=True)):
        z, y, x = (axes[axis][block[axis]] for axis in range(3))
        slices = (
            slice(part.first - first, part.stop - first)
            for part, first in zip((z, y, x), piece.first, strict=True)
        )
        values = piece.values[(slice(None), *slices)]
        rows = head.inputs[level * size : (level + 1) * size, : bz * by * bx]
        if network.levels[level][1:] == network.box_size:
            # The table's vertices are the box's: nothing to interpolate, only the end of the box to pad.
            whole = rows.reshape(size, bz, by, bx)
            if values.shape != whole.shape:
                whole[...] = 0.0
            whole[tuple(slice(length) for length in values.shape)] = values
        else:
            upsampled = y.weights @ (values @ x.weights.T)
            np.matmul(
                z.weights, upsampled.reshape(size, -1, by * bx), out=rows.reshape(size, bz, by * bx)
            )
