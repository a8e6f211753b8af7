"""Parts of a model that both profiles present alike: tables and MLP (FORMAT.md, The model)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from fhash_codec.indexing import Index, expand_index, index_ranges
from fhash_formats.series import AXES

__all__ = ["CORNERS", "NEIGHBOURS", "Mlp", "Table", "TableSource", "ceil_halvings"]

CORNERS = "corners"
"""Stencil of the profile paper: the 16 corners around a point in every level, interpolated."""
NEIGHBOURS = "neighbours"
"""Stencil of the profile compact: a vertex of level 1 and its neighbours."""

TABLE_AXES = (*AXES, "embedding")
"""Names of the axes of a table."""


class TableSource(Protocol):
    """The numbers of a table, in memory or in a file."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Lengths of the axes (t, z, y, x, E)."""
        ...

    def read(self, region: tuple[slice, ...]) -> npt.NDArray[Any]:
        """Return a region: 5 slices of step 1 with explicit ends."""
        ...


class Table:
    """The table of one level, an array (t, z, y, x, E) that is decoded as it is read.

    t counts key frames, and z, y, x vertices of the level within the feature bounding box. Basic
    indexing works as in numpy; `np.asarray(table)` decodes all of it.

    Attributes:
        level: number of the level; 1 is the finest.
        shape: lengths of the axes.
        dtype: type of the numbers.
    """

    ndim = 5

    def __init__(self, level: int, source: TableSource, dtype: npt.DTypeLike) -> None:
        self.level, self._source = level, source
        self.shape = tuple(int(n) for n in source.shape)
        self.dtype = np.dtype(dtype)

    def __getitem__(self, index: Index | tuple[Index, ...]) -> npt.NDArray[Any]:
        """Numbers by integers, slices and `...`. Raises RegionError for other indices."""
        parts = expand_index(index, TABLE_AXES, "a table")
        ranges = index_ranges(parts, self.shape, TABLE_AXES)
        if not all(ranges):
            values = np.empty([len(positions) for positions in ranges], self.dtype)
        else:
            spans = [(min(positions), max(positions) + 1) for positions in ranges]
            read = self._source.read(tuple(slice(*span) for span in spans))
            places = zip(ranges, spans, strict=True)
            values = read[np.ix_(*(np.array(at) - first for at, (first, _) in places))]
        return values[tuple(slice(None) if isinstance(part, slice) else 0 for part in parts)]

    def __array__(
        self, dtype: npt.DTypeLike | None = None, copy: bool | None = None
    ) -> npt.NDArray[Any]:
        """All numbers, decoded."""
        if copy is False:
            raise ValueError("a table cannot become an array without a copy: it is decoded")
        values = self[...]
        return values if dtype is None else values.astype(dtype)

    def __len__(self) -> int:
        return self.shape[0]

    def __repr__(self) -> str:
        return f"<fhash Table level {self.level} {self.shape} {self.dtype}>"


@dataclass(frozen=True, kw_only=True, eq=False)
class Mlp:
    """The network behind the tables: layers of weights and biases, the last with one output.

    Attributes:
        weights: matrix (outputs, inputs) of each layer, float32.
        biases: vector (outputs,) of each layer, float32.
        activation: function between layers, "relu" or "leaky" (slope 1/8 below 0); "" where there
            are no layers, so that the values are those of the table.
        stencil: what the first layer sees, `CORNERS` or `NEIGHBOURS`.
        constants: further numbers of the head of the profile compact: `sigma`, `low` and `high`, in
            data units, and `cross`, 1 where the second layer sees the first one's outputs at nine
            vertices.
    """

    weights: tuple[npt.NDArray[np.float32], ...]
    biases: tuple[npt.NDArray[np.float32], ...]
    activation: str
    stencil: str
    constants: Mapping[str, float] = field(default_factory=dict)

    @property
    def layers(self) -> tuple[tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]], ...]:
        """(weights, biases) of each layer."""
        return tuple(zip(self.weights, self.biases, strict=True))

    @property
    def parameters(self) -> int:
        """Number of weights and biases."""
        return sum(array.size for array in (*self.weights, *self.biases))


def ceil_halvings(shape: Sequence[int], halvings: int) -> tuple[int, ...]:
    """Vertices (z, y, x) after some halvings, each rounded up."""
    return tuple(-(-n // (1 << halvings)) for n in shape)
