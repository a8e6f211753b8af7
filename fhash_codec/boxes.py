"""Boxes of vertices, numpy's basic indexing, and what makes an array of a volume or a table."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import EllipsisType
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError, RegionError
from fhash_formats.series import AXES

Sizes = tuple[int, int, int]
"""One number per axis, (z, y, x)."""

Span = tuple[int, int]
"""(first, end) along one axis in vertices; `end` is the vertex after the last one."""

Spans = tuple[Span, Span, Span]
"""Spans along z, y and x: a `Box`, or a plain tuple that stands for one."""


class Box(NamedTuple):
    """A box of vertices: one half-open span along each axis.

    It equals the plain tuple of its spans. Feature bounding boxes count vertices of the domain.
    Regions count vertices of the domain, or of the feature bounding box: the function that takes a
    region says which.
    """

    z: Span
    y: Span
    x: Span

    @classmethod
    def of(cls, spans: Iterable[Sequence[int]]) -> Box:
        """The box of three spans (first, end) in the order z, y, x."""
        z, y, x = ((first, end) for first, end in spans)
        return cls(z, y, x)

    @classmethod
    def of_shape(cls, shape: Iterable[int]) -> Box:
        """The box that holds every vertex of a grid of this shape (z, y, x)."""
        return cls.of((0, length) for length in shape)

    @property
    def first(self) -> Sizes:
        """The lowest vertex (z, y, x)."""
        return self.z[0], self.y[0], self.x[0]

    @property
    def shape(self) -> Sizes:
        """Vertices along each axis (z, y, x)."""
        (z0, z1), (y0, y1), (x0, x1) = self
        return z1 - z0, y1 - y0, x1 - x0

    def slices(self) -> tuple[slice, slice, slice]:
        """The index of the box's vertices in an array (z, y, x): `frame[box.slices()]`."""
        return slice(*self.z), slice(*self.y), slice(*self.x)

    def shift(self, offset: Iterable[int]) -> Box:
        """The box moved by an offset (z, y, x) in vertices."""
        moves = zip(self, offset, strict=True)
        return Box.of((first + move, end + move) for (first, end), move in moves)

    def intersect(self, other: Spans) -> Box | None:
        """The vertices that both boxes hold; None if there are none."""
        common = [
            (max(first, other_first), min(end, other_end))
            for (first, end), (other_first, other_end) in zip(self, other, strict=True)
        ]
        return Box.of(common) if all(first < end for first, end in common) else None


def bounding_box(mask: npt.NDArray[np.bool_]) -> Box | None:
    """The smallest box around the True vertices of a mask (z, y, x) (paper, Bounding Box).

    None if no vertex is True.
    """
    plane: npt.NDArray[np.bool_] = np.any(mask, axis=0)
    lines = [np.any(mask, axis=(1, 2)), np.any(plane, axis=1), np.any(plane, axis=0)]
    if not plane.any():
        return None
    return Box.of((int(line.argmax()), int(line.size - line[::-1].argmax())) for line in lines)


def fuse(boxes: Sequence[Box | None]) -> Box | None:
    """The smallest box that holds all boxes (paper, Temporal Fusion); None if all are None."""
    some = [box for box in boxes if box is not None]
    if not some:
        return None
    return Box.of(
        (min(first for first, _ in spans), max(end for _, end in spans))
        for spans in zip(*some, strict=True)
    )


MAX_LOD = 10
"""Coarsest level of detail: every 1024th vertex."""

Index = int | slice | EllipsisType
"""One part of an index."""


def expand_index(
    index: Index | tuple[Index, ...], axes: Sequence[str] = AXES, what: str = "a volume"
) -> list[int | slice]:
    """One integer or slice per axis: full slices replace `...` and missing axes.

    axes: names of the axes. what: what is indexed, for messages.

    Raises RegionError for other kinds of indices, and for too many parts.
    """
    parts = list(index) if isinstance(index, tuple) else [index]
    for part in parts:
        if part is not Ellipsis and (
            isinstance(part, bool) or not isinstance(part, int | np.integer | slice)
        ):
            raise RegionError(
                f"{what} is indexed by integers, slices and '...', "
                f"not by {type(part).__name__}; take np.asarray of it for more"
            )
    ellipses = [number for number, part in enumerate(parts) if part is Ellipsis]
    if len(ellipses) > 1 or len(parts) - len(ellipses) > len(axes):
        names = ", ".join(axes)
        raise RegionError(
            f"{what} has {len(axes)} axes ({names}); the index has {len(parts)} parts"
        )
    at = ellipses[0] if ellipses else len(parts)
    fill = [slice(None)] * (len(axes) - len(parts) + len(ellipses))
    expanded = [*parts[:at], *fill, *parts[at + len(ellipses) :]]
    return [part for part in expanded if part is not Ellipsis]


def index_ranges(
    parts: Sequence[int | slice], shape: Sequence[int], axes: Sequence[str] = AXES
) -> list[range]:
    """The positions along each axis that an expanded index names.

    Raises RegionError for an integer outside its axis.
    """
    return [
        _positions(part, length, axis)
        for part, length, axis in zip(parts, shape, axes, strict=True)
    ]


def _positions(part: int | slice, length: int, axis: str) -> range:
    if isinstance(part, slice):
        return range(length)[part]
    if not -length <= part < length:
        raise RegionError(f"index {part} is outside axis {axis} of {length}")
    return range(part % length, part % length + 1)


