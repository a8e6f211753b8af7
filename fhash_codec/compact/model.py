"""The default model, read from a file: values, tables, head, and plain arrays."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, lru_cache, reduce
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.boxes import NEIGHBOURS, Box, Mlp, Table, ceil_halvings
from fhash_codec.features.key_frames import KeyTimes
from fhash_codec.features.occupancy import read_occupancy
from fhash_codec.header import read_missing, rule_between
from fhash_codec.measure.value_range import decoded_type
from fhash_formats.container import Container, StoredArray
from fhash_formats.container.header import CUBIC, MISSING_ARRAY, MLP, PLAIN_FEATURE, TABLE
from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.native import library, pointer
from fhash_formats.support.threads import chunk_region, common_part
from fhash_formats.support.values import Double
from fhash_formats.transform.head import NeighbourHead
from fhash_formats.transform.tile_format import TileSettings
from fhash_formats.transform.values import cast

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
    array.prefetch((range(step // tile[0], step // tile[0] + 1), *grid))
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
        constants={"sigma": head.sigma, "low": head.low, "high": head.high},
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


CACHED_TILES = 8
"""Corrected tiles that an open file keeps."""
Region = tuple[slice, ...]


def predicted(
    table: npt.NDArray[Any], head: NeighbourHead | None, dtype: np.dtype[Any]
) -> npt.NDArray[Any]:
    """Return what the head makes of the table (t, z, y, x) of a tile, in the type of the values."""
    with np.errstate(over="ignore", invalid="ignore"):
        return cast(table if head is None else head.apply(np.ascontiguousarray(table)), dtype)


def correction_of(values: npt.NDArray[Any], base: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return what takes predicted to decoded values, of one type; 0 where a value is not finite."""
    kind = decoded_type(values.dtype)
    if values.dtype.kind != "f":
        # Modulo 2^64, so that neighbouring integers beyond 2^53 are still told apart.
        return (values.astype(np.int64) - base.astype(np.int64)).astype(kind)
    with np.errstate(invalid="ignore", over="ignore"):
        difference = values.astype(np.float64) - base.astype(np.float64)
    return np.where(np.isfinite(difference), difference, 0.0).astype(kind)


