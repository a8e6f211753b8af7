"""Values of the paper's model at points and in regions."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any, Literal, overload

import numpy as np
import numpy.typing as npt

from fhash_codec.boxes import CORNERS, Box, Mlp, Spans, Table
from fhash_codec.features.occupancy import read_occupancy
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.native import network as native
from fhash_codec.native.network import pointer
from fhash_codec.paper.network import Network, RankedBits, Resolution, SparseFrame, row_bits
from fhash_codec.paper.storage import load_network
from fhash_formats.container import Container
from fhash_formats.errors import InputError, RegionError
from fhash_formats.support.threads import share_out, usable_threads
from fhash_formats.support.values import Double, Single

AXES = ("key_index", "z", "y", "x")
"""Names of the coordinates of a point, in order."""
CHUNK_POINTS = 4096
"""Points that one thread evaluates at a time."""
SLAB_POINTS = 2**18
"""Points of a region that are evaluated at a time."""
SMALL_NUMBERS = 2**18
"""Numbers up to which the part of a level that holds some vertices only gets all vertices."""
SMALL_READ = 2**20
"""Vertices of the finest table that a group of points may always span."""
LARGE_READ = 2**25
"""Vertices of the finest table that a group of points may never exceed."""
READ_PER_POINT = 16
"""Vertices of the finest table per point that a group may span between those two limits."""


@dataclass(frozen=True)
class Patch:
    """A part of one level's table in memory.

    Attributes:
        values: embeddings (t, z, y, x, E), float32, contiguous. There are at least two vertices
            along x, since corners are read in pairs: a single one is there twice.
        first: vertex (t, z, y, x) of the level at which the part begins.
    """

    values: Single
    first: tuple[int, ...]

    @classmethod
    def of(cls, values: npt.NDArray[Any], first: Sequence[int]) -> Patch:
        """Return the part of embeddings (t, z, y, x, E) of a level."""
        if values.shape[3] == 1:
            values = np.repeat(values, 2, axis=3)
        return cls(np.ascontiguousarray(values, np.float32), tuple(first))

    @property
    def strides(self) -> tuple[int, ...]:
        """Vertices from one vertex to the next along t, z, y and x."""
        _, z, y, x, _ = self.values.shape
        return z * y * x, y * x, x, 1

    def at_one_time(self, values: Single) -> Patch:
        """Return the same part with other values (1, z, y, x, E), those of one time."""
        return replace(self, values=values, first=(0, *self.first[1:]))

    def facts(self, resolution: Sequence[int]) -> list[int]:
        """Return what the native functions need to know of a part of a level (points.cpp)."""
        return [*self._axis_facts(resolution, self._number_strides()), 0, 0, 0, 0]

    def _number_strides(self) -> list[int]:
        """Return the numbers from one vertex to the next along t, z, y and x."""
        return [stride // 4 for stride in self.values.strides[:4]]

    def _axis_facts(self, resolution: Sequence[int], strides: Sequence[int]) -> list[int]:
        facts = [self.values.ctypes.data, self.values.size]
        for vertices, first, stride in zip(resolution, self.first, strides, strict=True):
            # An axis of one vertex has no corner after it: both corners are the same.
            facts += [vertices, first, stride if vertices > 1 else 0]
        return facts


@dataclass(frozen=True)
class SparsePatch(Patch):
    """A whole level in memory that holds some vertices only.

    Attributes:
        values: embeddings (t, 1, 1, held + 1, E) of the held vertices. The last of each time is 0.
        bits: which vertices are held at any of these times. Numbers are those of its bits.
        vertices: vertices (z, y, x) of the level.
    """

    bits: RankedBits
    vertices: tuple[int, int, int]

    @classmethod
    def of_frames(cls, frames: Sequence[SparseFrame], node: int) -> SparsePatch:
        """Return the part of one or two neighbouring time nodes, of which `node` is the first."""
        bits = RankedBits.of_words(np.bitwise_or.reduce([frame.bits.words for frame in frames]))
        held = bits.positions()
        size = frames[0].values.shape[1]
        values = np.zeros((len(frames), 1, 1, len(held) + 1, size), np.float32)
        for number, frame in enumerate(frames):
            values[number, 0, 0, :-1] = frame.values[frame.bits.lookup(held)]
        return cls(values, (node, 0, 0, 0), bits, frames[0].shape)

    @property
    def strides(self) -> tuple[int, ...]:
        """Bits from one vertex to the next; the tables must be those of one time."""
        row = row_bits(self.vertices[2])
        return 0, self.vertices[1] * row, row, 1

    def facts(self, resolution: Sequence[int]) -> list[int]:
        """Return what the native functions need to know of a part; of two times only to mix."""
        if len(self.values) > 1:
            return super().facts(resolution)
        bits = self.bits
        held = [array.ctypes.data for array in (bits.words, bits.blocks, bits.within)]
        return [*self._axis_facts(resolution, self.strides), *held, bits.count]


@dataclass(frozen=True)
class PointTables:
    """The parts of all levels that surround some points.

    Attributes:
        network: the network, whose layers are used.
        sizes: key frames and vertices (t, z, y, x) that the points' positions count in.
        levels: resolution (t, z, y, x) of each level, finest first.
        patches: a part of each level's table.
    """

    network: Network
    sizes: Resolution
    levels: tuple[Resolution, ...]
    patches: tuple[Patch, ...]

    @classmethod
    def read(cls, network: Network, low: Sequence[float], high: Sequence[float]) -> PointTables:
        """Read the parts that surround all points between two positions (t, z, y, x)."""
        sizes = (network.key_frames, *network.box_size)
        patches = []
        for level, resolution in enumerate(network.levels):
            region = _region_between(sizes, resolution, low, high)
            first = [axis.start for axis in region]
            patches.append(Patch.of(network.read(level, region), first))
        return cls(network, sizes, network.levels, tuple(patches))

    @classmethod
    def of_box(cls, network: Network, key_index: float) -> PointTables:
        """Read the time nodes of the whole box around one time, for `at` this time.

        Levels that hold some vertices only stay so.
        """
        z, y, x = ((0, size) for size in network.box_size)
        return cls.of_region(network, key_index, (z, y, x), 0)

    @classmethod
    def of_region(
        cls, network: Network, key_index: float, region: Spans, small: int = SMALL_NUMBERS
    ) -> PointTables:
        """Read what the vertices of a region need at one time, for `at` this time.

        Args:
            network: the network.
            key_index: the time.
            region: spans (z, y, x) in vertices of the box.
            small: numbers up to which the part of a level that holds some vertices only gets all
                vertices; of a larger part all that the level holds is read, which stays as it is.
        """
        sizes = (network.key_frames, *network.box_size)
        low, high = ([key_index, *(span[end] - end for span in region)] for end in (0, 1))
        patches: list[Patch] = []
        for level, resolution in enumerate(network.levels):
            part = _region_between(sizes, resolution, low, high)[1:]
            nodes, _ = time_nodes(network.key_frames, resolution[0], key_index)
            numbers = network.embedding_size * math.prod(axis.stop - axis.start for axis in part)
            frames = [network.sparse_frame(level, n) for n in nodes] if numbers > small else [None]
            held = [frame for frame in frames if frame is not None]
            if held:
                patches.append(SparsePatch.of_frames(held, nodes.start))
                continue
            values = network.read(level, (slice(nodes.start, nodes.stop), *part))
            patches.append(Patch.of(values, (nodes.start, *(axis.start for axis in part))))
        return cls(network, sizes, network.levels, tuple(patches))

    @property
    def vertices(self) -> int:
        """Number of vertices of the finest level's part."""
        return math.prod(self.patches[0].values.shape[:4])

    @property
    def still(self) -> bool:
        """Whether the tables are those of one time."""
        return self.sizes[0] == 1

    def at(self, key_index: float, path: int | None = None) -> PointTables:
        """Return the tables at one time, interpolated once. Time 0 is then the only one.

        Points have the bits of those that are interpolated point by point.

        Args:
            key_index: the time.
            path: the path of the machine; None for the best.
        """
        if self.still:
            return self
        library, sizes = native.library(), np.array(self.sizes, np.int64)
        patches = []
        for patch, level in zip(self.patches, self.levels, strict=True):
            if len(patch.values) == 1:  # the time is that of a node, or the only one
                patches.append(patch.at_one_time(patch.values))
                continue
            values = np.empty((1, *patch.values.shape[1:]), np.float32)
            facts = np.array(patch.facts(level), np.int64)
            status = library.fhash_network_still(
                pointer(sizes),
                pointer(facts),
                key_index,
                native.best_path(library) if path is None else path,
                pointer(values),
            )
            _check_status(status)
            patches.append(patch.at_one_time(values))
        return replace(
            self,
            sizes=(1, *self.sizes[1:]),
            levels=tuple((1, *level[1:]) for level in self.levels),
            patches=tuple(patches),
        )


