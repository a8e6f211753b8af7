"""Decoding of a region of lattice vertices, with numpy alone.

A region holds the same bits as that slice of the whole frame, whatever the number of threads. This
law holds by construction: vertices are computed in blocks at fixed places in the box, always as
whole blocks, by the same products of the same shapes (`network.DenseLayers`), and then cropped.

On the lattice a level is a separable upsampling of a small part of its table. A block therefore
costs a few small matrix products per level instead of 16 table look-ups per vertex.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.boxes import Spans
from fhash_codec.paper.network import DenseLayers, Floats, Network
from fhash_codec.paper.tables.ranked import SparseFrame, between
from fhash_formats.errors import InputError, RegionError
from fhash_formats.support.threads import share_out, usable_threads

BLOCK_VERTICES = 8192
"""Largest number of vertices in a block."""
ROW_COLUMNS = 32
"""Usual vertices of a block along x, two rows to a product."""
MIN_SHIFT = 5
"""Columns at least by which a plane of a block begins before or after the column of the last one.

With 5 columns, the sparse blocks of a shock's feature take 0.19 of their products; with none, 0.45.
"""
READ_NUMBERS = 2**24
"""Numbers of a table that are read at once for one time node."""

SMALL_NUMBERS = 2**18
"""Numbers up to which the part of a level that holds some vertices only gets all vertices.

Blocks then take them without looking for their places.
"""

Scalar = TypeVar("Scalar", bound=np.generic)
BlockIndex = tuple[int, int, int]
"""Place (z, y, x) of a block in the grid of blocks."""


@dataclass(frozen=True)
class AxisWeights:
    """Weights that interpolate the vertices of a block along one axis of one level.

    Attributes:
        first, stop: vertices [first, stop) of the level between which the block lies.
        weights: float32 (vertices of the block, stop - first).
    """

    first: int
    stop: int
    weights: Floats


LevelWeights = tuple[dict[int, AxisWeights], ...]
"""Weights of one level for each axis (z, y, x), by the block's place along that axis."""


class LevelWindow(Protocol):
    """The part of one level that a region needs, at one time."""

    def read(self, box: tuple[slice, ...]) -> Floats:
        """Return the embeddings float32 (E, z, y, x) of a box in vertices of the level."""
        ...


@dataclass(frozen=True)
class DenseWindow:
    """A `LevelWindow` in memory.

    Attributes:
        values: embeddings interpolated in time, float32 (E, z, y, x).
        first: vertex (z, y, x) of the level at which the window begins.
    """

    values: Floats
    first: tuple[int, int, int]

    def read(self, box: tuple[slice, ...]) -> Floats:
        """Return a box as a view."""
        inside = (
            slice(axis.start - first, axis.stop - first)
            for axis, first in zip(box, self.first, strict=True)
        )
        return self.values[(slice(None), *inside)]


@dataclass(frozen=True)
class SparseWindow:
    """A `LevelWindow` of a level that holds some vertices only; it is the whole level.

    Attributes:
        frame: the embeddings interpolated in time.
    """

    frame: SparseFrame

    def read(self, box: tuple[slice, ...]) -> Floats:
        """Return a box as a copy."""
        return np.moveaxis(self.frame.read(box).astype(np.float32, copy=False), -1, 0)


def decode_region(
    network: Network,
    key_index: float,
    region: Spans,
    *,
    requested: npt.NDArray[np.bool_] | None = None,
    threads: int | None = None,
) -> Floats:
    """Return the normalised values float32 (z, y, x) at the vertices of a region.

    The memory for one frame of the region, rounded to blocks, is needed per level; for a level that
    holds some vertices only, that of these vertices.

    Args:
        network: the trained network.
        key_index: time in 0 .. key_frames - 1, fractional between key frames.
        region: spans (z, y, x) in vertices of the feature bounding box.
        requested: bool (z, y, x), the vertices whose values are needed; all if left out. A block
            without a requested vertex is NaN and costs nothing. Other vertices that were not
            requested hold either a value or NaN.
        threads: number of threads; None for one per processor.

    Raises:
        RegionError: the region or the key index is outside the box.
        InputError: `requested` has another shape or type.
    """
    _check(network, key_index, region, requested)
    threads = usable_threads(threads)
    shape = block_shape(network.box_size)
    result = np.full([stop - start for start, stop in region], np.nan, np.float32)
    blocks = _blocks(shape, region, requested)
    if not blocks:
        return result
    weights = [_level_weights(network, level[1:], shape, blocks) for level in network.levels]
    windows = [
        _level_window(network, level, key_index, level_weights)
        for level, level_weights in enumerate(weights)
    ]

    def decode(share: Sequence[BlockIndex]) -> None:
        samples = shape[0] * _plane_samples(shape)
        layers = DenseLayers(network, samples)
        in_block = np.zeros(samples, np.bool_)
        for block in share:
            _encode(network, block, shape, windows, weights, layers)
            inside_block, inside_region = _overlap(block, shape, region)
            if requested is None:
                outputs = layers.run()
            else:
                in_block[:] = False
                _in_planes(in_block, shape)[inside_block] = requested[inside_region]
                outputs = layers.run_some(in_block)
            result[inside_region] = _in_planes(outputs[:samples], shape)[inside_block]

    share_out(decode, blocks, threads)
    return result