def corrected(base: npt.NDArray[Any], corrections: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return predicted values with their corrections, in their own type."""
    if base.dtype.kind != "f":
        with np.errstate(invalid="ignore"):
            return (base.astype(np.int64) + corrections.astype(np.int64)).astype(base.dtype)
    with np.errstate(over="ignore", invalid="ignore"):
        values: npt.NDArray[Any] = (base.astype(np.float64) + corrections).astype(base.dtype)
    return values


class PlainArray:
    """The values of a plain file, read as those of the coded array of a compact file."""

    masked = False

    def __init__(
        self,
        model: Mapping[str, Any],
        mlp: Mapping[str, Any] | None,
        arrays: Mapping[str, StoredArray],
    ) -> None:
        self._model, self._mlp = model, mlp
        self._table = arrays["table_1"]
        self._corrections = arrays.get("corrections")
        self.shape = self._table.shape[:4]
        self.chunk_shape = tuple(model["tile"])
        self.dtype = np.dtype(model["values"])
        self._tile = lru_cache(maxsize=CACHED_TILES)(
            lambda index: self._decode(chunk_region(index, self.chunk_shape, self.shape))
        )

    @property
    def levels(self) -> int:
        """Number of levels."""
        return len(self._model["levels"])

    @cached_property
    def head(self) -> NeighbourHead | None:
        """The head of the file."""
        return None if self._mlp is None else NeighbourHead.from_json(self._mlp)

    def read(self, region: Region) -> npt.NDArray[Any]:
        """Return the values of a region, slices (t, z, y, x) with explicit ends."""
        if self.head is None:  # no value depends on others of its tile
            return self._decode(region)
        result = np.empty([along.stop - along.start for along in region], self.dtype)
        bounds = [(along.start, along.stop) for along in region]
        tiles = zip(region, self.chunk_shape, strict=True)
        for index in product(*(range(a.start // n, -(-a.stop // n)) for a, n in tiles)):
            target, source = common_part(index, self.chunk_shape, bounds)
            result[target] = self._tile(index)[source]
        return result

    def _decode(self, region: Region) -> npt.NDArray[Any]:
        """The values of a region that is one tile, or any region where there is no head."""
        base = predicted(self._table.read((*region, slice(0, 1)))[..., 0], self.head, self.dtype)
        if self._corrections is None:
            return base
        corrections = self._corrections.read(region)
        whole = base.dtype.kind != "f"
        sound = np.abs(corrections) <= 2.0**63 if whole else np.isfinite(corrections)
        if not sound.all():
            raise DamagedFileError("array corrections has numbers beyond the type of the values")
        return corrected(base, corrections)


BLOCK = 1 << 13
"""Points whose corners are gathered at a time: they take 1 MiB, which stays in the cache."""

Cells = tuple[npt.NDArray[np.intp], Double, Double | None, list[Double]]
"""Numbers (n,) of points, the corners (2, 2, 2, n) around each, by z, y and x, at its time, their
derivatives by the step, and the shares (n,) of the upper corners along each axis."""


def equal_places(*numbers: npt.NDArray[np.int64]) -> Iterator[npt.NDArray[np.intp]]:
    """Yield the places of equal numbers (n,), none negative, by ascending numbers.

    Of several arrays all have to be equal, and the first counts most for the order.
    """
    if not numbers[0].size:
        return
    # numpy sorts numbers of 16 bits by counting them.
    small = [each.astype(np.min_scalar_type(each.max())) for each in numbers]
    order = np.lexsort(small[::-1])
    changes = np.logical_or.reduce([np.diff(each[order]) != 0 for each in small])
    yield from np.split(order, np.flatnonzero(changes) + 1)


def _before(positions: Any, length: int) -> npt.NDArray[np.int64]:
    """Return the vertex before each position on an axis; the last one but one for the last."""
    vertices = np.floor(positions).astype(np.int64)
    return np.asarray(np.clip(vertices, 0, max(length - 2, 0)))


def _corners(
    frames: list[npt.NDArray[Any] | None], space: list[Double], region: Box, lengths: list[int]
) -> tuple[list[Double | None], list[Double]]:
    """Return the corners (2, 2, 2, points) around points, and their shares along z, y and x.

    frames: values (z, y, x) of a region of a box of these lengths at some steps.
    """
    low = [_before(p, n) for p, n in zip(space, lengths, strict=True)]
    shares = [p - i for p, i in zip(space, low, strict=True)]
    _, rows, row = region.shape
    strides = (rows * row, row, 1)
    first = sum(
        (i - start) * stride for i, start, stride in zip(low, region.first, strides, strict=True)
    )
    # On an axis of a single vertex that one is before and behind every point.
    ahead = [stride if n > 1 else 0 for n, stride in zip(lengths, strides, strict=True)]
    corners = [None if frame is None else np.empty((2, 2, 2, space[0].size)) for frame in frames]
    for z, y, x in product((0, 1), repeat=3):
        places = first + (z * ahead[0] + y * ahead[1] + x * ahead[2])
        for into, frame in zip(corners, frames, strict=True):
            if into is not None and frame is not None:
                into[z, y, x] = frame.reshape(-1)[places]
    return corners, shares


def _interpolated(corners: Double, shares: list[Double]) -> Double:
    """Return the values (n,) between corners (2, 2, 2, n)."""
    values = np.zeros(corners.shape[-1])
    for corner in _weighed(corners, shares, range(3)).reshape(8, -1):
        values += corner
    return values


def _slopes(corners: Double, shares: list[Double]) -> Double:
    """Return the derivatives (n, 3) by z, y and x between corners (2, 2, 2, n)."""
    slopes = np.empty((corners.shape[-1], 3))
    for axis in range(3):
        weighed = _weighed(corners, shares, [other for other in range(3) if other != axis])
        # One after the other: numpy would add up those of a single point in another order.
        low, high = (
            reduce(np.add, np.take(weighed, side, axis=axis).reshape(4, -1)) for side in (0, 1)
        )
        slopes[:, axis] = high - low
    return slopes


def _weighed(corners: Double, shares: list[Double], axes: Iterable[int]) -> Double:
    """Return corners (2, 2, 2, n) times their weights, which are those along some axes."""
    weights = np.ones(1)
    for axis in axes:
        sides = np.stack([1 - shares[axis], shares[axis]])
        weights = weights * np.expand_dims(sides, [other for other in range(3) if other != axis])
    # A corner without weight counts for nothing, also where it is not finite.
    return np.where(weights == 0, 0.0, weights * corners)


Frames = Sequence[npt.NDArray[Any] | None]
"""Values of one shape at four neighbouring steps. The outer two may be None or have NaN."""


def values_between(
    frames: Frames, distances: tuple[float, float], shares: Double, *, slopes: bool = False
) -> tuple[Double, Double | None]:
    """Return values at shares of the way from the second frame to the third, and derivatives.

    Without the outer frames they are linear (FORMAT.md, Between steps).

    frames: arrays (..., n).
    distances: see `KeyTimes.distances`.
    shares: float64 (n,), or one for all values.
    slopes: whether to return derivatives by the share; None is returned for them otherwise.
    """
    given = [None if each is None else each.reshape(-1) for each in frames]
    shape = next(each.shape for each in frames if each is not None)
    values, derived = np.empty(shape), np.empty(shape) if slopes else None
    # Piece by piece, so that copies in float64 stay in the cache.
    shares = np.ascontiguousarray(shares)
    piece = shares.size if shares.size > 1 else BLOCK
    for start in range(0, values.size, piece):
        held = [None if each is None else _wide(each[start : start + piece]) for each in given]
        code = library().fhash_between(
            list(map(pointer, held)),
            distances,
            min(piece, values.size - start),
            pointer(shares),
            shares.size == 1,
            pointer(values.reshape(-1)[start:]),
            pointer(None if derived is None else derived.reshape(-1)[start:]),
        )
        assert code == 0
    return values, derived


def _wide(values: npt.NDArray[Any]) -> Double:
    """Return values in float64, side by side."""
    return np.ascontiguousarray(values, np.float64)


class CompactModel:
    """A `VolumeModel` (volume_model.py) of a compact file.

    Its table holds values (t, z, y, x) at the vertices of the feature bounding box.
    """

    def __init__(self, container: Container) -> None:
        self._container = container
        self._arrays = container.arrays
        self._table = self._arrays[TABLE]
        self._plain: PlainArray | None = None
        if PLAIN_FEATURE in container.header["required_features"]:
            self._plain = PlainArray(
                container.header["model"], container.header.get(MLP), self._arrays
            )
        self._array = self._plain or self._table
        self.chunks = self._array.chunk_shape
        self._cubic = rule_between(container.header)["rule"] == CUBIC

    @cached_property
    def _key_times(self) -> KeyTimes:
        """The times of the key frames."""
        return KeyTimes.of(self._container)

    @cached_property
    def tables(self) -> list[Table]:
        """The tables, finest first."""
        if self._plain is not None:
            levels = range(1, self._plain.levels + 1)
            stored = {n: self._arrays[f"table_{n}"] for n in levels}
            return [Table(n, array, array.dtype) for n, array in stored.items()]
        count = level_count(self._table.shape[1:])
        sources = [CompactTable(self._table, halvings) for halvings in range(count)]
        return [Table(n, source, source.dtype) for n, source in enumerate(sources, start=1)]

    @cached_property
    def mlp(self) -> Mlp:
        """The head as an MLP."""
        if self._plain is not None:
            return head_mlp(self._plain.head)
        settings = self._table.settings
        return head_mlp(None if settings is None else settings.head)

    def occupied(self, first: int, last: int, region: Box) -> npt.NDArray[np.bool_]:
        """Return which vertices (z, y, x) of a region are in the coreset at both of two steps."""
        # Between steps both count: a value is no better than the two it lies between.
        return np.asarray(self._occupied_at(first, last + 1, region).all(axis=0))

    def _occupied_at(self, first: int, end: int, region: Box) -> npt.NDArray[np.bool_]:
        """Return which vertices (t, z, y, x) of a region are in the coreset at each step."""
        steps, space = slice(first, end), region.slices()
        if self._plain is None:
            return self._table.read_mask((steps, *space))
        return read_occupancy(self._container, first, end)[:, *space]

    def read(self, step: float, region: Box, requested: npt.NDArray[np.bool_]) -> npt.NDArray[Any]:
        """Return the values (z, y, x) of a region of the box at a step.

        At a stored step they have the type of the source; between steps they are interpolated by
        the rule of the file, in float64. Raises DamagedFileError for infinities, which no table
        holds.
        """
        first = int(np.floor(step))
        share = step - first
        if not share:
            return self._frame(first, region)
        near = self._near(first, cubic=self._cubic)
        held = dict(zip(near, self._counted(near, region), strict=True))
        frames = [held.get(number) for number in range(first - 1, first + 3)]
        return self._between(first, frames, np.array([share]))[0]

    def _near(self, step: int, *, cubic: bool) -> range:
        """Return the steps by which values between a step and the next are found."""
        return range(max(step - cubic, 0), min(step + 2 + cubic, self._array.shape[0]))

    def _between(
        self, step: int, frames: Frames, shares: Double, *, slopes: bool = False
    ) -> tuple[Double, Double | None]:
        """Return `values_between` of a step and the next; a single step is its own next one."""
        before, first, second, behind = frames
        beside = before is not None or behind is not None
        distances = self._key_times.distances(step) if beside else (0.0, 0.0)
        frames = [before, first, first if second is None else second, behind]
        return values_between(frames, distances, shares, slopes=slopes)

    def _counted(self, steps: range, region: Box) -> npt.NDArray[Any]:
        """Return the values (t, z, y, x) of a region at some steps; raise what `read` raises.

        Where a cubic would count a value outside the coreset, it is NaN.
        """
        stored = self._array.read((slice(steps.start, steps.stop), *region.slices()))
        values = self._without_infinities(stored)
        if not self._cubic:
            return values
        counted = self._occupied_at(steps.start, steps.stop, region)
        if MISSING_ARRAY in self._container.arrays:
            first = Box.of(self._container.header["feature_bounding_box"]).first
            for number, key in enumerate(steps):
                step = self._key_times.key_frames[key]
                missing = read_missing(self._container, range(step, step + 1), region.shift(first))
                assert missing is not None
                counted[number] &= ~missing[0]
        return values if counted.all() else np.where(counted, values, np.nan)

    def read_steps(
        self, first: int, end: int, region: Box
    ) -> tuple[npt.NDArray[Any], npt.NDArray[np.bool_]]:
        """Return the values (t, z, y, x) of a region at neighbouring steps, and its coreset.

        They have the type of the source. Raises what `read` raises.
        """
        values = self._array.read((slice(first, end), *region.slices()))
        return self._without_infinities(values), self._occupied_at(first, end, region)

    def read_lod(self, step: int, lod: int, region: Box) -> npt.NDArray[Any]:
        """Return every 2^lod-th vertex (z, y, x) of a region of the box at a step.

        Each tile is low-passed on its own.

        region: counted in coarse vertices.
        """
        if self._plain is not None:
            return self._read_plain_lod(step, lod, region)
        array = self._table
        values = read_coarse(array, step, lod, region, array.decode_chunk, array.dtype)
        lost = np.isnan(values) if lod and values.dtype.kind == "f" else np.zeros(0, np.bool_)
        if lost.any():
            # A tile of labels that begins between coarse vertices gives a vertex beside each of
            # them, which may be outside of the coreset where the vertex itself is not.
            spans = [slice(low << lod, ((high - 1) << lod) + 1) for low, high in region]
            own = array.read((slice(step, step + 1), *spans))[0][(slice(None, None, 1 << lod),) * 3]
            np.copyto(values, own, where=lost)
        return self._without_infinities(values)

    def _read_plain_lod(self, step: int, lod: int, region: Box) -> npt.NDArray[Any]:
        """The table of a level, in the type of the values; level 0 is the values themselves."""
        if lod == 0:
            frames = self._array.read((slice(step, step + 1), *region.slices()))
            return np.asarray(frames[0])
        if lod >= len(self.tables):
            raise InputError(f"level of detail {lod}; a plain file has 0 to {len(self.tables) - 1}")
        return cast(self.tables[lod][step, *region.slices(), 0], self._array.dtype)

    def sample(self, steps: Double, space: list[Double]) -> Double:
        """Return the values at points, quadrilinear.

        steps, space: steps and (z, y, x) of the points, in vertices of the box, all inside.
        """
        values = np.empty(steps.size)
        for chosen, corners, _, shares in self._cells(steps, space, slopes=False):
            values[chosen] = _interpolated(corners, shares)
        return values

    def sample_with_gradient(self, steps: Double, space: list[Double]) -> tuple[Double, Double]:
        """Return the values at points, and their derivatives (points, 4) by step, z, y and x.

        On the border of two cells the derivatives are those of the cell after it.
        """
        values, slopes = np.empty(steps.size), np.empty((steps.size, 4))
        for chosen, corners, rates, shares in self._cells(steps, space, slopes=True):
            assert rates is not None
            values[chosen] = _interpolated(corners, shares)
            slopes[chosen, 0] = _interpolated(rates, shares)
            slopes[chosen, 1:] = _slopes(corners, shares)
        return values, slopes

    def _cells(self, steps: Double, space: list[Double], *, slopes: bool) -> Iterator[Cells]:
        """Yield points between the same two steps, and the cells around them, by ascending steps.

        Each step is read once, the part of it that surrounds all points, and few are held.
        """
        count, *lengths = self._array.shape
        around = Box.of(
            (int(_before(p.min(), n)), min(int(_before(p.max(), n)) + 2, n))
            for p, n in zip(space, lengths, strict=True)
        )
        before, frames = _before(steps, count), dict[int, npt.NDArray[Any]]()
        for group in equal_places(before):
            step = int(before[group[0]])
            # At stored steps the values of others do not matter, but for the derivative.
            cubic = self._cubic and (slopes or bool((steps[group] % 1).any()))
            near = self._near(step, cubic=cubic)
            frames = {n: frames[n] for n in near if n in frames}
            for n in near:
                if n not in frames:
                    frames[n] = self._counted(range(n, n + 1), around)[0]
            for start in range(0, group.size, BLOCK):
                chosen = group[start : start + BLOCK]
                held = [frames.get(n) for n in range(step - 1, step + 3)]
                corners, shares = _corners(held, [p[chosen] for p in space], around, lengths)
                values, rates = self._between(step, corners, steps[chosen] - step, slopes=slopes)
                yield chosen, values, rates, shares

    def _frame(self, step: int, region: Box) -> npt.NDArray[Any]:
        """Return the values (z, y, x) of a region at a step; raise what `read` raises."""
        stored = self._array.read((slice(step, step + 1), *region.slices()))
        return np.asarray(self._without_infinities(stored)[0])

    def _without_infinities(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return values of the table, which are finite or NaN; raise DamagedFileError otherwise."""
        # Step by step: a mask of all of a large layer would be a quarter of it.
        if values.dtype.kind == "f" and any(np.isinf(frame).any() for frame in values):
            raise DamagedFileError("the table holds infinities; the file is damaged")
        return values
