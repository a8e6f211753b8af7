"""The tables and the MLP of a compact file, as both profiles present them. numpy only.

The table of level 1 holds the values of the lattice before the head corrects them. Level l is the
low-passed lattice of every 2^(l-1)-th vertex along z, y and x, as the transform has it.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.boxes import Box
from fhash_codec.model_parts import NEIGHBOURS, Mlp, ceil_halvings
from fhash_formats.container import StoredArray
from fhash_formats.transform.head.head import NeighbourHead
from fhash_formats.transform.tile.settings import TileSettings

__all__ = ["CompactTable", "head_mlp", "level_count", "read_coarse"]

MAX_LEVELS = 11
"""Levels of a file at most: level l is level of detail l - 1, of which the coder has 0 to 10."""


def level_count(box: tuple[int, ...]) -> int:
    """Return the number of levels of a box (z, y, x): ceil(log2) of its longest axis, at least 1.

    That is the rule of the paper for a fold of 2 (equations 5 and 6).
    """
    return min(MAX_LEVELS, max(1, (max(box) - 1).bit_length()))


class CompactTable:
    """A `TableSource` of a level, decoded from the tiles of the coded array."""

    def __init__(self, array: StoredArray, halvings: int) -> None:
        """Read every 2^halvings-th vertex of the array (t, z, y, x) of a compact file."""
        steps, *box = array.shape
        self._array, self._halvings = array, halvings
        self.shape = (steps, *ceil_halvings(box, halvings), 1)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the numbers: that of the tables of the tiles."""
        settings = self._array.settings
        return settings.table_dtype if isinstance(settings, TileSettings) else np.dtype(np.float64)

    def read(self, region: tuple[slice, ...]) -> npt.NDArray[Any]:
        """Return the numbers of a region, 5 slices of step 1 with explicit ends."""
        time, *space, last = region
        box = Box.of((along.start, along.stop) for along in space)
        result = np.empty((time.stop - time.start, *box.shape), self.dtype)
        for number, step in enumerate(range(time.start, time.stop)):
            result[number] = read_coarse(
                self._array, step, self._halvings, box, self._array.decode_table, self.dtype
            )
        return result[..., np.newaxis][..., last]


def read_coarse(
    array: StoredArray,
    step: int,
    lod: int,
    region: Box,
    decode: Callable[[tuple[int, ...], int], npt.NDArray[Any]],
    dtype: np.dtype[Any],
) -> npt.NDArray[Any]:
    """Return every 2^lod-th vertex (z, y, x) of a region of the array at a step.

    Each tile is low-passed on its own.

    region: counted in coarse vertices.
    decode: gives a chunk of the array by its index and the level of detail.
    """
    tile, stride = array.chunk_shape, 1 << lod
    result = np.empty([high - low for low, high in region], dtype=dtype)
    grid = [
        range(low * stride // n, (high - 1) * stride // n + 1)
        for (low, high), n in zip(region, tile[1:], strict=True)
    ]
    array.prefetch((range(step // tile[0], step // tile[0] + 1), *grid), lod)
    for index in product(*grid):
        # Coarse vertices of the region that lie in the tile.
        ends = [
            (max(-(-i * n // stride), a), min(-(-(i + 1) * n // stride), b))
            for i, n, (a, b) in zip(index, tile[1:], region, strict=True)
        ]
        if any(first >= stop for first, stop in ends):
            continue
        chunk = decode((step // tile[0], *index), lod)[step % tile[0]]
        target, source = [], []
        for i, n, (first, stop), (low, _), size in zip(
            index, tile[1:], ends, region, chunk.shape, strict=True
        ):
            target.append(slice(first - low, stop - low))
            source.append(_nearest(first, stop, stride, i * n, size))
        result[tuple(target)] = chunk[np.ix_(*source)]
    return result


def head_mlp(head: NeighbourHead | None) -> Mlp:
    """Return the MLP of a head; one without layers where there is none."""
    if head is None:
        return Mlp(weights=(), biases=(), activation="", stencil=NEIGHBOURS)
    weights, biases = zip(*(layer.parameters for layer in head.layers), strict=True)
    return Mlp(
        weights=weights,
        biases=biases,
        activation="leaky",
        stencil=NEIGHBOURS,
        constants={
            "sigma": head.sigma,
            "low": head.low,
            "high": head.high,
            "cross": int(head.cross),
        },
    )


def _nearest(first: int, stop: int, stride: int, start: int, size: int) -> npt.NDArray[np.int64]:
    """Return the vertex of a tile's own coarse lattice that is nearest to each coarse vertex.

    A tile that begins between two coarse vertices has a lattice of its own.

    first, stop: range of the coarse vertices, counted from the beginning of the box.
    start: first vertex of the tile along the axis.
    size: vertices of the tile's own coarse lattice.
    """
    vertices = np.arange(first, stop) * stride - start
    return np.minimum((vertices + stride // 2) // stride, size - 1)
