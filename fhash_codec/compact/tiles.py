"""Tiles of a series: their blocks, their coding, and what is known of tiles coded before."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass, replace
from itertools import product
from math import prod
from threading import Lock
from typing import Any, NamedTuple, TypeVar

import numpy as np

from fhash_codec.features.features import Extent
from fhash_codec.measure.errors import error_sums
from fhash_codec.measure.value_range import power_of_two
from fhash_formats.native import ffi
from fhash_formats.series import Series, step_blocks
from fhash_formats.support.threads import chunk_region, map_ahead, one_ahead, usable_threads
from fhash_formats.support.values import Mask, Values
from fhash_formats.transform import tile as coder
from fhash_formats.transform.tile import (
    OFFSETS,
    TRELLIS_WEIGHT,
    WEIGHT,
    CodedTile,
    decode_tile,
    encode_tile,
    exact_tile,
    plain_step,
    with_trellis,
)
from fhash_formats.transform.tile_format import Shape, TileSettings
from fhash_formats.transform.values import about_origin, cast

Index = tuple[int, int, int, int]
"""Position (t, z, y, x) of a tile in the grid of tiles."""

MAX_BYTES_IN_MEMORY = 1 << 30
"""Largest size of a box that stays in memory, in bytes; a larger one is read by layers of tiles."""


class Tile(NamedTuple):
    """Values (t, z, y, x) of a tile, and which of its vertices count.

    Vertices that count are those whose error is measured and bounded: in the coreset and finite.
    The mask may still include values that are not finite; the coder leaves those out itself.
    """

    values: Values
    counted: Mask | None
    """Mask of the same shape, True where a vertex counts; None if all vertices count."""

    @property
    def counted_vertices(self) -> int:
        """Number of vertices that count."""
        if self.counted is None:
            return self.values.size
        return int(np.count_nonzero(self.counted))

    @property
    def counted_values(self) -> Values:
        """Values that count, one-dimensional."""
        return self.values.reshape(-1) if self.counted is None else self.values[self.counted]

    @property
    def is_empty(self) -> bool:
        """Whether no vertex counts."""
        return self.counted is not None and not self.counted.any()


def fits_memory(series: Series) -> bool:
    """Whether a whole series would stay in memory as a box of vertices."""
    itemsize = (series.source_dtype or series.dtype).itemsize
    return prod(series.shape) * itemsize <= MAX_BYTES_IN_MEMORY


def padded_tile(values: Values, in_coreset: Mask | None, tile: Shape) -> Tile:
    """Return values (t, z, y, x) as a tile; beyond their end border values are repeated.

    It is no copy where nothing is beyond the end.

    in_coreset: which of them count; None for all. Vertices beyond the end do not count.
    """
    padding = [(0, n - m) for n, m in zip(tile, values.shape, strict=True)]
    if not any(after for _, after in padding):
        return Tile(values, None if in_coreset is None or in_coreset.all() else in_coreset)
    if in_coreset is None:
        in_coreset = np.ones(values.shape, bool)
    return Tile(np.pad(values, padding, mode="edge"), np.pad(in_coreset, padding))


def return_memory() -> None:
    """Give what was freed back to the system, where its C library keeps it (glibc).

    It keeps arrays of up to 32 MB: the planning's took a fifth of a series more, for nothing.
    """
    if sys.platform == "linux":
        trim = getattr(ffi.dlopen(None), "malloc_trim", None)
        if trim is not None:
            trim(0)


class _BoxInMemory:
    """Values and mask of what was read of the box, shared by all tilings: all steps, or some."""

    def __init__(self) -> None:
        self.lock = Lock()
        self.content: Tile | None = None
        self.layer: tuple[range, Tile] | None = None
        """The last steps that were read, of a series that is not in memory."""


class Blocks:
    """The feature bounding box over all steps as a grid of tiles (t, z, y, x).

    Attributes:
        shape: vertices of the box over all steps.
        tile: vertices of a tile; the last tile along an axis may reach beyond the box.
        grid: number of tiles along each axis; along t, of all boxes together.
        weights: of each box of this shape, one after the other: boxes of the series that it stands
            for. A series itself is one box.
        source_dtype: type of the source, in the byte order of this machine. It is an integer type
            also where missing values made floats of integers.
        origin: integer that is subtracted from the values of the source; 0 but for 64-bit integers
            beyond 2^53.
        dtype: type of the values: that of the source, or int64 for differences from the origin.
        complete: whether all vertices of the box are in the coreset at all steps.
    """

    def __init__(self, series: Series, extent: Extent, tile: Shape, origin: int = 0) -> None:
        self._series, self._extent, self.origin = series, extent, origin
        self.source_dtype: np.dtype[Any] = (series.source_dtype or series.dtype).newbyteorder("=")
        self.dtype: np.dtype[Any] = np.dtype(np.int64) if origin else self.source_dtype
        self.shape: Shape = (series.shape[0], *extent.box.shape)
        self.complete = extent.samples == prod(self.shape)
        self.weights: tuple[int, ...] = (1,)
        self._box = _BoxInMemory()
        self._only_layers = False
        self._cut(tile)

    def _cut(self, tile: Shape) -> None:
        self.tile: Shape = tuple(min(n, length) for n, length in zip(tile, self.shape, strict=True))  # type: ignore[assignment]
        t, z, y, x = (-(-length // n) for length, n in zip(self.shape, self.tile, strict=True))
        self.grid: Index = (t * len(self.weights), z, y, x)

    def retile(self, tile: Shape) -> Blocks:
        """Return the same series in other tiles; the box in memory is shared."""
        other = copy(self)
        other._cut(tile)
        return other

    def by_layers(self) -> Blocks:
        """Return the same tiles, of which layer after layer is read and none is kept.

        So nothing is read of the other layers, of a short series either.
        """
        other = copy(self)
        other._only_layers = True
        return other

    def forget(self) -> None:
        """Free the memory of the values, which are read again when they are asked for."""
        with self._box.lock:
            self._box.content = self._box.layer = None

    def boxes(self, shape: Shape, places: Sequence[Index], weights: Sequence[int]) -> Blocks:
        """Return parts of one shape as a series in memory of its own, each of them one tile.

        places: first vertices of the parts; parts of the series' border end there.
        weights: see the class.
        """
        values, masks = [], []
        for place in places:
            low = (min(at, m - n) for at, m, n in zip(place, self.shape, shape, strict=True))
            steps, *region = _region((*low,), shape)
            for _, block in step_blocks(range(steps.start, steps.stop), self.shape[1:]):
                frames = self._steps(block)
                values.append(frames.values[:, *region])
                if frames.counted is not None:
                    masks.append(frames.counted[:, *region])
        counted = np.concatenate(masks) if masks else None
        other = copy(self)
        other._box, other.shape, other.weights = _BoxInMemory(), shape, tuple(weights)
        other.complete = counted is None or bool(counted.all())
        other._box.content = Tile(np.concatenate(values), None if other.complete else counted)
        other._cut(shape)
        return other

    def weight(self, index: Index) -> int:
        """Return the weight of the box that a tile is of."""
        return self.weights[index[0] * len(self.weights) // self.grid[0]]

    def _steps(self, steps: range) -> Tile:
        """Return values and mask (t, z, y, x) of neighbouring steps."""
        if not self.in_memory:
            return self._load(steps)
        values, counted = self._whole()
        span = slice(steps.start, steps.stop)
        return Tile(values[span], None if counted is None else counted[span])

    @property
    def masked(self) -> bool:
        """Whether tiles hold which of their vertices count."""
        return self._extent.stored and not self.complete

    @property
    def in_memory(self) -> bool:
        """Whether the box over all steps stays in memory."""
        return not self._only_layers and (
            self._box.content is not None
            or prod(self.shape) * self.dtype.itemsize <= MAX_BYTES_IN_MEMORY
        )

    def indices(self) -> Iterator[Index]:
        """Yield the indices of all tiles in C order."""
        yield from product(*(range(n) for n in self.grid))

    def read(self, index: Index) -> Tile:
        """Return a tile of values less the origin; beyond the box, border values are repeated.

        Vertices beyond the box do not count. Any thread may call this where the box is in memory.
        Otherwise only one thread may, in C order, because just the last layer in t is kept.
        """
        layer = self.layer(index[0])
        region = (slice(None), *chunk_region(index[1:], self.tile[1:], self.shape[1:]))
        values = layer.values[region]
        in_coreset = None
        if layer.counted is not None:
            in_coreset = layer.counted[region]
        return padded_tile(values, in_coreset, self.tile)

    def counted_values(self) -> Iterator[Values]:
        """Yield the values that count of some steps after others, less the origin.

        A series that does not stay in memory is read once.
        """
        for _, steps in step_blocks(range(self.shape[0]), self.shape[1:]):
            frames, mask = self._steps(steps)
            yield frames if mask is None else frames[mask]

    @property
    def values_in_memory(self) -> Values:
        """Values (t, z, y, x) of the box over all steps, less the origin, which stay in memory."""
        return self._whole().values

    def _whole(self) -> Tile:
        """Return the box over all steps, which is read at the first call."""
        with self._box.lock:
            if self._box.content is None:
                self._box.content = self._load(range(self.shape[0]))
            return self._box.content

    def layer(self, t: int) -> Tile:
        """Return one layer of tiles, (up to tile t, z, y, x of the box)."""
        box, number = divmod(t, self.grid[0] // len(self.weights))
        first, last = number * self.tile[0], min((number + 1) * self.tile[0], self.shape[0])
        steps = range(box * self.shape[0] + first, box * self.shape[0] + last)
        if self.in_memory:
            return self._steps(steps)
        layer = self._box.layer
        if layer is None or layer[0] != steps:
            layer = self._box.layer = None  # frees its memory before the next layer is read
            layer = self._box.layer = (steps, self._load(steps))
        return layer[1]

    def _load(self, steps: range) -> Tile:
        """Read the box at some steps from the series; an array in memory is not copied."""
        held = self._series.held
        if held is not None and held.dtype == self.source_dtype and not self.origin:
            values = held[(slice(steps.start, steps.stop), *self._extent.box.slices())]
            values.flags.writeable = False  # it is the caller's
            return Tile(values, self.masks(steps))
        values = np.empty((len(steps), *self.shape[1:]), dtype=self.source_dtype)
        for block, whole in one_ahead(self._series.blocks(steps)):
            frames = whole[:, *self._extent.box.slices()]
            if frames.dtype.kind == "f" and self.dtype.kind != "f":
                # Missing values are outside the coreset; any integer may stand there.
                least = np.fmin.reduce(frames, axis=(1, 2, 3), keepdims=True, initial=np.inf)
                frames = np.where(np.isfinite(frames), frames, least)
                frames = cast(np.where(np.isfinite(frames), frames, 0.0), self.source_dtype)
            values[block.start - steps.start :][: len(block)] = frames
        values = about_origin(values, self.origin) if self.origin else values
        return Tile(values, self.masks(steps))

    def masks(self, steps: range) -> Mask | None:
        """Return which vertices of the box are in the coreset at some steps; None for all."""
        if self.complete:
            return None
        return self._extent.masks(steps)


def _region(place: Sequence[int], shape: Sequence[int]) -> tuple[slice, ...]:
    """Return the slices of a part by its first vertices."""
    return tuple(slice(low, low + n) for low, n in zip(place, shape, strict=True))


MIN_STEP_SHARE = 2.0**-26
"""Smallest quantiser step as a share of the value range: integers beyond 2^30 cannot be coded."""


@dataclass(frozen=True, kw_only=True)
class BulkPart:
    """The part of a promise that is about the bulk of the values, as tiles measure it."""

    low: float
    """Least value of the bulk, in data units."""
    high: float
    """Greatest value of the bulk, in data units."""
    weight: float = 1.0
    """Mean squared error that is promised of all values, as a multiple of that of the bulk."""
    alone: bool = False
    """Whether nothing is promised of the other values; the weight is then 1."""


@dataclass(frozen=True, kw_only=True)
class Coding(coder.Coding):
    """Options of the encoder for the tiles of a series.

    They change the bytes, but a decoder does not need them. What a decoder needs is in
    `TileSettings`.
    """

    weight: float = WEIGHT
    keep_missing: bool = False
    exact: bool = False
    """Whether tiles are stored without loss, by `exact_tile`; the other options are then unused."""
    bulk: BulkPart | None = None
    """Part of the promise about the bulk, which changes what is measured and no byte."""


def coding_of(effort: int, **options: Any) -> Coding:
    """Return the options of the encoder at an effort. options: others that it has."""
    rounds = 0 if effort == 1 else 2 if effort < 7 else 4
    return Coding(passes=2 if effort > 2 else 1, rounds=rounds, **options)


def on_trellis(settings: TileSettings, coding: Coding) -> tuple[TileSettings, Coding]:
    """Return settings and coding with the trellis, at about the same error."""
    return with_trellis(settings), replace(coding, weight=TRELLIS_WEIGHT)


def off_trellis(settings: TileSettings, coding: Coding) -> tuple[TileSettings, Coding]:
    """Return settings and coding with the plain quantiser, at about the same error."""
    settings = replace(settings, trellis=False, step=plain_step(settings), offsets=OFFSETS)
    return settings, replace(coding, weight=WEIGHT)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Size and error of some coded tiles."""

    size: int
    """Bytes of the streams."""
    squares: float
    """Sum of the squared errors over the vertices that count, in squared data units."""
    count: int
    """Number of finite values that count."""
    max_error: float
    """Largest absolute error, in data units."""
    nonzero: int = 0
    """Number of coefficients that are not 0."""
    bulk_squares: float = 0.0
    """Sum of the squared errors in the bulk times its weight; 0 without a promise about it."""
    bulk_count: int = 0
    """Number of the values that this sum is over."""

    def psnr(self, data_range: float) -> float:
        """Return the PSNR in dB; infinite without error.

        Where a promise about the bulk is harder to keep than that about all values, it is the PSNR
        over all values that would be as far from its promise.
        """
        mean = self.squares / self.count if self.count else 0.0
        if self.bulk_count:
            mean = max(mean, self.bulk_squares / self.bulk_count)
        if mean == 0 or data_range == 0:
            return math.inf
        return 20 * math.log10(data_range) - 10 * math.log10(mean)