def time_nodes(key_frames: int, resolution: int, key_index: float) -> tuple[range, float]:
    """Return the time nodes of a level around a time, and the share of the second, in [0, 1).

    On a time node this one is enough.
    """
    at = key_index * (resolution - 1) / max(key_frames - 1, 1)
    node = min(int(at), resolution - 1)
    return range(node, node + 1 if at == node else node + 2), at - node


def nodes_of(network: Network, key_index: float) -> tuple[list[range], list[float]]:
    """Return the time nodes of each level around a time, and the share of the second."""
    found = [time_nodes(network.key_frames, level[0], key_index) for level in network.levels]
    return [nodes for nodes, _ in found], [share for _, share in found]


def corners_before(
    sizes: Sequence[int], resolution: Sequence[int], point: Sequence[float]
) -> list[int]:
    """Return the corner (t, z, y, x) of a level before a point.

    Args:
        sizes: key frames and vertices of the box (t, z, y, x).
        resolution: vertices (t, z, y, x) of the level.
        point: key index, z, y and x.
    """
    return [
        min(int(at * (corners - 1) / max(size - 1, 1)), max(corners - 2, 0))
        for at, corners, size in zip(point, resolution, sizes, strict=True)
    ]


def _region_between(
    sizes: Sequence[int], resolution: Sequence[int], low: Sequence[float], high: Sequence[float]
) -> tuple[slice, ...]:
    """Return the part (t, z, y, x) of a level that surrounds all points between two positions."""
    first, last = (corners_before(sizes, resolution, end) for end in (low, high))
    return tuple(
        slice(start, min(stop + 2, length))
        for start, stop, length in zip(first, last, resolution, strict=True)
    )