def slice_of(positions: range, first: int) -> slice:
    """The slice that takes positions of an axis from an array that begins at `first` of it."""
    start, stop = positions.start - first, positions.stop - first
    # A stop before the first position would count from the end.
    return slice(start, stop if stop >= 0 else None, positions.step)


def checked_region(region: Spans | None, shape: Sequence[int], path: str) -> Box:
    """The box of a region in vertices (z, y, x) of a domain; the whole domain for None.

    Raises RegionError, naming the path, for a region that is empty or outside the domain.
    """
    if region is None:
        return Box.of_shape(shape)
    for axis, (low, high), length in zip(AXES[1:], region, shape, strict=True):
        if not 0 <= low < high <= length:
            raise RegionError(
                f"{path}: region {low}:{high} of axis {axis} is empty or outside 0:{length}"
            )
    return Box.of(region)


def coarse_vertices(box: Box, region: Box, lod: int, path: str) -> tuple[range, range, range]:
    """Every 2^lod-th vertex (z, y, x) of the feature bounding box that lies in a region.

    Raises InputError for another level of detail than 0 to MAX_LOD, RegionError, naming the path,
    for a region without such a vertex.
    """
    if isinstance(lod, bool) or not isinstance(lod, int | np.integer) or not 0 <= lod <= MAX_LOD:
        raise InputError(f"lod is {lod}; allowed: 0 to {MAX_LOD}")
    every = 1 << int(lod)
    vertices = []
    for axis, (first, end), (low, high) in zip(AXES[1:], box, region, strict=True):
        start = first + -(-max(low - first, 0) // every) * every
        along = range(start, min(high, end), every)
        if not along:
            raise RegionError(
                f"{path}: region {low}:{high} of axis {axis} holds no vertex of level of "
                f"detail {lod}, every {every}. from {first} to {end - 1}"
            )
        vertices.append(along)
    z, y, x = vertices
    return z, y, x


def overlap(box: Box, region: Box) -> tuple[Box, Box] | None:
    """The vertices that a region shares with a box; None if there are none.

    They are returned twice: in vertices of the region, and in vertices of the box.
    """
    common = box.intersect(region)
    if common is None:
        return None
    in_region = common.shift(-first for first in region.first)
    return in_region, common.shift(-first for first in box.first)


class ArrayLike:
    """An array to numpy, decoded as it is indexed.

    A subclass adds its shape and type, the names of its axes, and how values are decoded.

    Attributes:
        dims: names of the axes.
        what: what is indexed, for messages.
    """

    dims: tuple[str, ...] = AXES
    what = "a volume"
    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    def _decoded(self, ranges: Sequence[range]) -> npt.NDArray[Any]:
        """The values at some positions of each axis, at least one."""
        raise NotImplementedError

    def __getitem__(self, index: Index | tuple[Index, ...]) -> npt.NDArray[Any]:
        """Values by numpy's basic indexing: integers, slices and `...`, negative ones as usual.

        Raises RegionError (an IndexError) for an index outside the shape and for other indices.
        """
        parts = expand_index(index, self.dims, self.what)
        ranges = index_ranges(parts, self.shape, self.dims)
        nothing = [len(positions) for positions in ranges]
        values = self._decoded(ranges) if all(nothing) else np.empty(nothing, self.dtype)
        return values[tuple(slice(None) if isinstance(part, slice) else 0 for part in parts)]

    def __array__(
        self, dtype: npt.DTypeLike | None = None, copy: bool | None = None
    ) -> npt.NDArray[Any]:
        """All values, decoded."""
        if copy is False:
            raise ValueError(f"{self.what} cannot become an array without a copy: it is decoded")
        values = self[...]
        return values if dtype is None else values.astype(dtype)

    def __len__(self) -> int:
        return self.shape[0]

    @property
    def ndim(self) -> int:
        """Number of axes."""
        return len(self.dims)


CORNERS = "corners"
"""Stencil of the published network: the 16 corners around a point in every level, interpolated."""
NEIGHBOURS = "neighbours"
"""Stencil of other files: a vertex of level 1 and its neighbours."""

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


class Table(ArrayLike):
    """The table of one level, an array (t, z, y, x, E) that is decoded as it is read.

    t counts key frames, and z, y, x vertices of the level within the feature bounding box. Basic
    indexing works as in numpy; `np.asarray(table)` decodes all of it.

    Attributes:
        level: number of the level; 1 is the finest.
        shape: lengths of the axes.
        dtype: type of the numbers.
    """

    dims = TABLE_AXES
    what = "a table"

    def __init__(self, level: int, source: TableSource, dtype: npt.DTypeLike) -> None:
        self.level, self._source = level, source
        self.shape = tuple(int(n) for n in source.shape)
        self.dtype = np.dtype(dtype)

    def _decoded(self, ranges: Sequence[range]) -> npt.NDArray[Any]:
        spans = [(min(positions), max(positions) + 1) for positions in ranges]
        read = self._source.read(tuple(slice(*span) for span in spans))
        places = zip(ranges, spans, strict=True)
        values: npt.NDArray[Any] = read[
            np.ix_(*(np.array(at) - first for at, (first, _) in places))
        ]
        return values

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
        constants: further numbers where the stencil is NEIGHBOURS: `sigma`, `low` and `high`, in
            data units.
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