def code(tile: Tile, settings: TileSettings, coding: Coding) -> tuple[CodedTile, Outcome]:
    """Code one tile and measure its size and error."""
    values, counted = tile
    if coding.exact:
        occupied = None
        if settings.mask is not None:
            occupied = np.ones(values.shape, bool) if counted is None else counted
        coded = exact_tile(values, occupied=occupied, origin=settings.origin)
        size = len(coded.data)
        return coded, Outcome(size=size, squares=0.0, count=tile.counted_vertices, max_error=0.0)
    coded = encode_tile(values, settings, coding, in_coreset=counted)
    return coded, measured(tile, coded, settings, coding)


def recoded(tile: Tile, data: bytes, settings: TileSettings, nonzero: int = 0) -> CodedTile:
    """Return a tile whose stream is known, as these settings decode it."""
    t, z, y, x = tile.values.shape
    decoded = decode_tile(data, (t, z, y, x), tile.values.dtype, settings)
    return CodedTile(data=data, decoded=decoded, nonzero=nonzero)


def measured(tile: Tile, coded: CodedTile, settings: TileSettings, coding: Coding) -> Outcome:
    """Return size and error of a tile that was coded with these settings."""
    values, counted = tile
    # Scaled, so that neither huge nor tiny ranges over- or underflow.
    scale = power_of_two(settings.high - settings.low)
    bulk = coding.bulk
    ends = None if bulk is None else (bulk.low, bulk.high)
    sums = error_sums(values, coded.decoded, counted, scale, ends)
    squares, count = sums.squares, sums.number
    bulk_squares, bulk_count = sums.bulk_squares, sums.bulk_count
    if bulk is not None and bulk.alone:
        squares, count, bulk_squares, bulk_count = bulk_squares, bulk_count, 0.0, 0
    return Outcome(
        size=len(coded.data),
        # Divided twice: the square of the largest scale is no float.
        squares=squares / scale / scale,
        count=count,
        max_error=sums.largest / scale,
        nonzero=coded.nonzero,
        bulk_squares=bulk_squares * (1.0 if bulk is None else bulk.weight) / scale / scale,
        bulk_count=bulk_count,
    )