@overload
def sample_points(
    network: Network,
    key_index: npt.ArrayLike,
    z: npt.ArrayLike,
    y: npt.ArrayLike,
    x: npt.ArrayLike,
    *,
    gradient: Literal[False] = ...,
    threads: int | None = ...,
) -> Single: ...


@overload
def sample_points(
    network: Network,
    key_index: npt.ArrayLike,
    z: npt.ArrayLike,
    y: npt.ArrayLike,
    x: npt.ArrayLike,
    *,
    gradient: Literal[True],
    threads: int | None = ...,
) -> tuple[Single, Single]: ...


def sample_points(
    network: Network,
    key_index: npt.ArrayLike,
    z: npt.ArrayLike,
    y: npt.ArrayLike,
    x: npt.ArrayLike,
    *,
    gradient: bool = False,
    threads: int | None = None,
) -> Single | tuple[Single, Single]:
    """Return the normalised values float32 (n,) at n points.

    With `gradient`, also return the derivatives float32 (n, 4) by key index, z, y and x, per key
    frame and per vertex. They are those of the model itself, through interpolation and layers:

    * On the border of two cells they are those of the cell after it; at the end of an axis, those
      of the last cell.
    * Along an axis of one vertex they are 0.
    * On a ReLU's kink they are those of its flat side.

    Points that lie close together share one read of a part of each table. A point has the same
    bits whatever other points are given with it, in whatever order. Where all points share one
    time, the tables are interpolated in time once.

    Args:
        network: the trained network.
        key_index: times (n,) in [0, key_frames - 1].
        z, y, x: positions (n,) in vertices of the box, in [0, size - 1]. A single number stands for
            all points.
        gradient: whether to return the derivatives.
        threads: number of threads; None for one per processor.

    Raises:
        RegionError: a point is outside the box.
        InputError: the lengths of the arrays do not fit together.
    """
    threads = usable_threads(threads)
    columns, count = _columns((key_index, z, y, x))
    _check(network, columns)
    values = np.empty(count, np.float32)
    slopes = np.empty((count, 4), np.float32) if gradient else None
    for group in _groups(columns, np.arange(count)):
        whole = len(group) == count
        places = [_chosen(column, group) for column in columns]
        tables = PointTables.read(network, *_extremes(places))
        sampler = PointSampler(tables, None if gradient else _one_time(tables, places, len(group)))
        if whole:
            sampler.sample(places, values, slopes, threads)
            continue
        some = np.empty(len(group), np.float32)
        some_slopes = np.empty((len(group), 4), np.float32) if gradient else None
        sampler.sample(places, some, some_slopes, threads)
        values[group] = some
        if slopes is not None:
            slopes[group] = some_slopes
    return values if slopes is None else (values, slopes)


