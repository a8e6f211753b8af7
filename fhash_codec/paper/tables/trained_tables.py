"""Trained tables before they are coded: their embeddings, and which of them anything depends on."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset import occupancy
from fhash_codec.coreset.boxes import Box
from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.network import Floats
from fhash_codec.paper.tables.bricks import Bricks

Region = tuple[slice, ...]
Mask = npt.NDArray[np.bool_]


class TrainedTable(Protocol):
    """A level's trained table: `shape` is (t, z, y, x, E); a `TableSource` that also knows what counts."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    def read(self, region: Region) -> Floats:
        """Embeddings (t, z, y, x, E) of a region of 5 slices."""
        ...

    def cares(self, region: Region) -> Mask:
        """Which vertices (t, z, y, x) of a region of 4 slices some vertex of the coreset depends on."""
        ...


class FinestTable:
    """The finest level, out of its bricks (bricks, E, vertices of a brick)."""

    def __init__(self, coreset: Coreset, bricks: Bricks, fine: Floats) -> None:
        self._bricks, self._fine = bricks, fine
        self.shape: tuple[int, ...] = (
            len(coreset.key_frames),
            *coreset.box.shape,
            fine.shape[1],
        )

    def read(self, region: Region) -> Floats:
        """Embeddings of a region."""
        keys, box = _keys_and_box(region)
        return np.stack([self._bricks.embeddings(self._fine, key, box) for key in keys])[
            ..., region[4]
        ]

    def cares(self, region: Region) -> Mask:
        """The coreset."""
        keys, box = _keys_and_box(region)
        return np.stack([self._bricks.mask(key, box) for key in keys])


class CoarseTable:
    """A coarser level in memory (t, z, y, x, E), and what counts of it (t, z, y, x)."""

    def __init__(self, values: Floats, care: Mask) -> None:
        self._values, self._care = values, care
        self.shape: tuple[int, ...] = values.shape

    def read(self, region: Region) -> Floats:
        """Embeddings of a region."""
        return self._values[region]

    def cares(self, region: Region) -> Mask:
        """The vertices around a vertex of the coreset."""
        return self._care[region[:4]]


def trained_tables(
    architecture: Architecture, coreset: Coreset, bricks: Bricks, fine: Floats, tables: list[Floats]
) -> list[TrainedTable]:
    """All levels, finest first. fine: (bricks, E, vertices of a brick); tables: the coarser ones (buckets, E)."""
    size, levels = architecture.embedding_size, architecture.levels
    around = [np.zeros(level, bool) for level in levels[1:]]
    for key in range(architecture.key_frames):
        mask = occupancy.unpack(coreset.occupancy[key], architecture.box_size)
        for level, care in zip(levels[1:], around, strict=True):
            found = mask
            for axis in range(3):
                found = spread(found, axis, level[axis + 1])
            first, last = corners(architecture.key_frames, level[0])
            for node in {int(first[key]), int(last[key])}:
                care[node] |= found
    coarse = [
        CoarseTable(table.reshape(*level, size), care)
        for table, level, care in zip(tables, levels[1:], around, strict=True)
    ]
    return [FinestTable(coreset, bricks, fine), *coarse]


def corners(length: int, resolution: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """The vertices of a level, of so many along an axis, before and after each vertex of the box; both the same where one alone counts."""
    before, rest = np.divmod(np.arange(length) * (resolution - 1), max(length - 1, 1))
    return before, before + (rest > 0)


def spread(mask: Mask, axis: int, resolution: int) -> Mask:
    """Which vertices of a level, along one axis, some vertex of a mask lies between or on."""
    inside = np.moveaxis(mask, axis, 0)
    result = np.zeros((resolution, *inside.shape[1:]), bool)
    for part, first, last in zip(inside, *corners(len(inside), resolution), strict=True):
        result[first] |= part
        result[last] |= part
    return np.moveaxis(result, 0, axis)


def _keys_and_box(region: Region) -> tuple[range, Box]:
    t, z, y, x = ((part.start, part.stop) for part in region[:4])
    return range(*t), Box(z, y, x)