def total(outcomes: Sequence[Outcome], weights: Sequence[int] | None = None) -> Outcome:
    """Sum outcomes up to one. weights: number of tiles that each stands for (default 1)."""
    pairs = list(zip(weights or [1] * len(outcomes), outcomes, strict=True))
    return Outcome(
        size=sum(weight * o.size for weight, o in pairs),
        squares=math.fsum(weight * o.squares for weight, o in pairs),
        count=sum(weight * o.count for weight, o in pairs),
        max_error=max((o.max_error for o in outcomes), default=0.0),
        nonzero=sum(weight * o.nonzero for weight, o in pairs),
        bulk_squares=math.fsum(weight * o.bulk_squares for weight, o in pairs),
        bulk_count=sum(weight * o.bulk_count for weight, o in pairs),
    )


Source = TypeVar("Source")
"""Whatever a tile is made of: its values, its index, or its stream."""
Worked = tuple[bytes, Outcome, Values | None]
"""Stream of a tile, its outcome, and its values as it decodes; None where these are not kept."""


class CodedTiles(NamedTuple):
    """Tiles that were coded one after the other."""

    streams: list[bytes]
    """Bytes of each tile."""
    outcome: Outcome
    """Size and error of all of them."""
    decoded: list[Values | None]
    """Values of each tile as it decodes, where they are kept."""