def block_shape(box_size: tuple[int, int, int]) -> tuple[int, int, int]:
    """Return the vertices (z, y, x) of the blocks of a box. They depend on the box alone.

    A block has 8 x 16 x 32 vertices. Its shortest axes that can still grow are doubled, as long as
    the block has at most BLOCK_VERTICES. Each axis is then split evenly, so that little of the last
    block lies beyond the end of the box.
    """
    shape = [min(size, limit) for size, limit in zip(box_size, (8, 16, 32), strict=True)]
    while (
        growing := [axis for axis in (2, 1, 0) if shape[axis] < box_size[axis]]
    ) and 2 * math.prod(shape) <= BLOCK_VERTICES:
        axis = min(growing, key=lambda axis: shape[axis])
        shape[axis] = min(2 * shape[axis], box_size[axis])
    z, y, x = (-(-size // -(-size // limit)) for size, limit in zip(box_size, shape, strict=True))
    return z, y, x


def _plane_samples(shape: Sequence[int]) -> int:
    """Return the samples of `DenseLayers` that a plane (y, x) of a block takes, unused ones last.

    Planes that began in the same column of a product, or nearly so, would have the vertices of a
    feature below each other, and then they could not move to fewer products.
    """
    samples = shape[1] * shape[2]
    while shape[0] > 1 and not MIN_SHIFT <= samples % ROW_COLUMNS <= ROW_COLUMNS - MIN_SHIFT:
        samples += 1
    return samples


def _in_planes(samples: npt.NDArray[Scalar], shape: Sequence[int]) -> npt.NDArray[Scalar]:
    """Return the samples (..., z * plane) of a block as a view (..., z, y, x)."""
    leading = samples.shape[:-1]
    planes = samples.reshape(*leading, shape[0], -1)
    return planes[..., : shape[1] * shape[2]].reshape(*leading, *shape)


def _check(
    network: Network, key_index: float, region: Spans, requested: npt.NDArray[np.bool_] | None
) -> None:
    if not 0 <= key_index <= network.key_frames - 1:
        raise RegionError(f"key index {key_index} is outside 0..{network.key_frames - 1}")
    for axis, (start, stop), size in zip("zyx", region, network.box_size, strict=True):
        if not 0 <= start < stop <= size:
            raise RegionError(f"region {axis} {start}:{stop} is empty or outside the box, 0:{size}")
    shape = tuple(stop - start for start, stop in region)
    if requested is not None and (requested.shape != shape or requested.dtype != np.bool_):
        raise InputError(
            f"requested is {requested.dtype} {requested.shape}; "
            f"a bool array {shape} is needed, as large as the region"
        )


def _blocks(
    shape: Sequence[int], region: Spans, requested: npt.NDArray[np.bool_] | None
) -> list[BlockIndex]:
    """Return the places of the blocks that touch the region and hold a requested vertex."""
    z, y, x = (
        range(start // length, (stop - 1) // length + 1)
        for (start, stop), length in zip(region, shape, strict=True)
    )
    blocks = list(product(z, y, x))
    if requested is None:
        return blocks
    return [block for block in blocks if requested[_overlap(block, shape, region)[1]].any()]


def _overlap(
    block: BlockIndex, shape: Sequence[int], region: Spans
) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Return the overlap of a block and a region: as slices of the block, and of the region."""
    inside_block, inside_region = [], []
    for place, length, (start, stop) in zip(block, shape, region, strict=True):
        first, last = max(place * length, start), min((place + 1) * length, stop)
        inside_block.append(slice(first - place * length, last - place * length))
        inside_region.append(slice(first - start, last - start))
    return tuple(inside_block), tuple(inside_region)


def _level_weights(
    network: Network,
    resolution: Sequence[int],
    shape: Sequence[int],
    blocks: Sequence[BlockIndex],
) -> LevelWeights:
    """Return the weights that interpolate a level of resolution (z, y, x) at some blocks."""
    return tuple(
        _axis_weights(size, vertices, length, sorted(set(places)))
        for size, vertices, length, places in zip(
            network.box_size, resolution, shape, zip(*blocks, strict=True), strict=True
        )
    )


def _axis_weights(
    size: int, resolution: int, length: int, places: Iterable[int]
) -> dict[int, AxisWeights]:
    """Return the weights of blocks along one axis, by the place of the block.

    Vertex i of the box lies at i (R - 1) / (S - 1) of the level. The whole part of that is computed
    in integers, so that a vertex on a corner gets exactly that corner's embedding. The weights are
    computed in float64 and rounded to float32.

    Args:
        size: vertices S of the box along the axis.
        resolution: vertices R of the level along the axis.
        length: vertices of a block along the axis.
        places: places of the blocks along the axis.
    """
    span = max(size - 1, 1)
    corner, rest = np.divmod(np.arange(size) * (resolution - 1), span)
    weights_of = {}
    for place in places:
        vertices = slice(place * length, min((place + 1) * length, size))
        before, after_weight = corner[vertices], rest[vertices] / span
        first = int(before[0])
        stop = int(before[-1]) + (2 if after_weight[-1] > 0 else 1)
        # The spare last column takes the weight of a corner after the last one, which may be 0 and
        # then has no column. Rows beyond the end of the box stay 0 and are cropped.
        weights = np.zeros((length, stop - first + 1))
        row = np.arange(len(before))
        weights[row, before - first] = 1 - after_weight
        weights[row, before - first + 1] = after_weight
        weights_of[place] = AxisWeights(first, stop, weights[:, :-1].astype(np.float32))
    return weights_of


def _level_window(
    network: Network, level: int, key_index: float, weights: LevelWeights
) -> LevelWindow:
    """Read the part of a level that all blocks need, and interpolate it in time.

    The part is read at the one or two time nodes around the key index, in a few large reads. A
    large part of a level that holds some vertices only does not become an array of all vertices.
    """
    last = network.levels[level][0] - 1
    position = key_index * last / max(network.key_frames - 1, 1)
    node = min(int(position), last)
    after_weight = np.float32(position - node)
    time = slice(node, node + 1 if after_weight == 0 else node + 2)
    (z0, z1), (y0, y1), (x0, x1) = (
        (min(w.first for w in axis.values()), max(w.stop for w in axis.values()))
        for axis in weights
    )
    numbers = network.embedding_size * (z1 - z0) * (y1 - y0) * (x1 - x0)
    if numbers > SMALL_NUMBERS and (frame := network.sparse_frame(level, node)) is not None:
        after = None if after_weight == 0 else network.sparse_frame(level, node + 1)
        return SparseWindow(frame if after is None else between(frame, after, after_weight))
    values = np.empty((network.embedding_size, z1 - z0, y1 - y0, x1 - x0), np.float32)
    planes = max(1, READ_NUMBERS // values[:, 0].size)
    for start in range(z0, z1, planes):
        stop = min(start + planes, z1)
        nodes = network.read(level, (time, slice(start, stop), slice(y0, y1), slice(x0, x1)))
        dense = nodes[0].astype(np.float32, copy=False)
        if after_weight != 0:
            dense = dense * (1 - after_weight) + nodes[1] * after_weight
        values[:, start - z0 : stop - z0] = np.moveaxis(dense, -1, 0)
    return DenseWindow(values, (z0, y0, x0))


def _encode(
    network: Network,
    block: BlockIndex,
    shape: tuple[int, int, int],
    windows: Sequence[LevelWindow],
    weights: Sequence[LevelWeights],
    layers: DenseLayers,
) -> None:
    """Fill the inputs of the layers with the interpolated embeddings of a block.

    Each level is interpolated along x first, while it is smallest, then along y, then along z.
    """
    size, (bz, by, bx) = network.embedding_size, shape
    for level, (window, level_weights) in enumerate(zip(windows, weights, strict=True)):
        z, y, x = (level_weights[axis][block[axis]] for axis in range(3))
        values = window.read(tuple(slice(axis.first, axis.stop) for axis in (z, y, x)))
        rows = _in_planes(
            layers.inputs[level * size : (level + 1) * size, : bz * _plane_samples(shape)], shape
        )
        if network.levels[level][1:] == network.box_size:
            # The vertices of the level are those of the box: only the end of the box needs padding.
            if values.shape != rows.shape:
                rows[...] = 0.0
            rows[tuple(slice(length) for length in values.shape)] = values
        else:
            upsampled = y.weights @ (values @ x.weights.T)
            planes = rows.reshape(size, bz, by * bx)
            np.matmul(z.weights, upsampled.reshape(size, -1, by * bx), out=planes)
