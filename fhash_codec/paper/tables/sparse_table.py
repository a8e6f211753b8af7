"""A level's table of needed vertices alone, written and read (FORMAT.md, Sparse tables).

The embeddings of the needed vertices lie one after the other in C order over (t, z, y, x). Which
vertices these are follows from the occupancy (`needed.Needed`); the file only says how many each
time node has, so that a reader of one node need not look at the others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from itertools import accumulate
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.model_parts import TABLE_AXES
from fhash_codec.paper.number_type import NumberType
from fhash_codec.paper.tables.needed import Mask
from fhash_codec.paper.tables.ranked import SparseFrame
from fhash_formats.container import ContainerWriter
from fhash_formats.container.header import COUNTS
from fhash_formats.errors import DamagedFileError

CHUNK_BYTES = 2 << 20
"""Bytes of a chunk of a table."""
FRAMES = 8
"""Time nodes of a table whose needed embeddings stay in memory."""

Rows = Callable[[int, int], npt.NDArray[Any]]
"""First and end of a run of needed vertices -> their embeddings (end - first, E)."""


class SparseTable:
    """A `TableSource` whose embeddings are 0 at vertices that are not needed.

    Attributes:
        shape: lengths of the axes (t, z, y, x, E).
    """

    def __init__(
        self,
        shape: Sequence[int],
        counts: Sequence[int],
        rows: Rows,
        needed: Callable[[int], Mask],
        name: str,
    ) -> None:
        """Take where the embeddings are and which vertices they belong to.

        Args:
            shape: lengths of the axes (t, z, y, x, E).
            counts: number of needed vertices of each time node.
            rows: reads the embeddings of a run of needed vertices.
            needed: time node -> which of its vertices (z, y, x) are needed.
            name: of the table, for messages.
        """
        self.shape = tuple(shape)
        self._starts = list(accumulate(counts, initial=0))
        self._rows, self._needed, self._name = rows, needed, name
        self.frame = lru_cache(maxsize=FRAMES)(self._frame)

    def read(self, region: tuple[slice, ...]) -> npt.NDArray[Any]:
        """Return the embeddings of a region: 5 slices with explicit ends."""
        frames = [self.frame(node) for node in range(region[0].start, region[0].stop)]
        return np.stack([frame.read(region[1:4]) for frame in frames])[..., region[4]]

    def _frame(self, node: int) -> SparseFrame:
        """Return the needed embeddings of a time node.

        Raises DamagedFileError where the file has another number of them than the occupancy asks
        for.
        """
        mask = self._needed(node)
        first, end = self._starts[node : node + 2]
        if (needed := int(np.count_nonzero(mask))) != end - first:
            raise DamagedFileError(
                f"{self._name} has {end - first} vertices at time node {node}; "
                f"the occupancy asks for {needed}"
            )
        return SparseFrame.of(mask, self._rows(first, end))


def write_sparse(
    writer: ContainerWriter,
    name: str,
    size: int,
    number_type: NumberType,
    counts: Sequence[int],
    held: Iterable[npt.NDArray[Any]],
) -> None:
    """Write the embeddings of the needed vertices of a level.

    Args:
        writer: the container that is being written.
        name: of the array.
        size: numbers E of an embedding.
        number_type: type of the numbers.
        counts: number of needed vertices of each time node.
        held: their embeddings, an array (vertices, E) of that type for each time node.
    """
    length = max(1, CHUNK_BYTES // (size * number_type.dtype.itemsize))
    total = sum(counts)
    writer.add_array(
        name,
        shape=(total, size),
        dtype=number_type.dtype,
        chunk_shape=(min(length, total), size),
        chunks=_chunks(held, length),
        dimension_names=("vertex", TABLE_AXES[4]),
        attributes={**number_type.attributes, COUNTS: list(counts)},
    )


def _chunks(runs: Iterable[npt.NDArray[Any]], length: int) -> Iterator[npt.NDArray[Any]]:
    """Yield the rows of some runs in chunks of a length; the last may be shorter."""
    rest: list[npt.NDArray[Any]] = []
    for run in runs:
        rest.append(run)
        while sum(map(len, rest)) >= length:
            joined = np.concatenate(rest)
            yield joined[:length]
            rest = [joined[length:]]
    if any(map(len, rest)):
        yield np.concatenate(rest)
