"""Trained tables before they are coded: their embeddings, and the vertices that are needed."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.boxes import Box
from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.network import Floats
from fhash_codec.paper.tables.bricks import Bricks

Region = tuple[slice, ...]
Mask = npt.NDArray[np.bool_]


class TrainedTable(Protocol):
    """A `TableSource` of a level's trained table that also knows which vertices are needed."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Lengths of the axes (t, z, y, x, E)."""
        ...

    def read(self, region: Region) -> Floats:
        """Return the embeddings (t, z, y, x, E) of a region of 5 slices."""
        ...

    def needed(self, region: Region) -> Mask:
        """Return which vertices (t, z, y, x) of a region some vertex of the coreset depends on.

        The region has at least 4 slices; more are ignored.
        """
        ...


class FinestTable:
    """A `TrainedTable` of the finest level, out of its bricks."""

    def __init__(self, coreset: Coreset, bricks: Bricks, fine: Floats) -> None:
        """Take the embeddings of all bricks, (bricks, E, vertices of a brick)."""
        self._bricks, self._fine = bricks, fine
        self.shape: tuple[int, ...] = (
            len(coreset.key_frames),
            *coreset.box.shape,
            fine.shape[1],
        )

    def read(self, region: Region) -> Floats:
        """Return the embeddings of a region."""
        keys, box = _keys_and_box(region)
        return np.stack([self._bricks.embeddings(self._fine, key, box) for key in keys])[
            ..., region[4]
        ]

    def needed(self, region: Region) -> Mask:
        """Return which vertices of a region are in the coreset."""
        keys, box = _keys_and_box(region)
        return np.stack([self._bricks.mask(key, box) for key in keys])


class CoarseTable:
    """A `TrainedTable` of a coarser level, in memory."""

    def __init__(self, values: Floats, needed: Mask) -> None:
        """Take embeddings (t, z, y, x, E) and the mask (t, z, y, x) of the needed vertices."""
        self._values, self._needed = values, needed
        self.shape: tuple[int, ...] = values.shape

    def read(self, region: Region) -> Floats:
        """Return the embeddings of a region."""
        return self._values[region]

    def needed(self, region: Region) -> Mask:
        """Return which vertices of a region surround a vertex of the coreset."""
        return self._needed[region[:4]]


def trained_tables(
    architecture: Architecture, coreset: Coreset, bricks: Bricks, fine: Floats, tables: list[Floats]
) -> list[TrainedTable]:
    """Return the tables of all levels, finest first.

    Args:
        architecture: the sizes of the tables.
        coreset: the training samples.
        bricks: the bricks of the coreset.
        fine: finest embeddings (bricks, E, vertices of a brick).
        tables: the coarser tables, each (buckets, E).
    """
    size, levels = architecture.embedding_size, architecture.levels
    needed = [np.zeros(level, bool) for level in levels[1:]]
    for key in range(architecture.key_frames):
        # Samples of the fringe need their embeddings as well.
        in_coreset = bricks.mask(key, Box.of((0, n) for n in architecture.box_size))
        for level, level_needed in zip(levels[1:], needed, strict=True):
            around = in_coreset
            for axis in range(3):
                around = spread(around, axis, level[axis + 1])
            first, last = corners(architecture.key_frames, level[0])
            for node in {int(first[key]), int(last[key])}:
                level_needed[node] |= around
    coarse = [
        CoarseTable(table.reshape(*level, size), level_needed)
        for table, level, level_needed in zip(tables, levels[1:], needed, strict=True)
    ]
    return [FinestTable(coreset, bricks, fine), *coarse]


def corners(length: int, resolution: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return the vertices of a level before and after each vertex of the box, along one axis.

    They are the same where a vertex of the box lies on a vertex of the level.

    Args:
        length: vertices of the box along the axis.
        resolution: vertices of the level along the axis.
    """
    before, rest = np.divmod(np.arange(length) * (resolution - 1), max(length - 1, 1))
    return before, before + (rest > 0)


def spread(mask: Mask, axis: int, resolution: int) -> Mask:
    """Return which vertices of a level surround some vertex of a mask, along one axis.

    Args:
        mask: vertices of the box along that axis.
        axis: the axis.
        resolution: vertices of the level along it.
    """
    layers = np.moveaxis(mask, axis, 0)
    result = np.zeros((resolution, *layers.shape[1:]), bool)
    for layer, first, last in zip(layers, *corners(len(layers), resolution), strict=True):
        result[first] |= layer
        result[last] |= layer
    return np.moveaxis(result, 0, axis)


def _keys_and_box(region: Region) -> tuple[range, Box]:
    """Return the key frames and the box of a region of the finest level."""
    t, z, y, x = ((axis.start, axis.stop) for axis in region[:4])
    return range(*t), Box(z, y, x)