def decode_region(
    network: Network,
    key_index: float,
    region: Spans,
    *,
    requested: npt.NDArray[np.bool_] | None = None,
    threads: int | None = None,
) -> Single:
    """Return the normalised values float32 (z, y, x) at the vertices of a region.

    They are those of `sample_points`, so that a region holds the bits of that part of the frame.

    Args:
        network: the trained network.
        key_index: time in 0 .. key_frames - 1, fractional between key frames.
        region: spans (z, y, x) in vertices of the feature bounding box.
        requested: bool (z, y, x), the vertices whose values are needed; all if left out. Others are
            NaN and cost nothing.
        threads: number of threads; None for one per processor.

    Raises:
        RegionError: the region or the key index is outside the box.
        InputError: `requested` has another shape or type.
    """
    _check_region(network, key_index, region, requested)
    threads = usable_threads(threads)
    result = np.full([stop - start for start, stop in region], np.nan, np.float32)
    if requested is not None and not requested.any():
        return result
    sampler = PointSampler(PointTables.of_region(network, key_index, region), key_index)
    flat = result.reshape(-1)
    chosen = np.arange(flat.size) if requested is None else np.flatnonzero(requested)
    for first in range(0, len(chosen), SLAB_POINTS):
        slab = chosen[first : first + SLAB_POINTS]
        places = np.unravel_index(slab, result.shape)
        columns = [
            (start + place).astype(np.float64)
            for (start, _), place in zip(region, places, strict=True)
        ]
        values = np.empty(len(slab), np.float32)
        sampler.sample([np.array([key_index], np.float64), *columns], values, None, threads)
        flat[slab] = values
    return result