def code_tiles(
    sources: Iterable[Source],
    work: Callable[[Source], Worked],
    workers: ThreadPoolExecutor,
    tell: Callable[[int], None] = lambda count: None,
) -> CodedTiles:
    """Code tiles in threads; few are worked on at a time, so that memory stays bounded.

    sources: of the tiles, in their order; taken in the calling thread.
    work: codes a tile, in any thread.
    tell: called with the number of tiles that are done.
    """
    streams: list[bytes] = []
    outcomes: list[Outcome] = []
    decoded: list[Values | None] = []
    for stream, outcome, values in map_ahead(workers, work, sources, 2 * usable_threads()):
        streams.append(stream)
        outcomes.append(outcome)
        decoded.append(values)
        tell(len(streams))
    return CodedTiles(streams, total(outcomes), decoded)


MAX_BYTES = 64 << 20
"""Bytes of streams that are kept; the oldest go first."""


class TileRun(NamedTuple):
    """A tile as it was coded once."""

    stream: bytes
    outcome: Outcome


@dataclass(frozen=True)
class Run:
    """Tiles of a sample as they were coded once."""

    settings: TileSettings
    coding: Coding
    tiles: list[TileRun]
    """The tiles, in the order of the sample."""

    def is_of(self, settings: TileSettings, coding: Coding) -> bool:
        """Whether the tiles would be coded to these streams, and decode to the same values."""
        return self.settings.head is settings.head and self.has_streams_of(settings, coding)

    def has_streams_of(self, settings: TileSettings, coding: Coding) -> bool:
        """Whether the tiles would be coded to these streams.

        A head changes what streams decode to, but no byte of them without a bound or joint coding.
        """
        if self.coding != coding:
            return False
        alone = coding.error is None and not coding.joint
        if self.settings.head is not settings.head and not alone:
            return False
        return replace(self.settings, head=None) == replace(settings, head=None)


class Known:
    """The latest runs of a sample."""

    def __init__(self) -> None:
        """Begin without any."""
        self._runs: list[Run] = []

    def run(self, settings: TileSettings, coding: Coding) -> Run | None:
        """Return the run of these settings and coding; None where it was not kept."""
        return next((run for run in self._runs if run.is_of(settings, coding)), None)

    def same_streams(self, settings: TileSettings, coding: Coding) -> Run | None:
        """Return a run of the same streams; None where none was kept."""
        runs = self._runs
        return next((run for run in runs if run.has_streams_of(settings, coding)), None)

    def keep(self, run: Run) -> None:
        """Keep a run, and forget the oldest of too many bytes."""
        self._runs.insert(0, run)
        total = 0
        for number, each in enumerate(self._runs):
            total += sum(len(tile.stream) for tile in each.tiles)
            if total > MAX_BYTES:
                del self._runs[number:]
                break
