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
from fhash_codec.paper.tables.needed import needed_by

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
    """A `TrainedTable` of the finest level, out of its samples."""

    def __init__(self, coreset: Coreset, bricks: Bricks, fine: Floats) -> None:
        """Take the embeddings (E, samples), in the order of `Coreset.values`."""
        self._bricks, self._fine = bricks, fine
        self.shape: tuple[int, ...] = (
            len(coreset.key_frames),
            *coreset.box.shape,
            len(fine),
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
        fine: finest embeddings (E, samples), in the order of `Coreset.values`.
        tables: the coarser tables, each (buckets, E).
    """
    size, levels = architecture.embedding_size, architecture.levels
    needed = needed_by(architecture, coreset)
    coarse = [
        CoarseTable(
            table.reshape(*level, size),
            np.stack([needed.mask(number, node) for node in range(level[0])]),
        )
        for number, (table, level) in enumerate(zip(tables, levels[1:], strict=True), start=1)
    ]
    return [FinestTable(coreset, bricks, fine), *coarse]


def _keys_and_box(region: Region) -> tuple[range, Box]:
    """Return the key frames and the box of a region of the finest level."""
    t, z, y, x = ((axis.start, axis.stop) for axis in region[:4])
    return range(*t), Box(z, y, x)