def _check_region(
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


class PointSampler:
    """Tables and layers in memory as the native functions read them, for many calls.

    Objects may be used by several threads at once.
    """

    def __init__(
        self, tables: PointTables, key_index: float | None = None, path: int | None = None
    ) -> None:
        """Take over tables.

        Args:
            tables: parts of the tables around the points to come. Parts that hold some vertices
                only must be those of one time, or `key_index` be given.
            key_index: the time of all points, at which the tables are interpolated once. The
                points' own time is then 0, and their derivative by time.
            path: the path of the machine; None for the best.
        """
        if key_index is not None:
            tables = tables.at(key_index, path)
        assert not any(
            isinstance(patch, SparsePatch) and len(patch.values) > 1 for patch in tables.patches
        ), "some vertices are held at several times"
        network = tables.network
        self._library = native.library()
        self._path = native.best_path(self._library) if path is None else path
        self._tables, self._matrices = tables, network.matrices
        counts = (len(tables.levels), len(self._matrices), network.embedding_size)
        self._sizes = np.array([*tables.sizes, *counts, not tables.still], np.int64)
        self._levels = np.array(
            [
                patch.facts(level)
                for patch, level in zip(tables.patches, tables.levels, strict=True)
            ],
            np.int64,
        )
        self._layers = np.array(
            [
                (matrix.ctypes.data, matrix.shape[0] - 1, matrix.shape[1] - 1)
                for matrix in self._matrices
            ],
            np.int64,
        )

    def fields(self) -> dict[str, Any]:
        """Fields by which the native marcher calls `fhash_network_points`, as long as this is."""
        return {
            "network": self._library.fhash_network_points,
            "network_sizes": self._sizes,
            "network_levels": self._levels,
            "network_layers": self._layers,
            "network_path": self._path,
        }

    def sample(
        self,
        columns: Sequence[Double],
        values: Single,
        slopes: Single | None,
        threads: int,
    ) -> None:
        """Write the normalised values and, unless `slopes` is None, the derivatives at points.

        Args:
            columns: key index, z, y and x of the points, each (n,) or (1,) for all, in the box.
            values: float32 (n,), to be written.
            slopes: float32 (n, 4), to be written, or None.
            threads: number of threads.
        """

        def evaluate(chunks: Sequence[slice]) -> None:
            for chunk in chunks:
                places = [column[chunk] if len(column) > 1 else column for column in columns]
                self.evaluate(places, values[chunk], None if slopes is None else slopes[chunk])

        starts = range(0, len(values), CHUNK_POINTS)
        share_out(evaluate, [slice(start, start + CHUNK_POINTS) for start in starts], threads)

    def evaluate(
        self,
        columns: Sequence[Double],
        values: Single,
        slopes: Single | None = None,
        input_slopes: Single | None = None,
    ) -> None:
        """Write the values, and the derivatives that are asked for, at points, in one thread.

        Args:
            columns, values, slopes: as in `sample`.
            input_slopes: float32 (inputs, n), to be written: the derivatives by the inputs of the
                network.
        """
        places = np.array(
            [
                (column.ctypes.data, 0 if len(column) == 1 else column.strides[0] // 8)
                for column in columns
            ],
            np.int64,
        )
        status = self._library.fhash_network_points(
            *map(pointer, (self._sizes, self._levels, self._layers, places)),
            len(values),
            self._path,
            *map(pointer, (values, slopes, input_slopes)),
        )
        _check_status(status)


def input_slopes(network: Network, points: Double) -> Single:
    """Return the derivatives float32 (inputs, n) of the value by each input of the network.

    The inputs are the interpolated embeddings, in the order of `Network`. The value is normalised.
    A part of each table that surrounds all points is read at once, so points of one call should lie
    close together.

    Args:
        network: the trained network.
        points: positions (4, n), key index, z, y and x, inside the box.
    """
    tables = PointTables.read(network, points.min(axis=1).tolist(), points.max(axis=1).tolist())
    slopes = np.empty((network.inputs, points.shape[1]), np.float32)
    values = np.empty(points.shape[1], np.float32)
    PointSampler(tables).evaluate(list(points), values, input_slopes=slopes)
    return slopes


def _check_status(status: int) -> None:
    """Raise MemoryError where a native function had not enough memory."""
    if status < 0:
        raise MemoryError("not enough memory to evaluate points")


def _columns(arrays: Sequence[npt.ArrayLike]) -> tuple[list[Double], int]:
    """Return coordinates as arrays (n,), or (1,) where one stands for all points, and n."""
    columns = [np.atleast_1d(np.asarray(array, dtype=np.float64)) for array in arrays]
    lengths = {len(column) for column in columns if np.ndim(column) == 1} - {1}
    if any(column.ndim != 1 for column in columns) or len(lengths) > 1:
        raise InputError(
            f"points have shapes {', '.join(str(np.shape(array)) for array in arrays)}; "
            "one length (n,) is needed for key_index, z, y and x"
        )
    return columns, lengths.pop() if lengths else 1


def _check(network: Network, columns: Sequence[Double]) -> None:
    """Raise RegionError for the first point that is outside the box."""
    for axis, column, size in zip(
        AXES, columns, (network.key_frames, *network.box_size), strict=True
    ):
        # A number that is none makes both ends none.
        if len(column) and not (column.min() >= 0 and column.max() <= size - 1):
            outside = np.flatnonzero(~((column >= 0) & (column <= size - 1)))
            raise RegionError(
                f"point {outside[0]}: {axis} {column[outside[0]]:g} is outside 0..{size - 1}"
            )


def _chosen(column: Double, chosen: npt.NDArray[np.intp]) -> Double:
    """Return a coordinate of chosen points, in ascending order; one number stands for all."""
    return column if len(column) in (1, len(chosen)) else column[chosen]


def _extremes(columns: Sequence[Double]) -> tuple[list[float], list[float]]:
    """Return the smallest and the largest of each coordinate."""
    return [float(c.min()) for c in columns], [float(c.max()) for c in columns]


def _one_time(tables: PointTables, columns: Sequence[Double], count: int) -> float | None:
    """Return the time that all points share, if interpolating the tables there once pays."""
    times = columns[0]
    if tables.vertices > READ_PER_POINT * count or times.min() != times.max():
        return None
    return float(times[0])


def _groups(
    columns: Sequence[Double], chosen: npt.NDArray[np.intp]
) -> Iterator[npt.NDArray[np.intp]]:
    """Split chosen points into groups that each span a part of the finest table fit to be read.

    A part is fit if it is small, or if it holds many points and is not too large.
    """
    if not len(chosen):
        return
    low, high = np.array(_extremes([_chosen(column, chosen) for column in columns]))
    extent = np.floor(high) - np.floor(low) + 2
    if math.prod(extent) <= min(LARGE_READ, max(SMALL_READ, READ_PER_POINT * len(chosen))):
        yield chosen
        return
    axis = int(np.argmax(extent))
    below = columns[axis][chosen] < np.floor((low[axis] + high[axis] + 1) / 2)
    yield from _groups(columns, chosen[below])
    yield from _groups(columns, chosen[~below])


class PaperModel:
    """A `VolumeModel` (volume_model.py) of the network in a container.

    At a fractional key index the embeddings are interpolated in time, not the values.
    """

    def __init__(self, container: Container) -> None:
        header = container.header
        self._container = container
        self._range = ValueRange(*header["value_range"])
        self._box = Box.of(header["feature_bounding_box"])
        self.chunks: tuple[int, ...] = (1, *header["domain"]["shape"][1:])
        self._occupancy = lru_cache(maxsize=4)(partial(_merged, container))

    @cached_property
    def network(self) -> Network:
        """The network. Its tables are read on demand."""
        return load_network(self._container)

    @cached_property
    def tables(self) -> list[Table]:
        """The tables, finest first."""
        stored = self._container.header["model"]["tables"]
        dtype = "float16" if stored == "float16" else "float32"
        return [Table(n, table, dtype) for n, table in enumerate(self.network.tables, start=1)]

    @cached_property
    def mlp(self) -> Mlp:
        """The layers of the network."""
        weights, biases = zip(*self.network.layers, strict=True)
        return Mlp(weights=weights, biases=biases, activation="relu", stencil=CORNERS)

    def occupied(self, first: int, last: int, region: Box) -> npt.NDArray[np.bool_]:
        """Return which vertices (z, y, x) of a region are in the coreset at either key frame."""
        return self._occupancy(first, last)[region.slices()]

    def occupied_by(
        self, features: tuple[int, ...], first: int, last: int, region: Box
    ) -> npt.NDArray[np.bool_]:
        """Return which vertices (z, y, x) of a region are in the coreset for some features.

        Args:
            features: their numbers, counted from 0.
            first, last: neighbouring key frames, or the same key frame twice.
            region: the region.
        """
        return self._occupancy(first, last, features)[region.slices()]

    def read(self, key: float, region: Box, requested: npt.NDArray[np.bool_]) -> Double:
        """Return the values (z, y, x) of a region.

        Vertices that are not requested are NaN and cost nothing.
        """
        return self._range.from_unit(decode_region(self.network, key, region, requested=requested))

    def read_lod(self, key: int, lod: int, region: Box) -> npt.NDArray[Any]:
        """Raise InputError: the embeddings of a coarser level alone give no values."""
        raise InputError(
            f"{self._container.path}: the published network has no levels of detail; "
            "decode it whole"
        )

    def sample(self, keys: Double, space: list[Double]) -> Double:
        """Return the values (n,) at points inside the box."""
        return self._range.from_unit(sample_points(self.network, keys, *space))

    def sample_with_gradient(self, keys: Double, space: list[Double]) -> tuple[Double, Double]:
        """Return the values (n,) and analytic derivatives (n, 4) by key index, z, y and x."""
        unit, slopes = sample_points(self.network, keys, *space, gradient=True)
        return self._range.from_unit(unit), slopes.astype(np.float64) * (
            self._range.high - self._range.low
        )


def _merged(
    container: Container, first: int, last: int, features: tuple[int, ...] | None = None
) -> npt.NDArray[np.bool_]:
    """Return which vertices (z, y, x) of the box are in the coreset at either of two key frames.

    `features` are the numbers of those whose coresets are taken, or None for all.
    """
    frames = read_occupancy(container, first, last + 1, features)
    return np.asarray(frames[0] | frames[-1])
