"""Samples on which choices are tried: tiles, their filling and masks, and steps left out."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from functools import lru_cache
from itertools import pairwise
from math import prod
from typing import Any, NamedTuple, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.model import values_between
from fhash_codec.compact.tiles import (
    Blocks,
    Coding,
    Index,
    Known,
    Outcome,
    Run,
    Tile,
    TileRun,
    code,
    measured,
    recoded,
    total,
)
from fhash_codec.features.features import Extent, Feature, Interval, Isosurface, Segmentation
from fhash_codec.features.key_frames import KeyTimes, time_axis
from fhash_codec.measure.value_range import ValueRange, power_of_two
from fhash_formats.container.header import BETWEEN, CUBIC, LINEAR
from fhash_formats.series import Series
from fhash_formats.support.threads import map_ahead
from fhash_formats.support.values import Longs, Values
from fhash_formats.transform.spec import MAX_EDGES, MAX_REACH, UNIT, MaskLevels
from fhash_formats.transform.tile import filled
from fhash_formats.transform.tile_format import TileSettings


def fill(tile: Tile, settings: TileSettings, density: int) -> Tile:
    """Return a tile with other values, of the same type, where vertices do not count.

    Vertices whose value is not finite do not count either: the returned mask excludes them.

    settings: transform and step for which the values shall be cheap; with other settings they are
        still better than the values of the source.
    density: thoroughness, see `fhash_formats.transform.tile.filled`; with 0 the values of
        the source stay if all of them are finite.
    """
    values, in_coreset = tile
    if in_coreset is None:
        return tile
    if density == 0:
        if values.dtype.kind != "f" or np.isfinite(values).all():
            return tile
        density = 1
    finite = np.isfinite(values) if values.dtype.kind == "f" else np.ones(values.shape, bool)
    counted = finite & in_coreset
    if counted.all() or not counted.any():
        return tile
    center = settings.dtype.type(settings.center)
    with np.errstate(over="ignore", invalid="ignore"):
        target = np.where(finite, values, 0).astype(settings.dtype) - center
        filling = filled(target, counted, finite, settings, density) + center
        # Values beyond the range take fewer bytes, and readers clip them; integers may have none.
        beyond = settings.high - settings.low if values.dtype.kind == "f" else 0
        filling = np.clip(filling, settings.low - beyond, settings.high + beyond)
        if values.dtype.kind != "f":
            filling = np.rint(filling)
        return Tile(np.where(counted, values, filling.astype(values.dtype)), counted)


Item = TypeVar("Item")
Result = TypeVar("Result")
Grams = dict[tuple[int, float], npt.NDArray[np.float64]]
"""Products of lines by axis and centre."""
_grams: WeakKeyDictionary[Blocks, Grams] = WeakKeyDictionary()

GOLDEN_RATIO = 0.6180339887498949
"""Fractional part of the golden ratio: its multiples modulo 1 are spread evenly."""
MAX_TILES_AHEAD = 16
"""Tiles of a series larger than memory that are worked on at a time."""
MIN_COST_SHARE = 0.05
"""Share of the mean cost that is added to each tile's cost: the sample needs cheap tiles, too."""


def spread_order(count: int) -> list[int]:
    """Return the numbers 0 to count - 1 in an order of which each beginning is spread evenly.

    The order follows the golden ratio, so that no row or column of a grid of tiles is preferred.
    """
    return sorted(range(count), key=lambda number: number * GOLDEN_RATIO % 1.0)


def strata(costs: Sequence[float], max_tiles: int) -> list[tuple[int, int]]:
    """Choose tiles by cost: pairs of a tile and the number of tiles it stands for, in tile order.

    Tiles of similar cost form a stratum; its middle tile stands for all of them. All strata cost
    about the same, so an expensive tile stands for itself and a cheap one for many. A single
    stratum has tiles of all costs: the one nearest to their mean stands for them, since most of
    them may be nearly empty.

    costs: approximate cost of each tile.
    max_tiles: number of tiles chosen at most.
    """
    if max_tiles == 1:
        return [(int(np.abs(np.asarray(costs) - np.mean(costs)).argmin()), len(costs))]
    order = np.argsort(costs, kind="stable")
    floor = MIN_COST_SHARE * float(np.mean(costs)) or 1.0
    so_far = np.cumsum(np.asarray(costs, dtype=np.float64)[order] + floor)
    shares = so_far / so_far[-1] * max_tiles * (1 - 1e-12)
    groups = np.minimum(shares.astype(int), max_tiles - 1)
    chosen = []
    for group in np.unique(groups):
        members = order[groups == group]
        chosen.append((int(members[len(members) // 2]), len(members)))
    return sorted(chosen)


TINY = 512
"""Vertices below which a tile takes longer to set up, 0.3 ms, than its values to code."""
FEW_TILES = 512
"""Tiny tiles of a sample at most: each trial of them then takes a fraction of a second."""


def _tiles_of(blocks: Blocks, max_vertices: int) -> int:
    """The tiles of a sample of at most so many vertices."""
    count = max(1, max_vertices // prod(blocks.tile))
    return min(count, FEW_TILES) if prod(blocks.tile) < TINY else count


class _Job(NamedTuple):
    """A tile to be coded, or only to be decoded where its stream is known."""

    tile: Tile
    settings: TileSettings
    coding: Coding
    before: TileRun | None
    """Its stream, and the outcome with this head or another."""

    def run(self) -> tuple[TileRun, Values]:
        """Return the tile as it is coded, and its decoded values."""
        if self.before is None:
            coded, outcome = code(self.tile, self.settings, self.coding)
        else:
            stream, known = self.before
            coded = recoded(self.tile, stream, self.settings, known.nonzero)
            outcome = measured(self.tile, coded, self.settings, self.coding)
        return TileRun(coded.data, outcome), coded.decoded


class Sample:
    """Tiles in memory that stand for all tiles of a series.

    Attributes:
        blocks: the series as a grid of tiles.
        tiles: the tiles of the sample.
        indices: their indices in the grid.
        weights: number of tiles of the series that each of them stands for.
        complete: whether the sample has all tiles with vertices that count.
        counted: approximate number of vertices that count in the series.
        grams: products of lines of all tiles of the series, by axis and centre, once computed;
            samples of the same grid share them.
    """

    def __init__(
        self,
        blocks: Blocks,
        max_vertices: int,
        pool: ThreadPoolExecutor,
        costs: Sequence[float] | None = None,
        tick: Callable[[], None] = lambda: None,
    ) -> None:
        """Read tiles of at most `max_vertices` vertices together, at least one tile.

        costs: approximate cost of each tile, in C order. Tiles are then chosen by `strata`, else
        spread evenly.
        tick: called after each tile that is worked on, in the thread that asked for the work.
        """
        indices = list(blocks.indices())
        count = min(len(indices), _tiles_of(blocks, max_vertices))
        chosen = _choose_tiles(len(indices), count, costs)
        places = [indices[number] for number, _ in chosen]
        read = (pool.map if blocks.in_memory else map)(blocks.read, places)
        tiles = [
            (index, tile, weight * blocks.weight(index))
            for index, tile, (_, weight) in zip(places, read, chosen, strict=True)
        ]
        # At least one tile, even if no vertex counts.
        tiles = [entry for entry in tiles if not entry[1].is_empty] or tiles[:1]
        self.indices = [index for index, _, _ in tiles]
        self.tiles = [tile for _, tile, _ in tiles]
        self.weights = [weight for _, _, weight in tiles]
        self.complete = count == len(indices)
        self.counted = sum(weight * tile.counted_vertices for _, tile, weight in tiles)
        self.blocks = blocks
        self.grams = _grams.setdefault(blocks, {})
        self._pool, self._costs, self._source = pool, costs, self.tiles
        self._filling: tuple[TileSettings, int] | None = None
        self._known = Known()
        self.tick = tick

    @property
    def allows_bases(self) -> bool:
        """Whether the series is in memory: bases of its own read all of it once more."""
        return self.blocks.in_memory

    @property
    def filling(self) -> tuple[TileSettings, int] | None:
        """Settings and density by which the tiles were filled; None for tiles of the source."""
        return self._filling

    def narrower(self, max_vertices: int) -> Sample:
        """Return a sample of fewer tiles, of `max_vertices` together at most, or a single one.

        They are filled in the same way.
        """
        other = Sample(self.blocks, max_vertices, self._pool, self._costs, self.tick)
        return other if self._filling is None else other.filled(*self._filling)

    def filled(self, settings: TileSettings, density: int) -> Sample:
        """Return the same tiles, filled for these settings (see `fill`) from the source."""
        if self.blocks.complete:
            return self
        other = copy(self)
        other._filling, other._known = (settings, density), Known()
        filled = self._pool.map(lambda tile: fill(tile, settings, density), self._source)
        other.tiles = list(self._ticking(filled))
        return other

    def map(self, work: Callable[[Tile], Result]) -> list[Result]:
        """Return the results of `work` for the tiles of the sample, in order, by all threads."""
        return list(self._ticking(self._pool.map(work, self.tiles)))

    def each(self, work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
        """Return the results of `work` for items, one of each tile of the sample."""
        return list(self._ticking(self._pool.map(work, items)))

    def map_all(self, work: Callable[[Tile], Result]) -> Iterator[Result]:
        """Yield the results of `work` for all tiles of the series, in C order."""
        indices = list(self.blocks.indices())
        if self.blocks.in_memory:
            results = self._pool.map(lambda index: work(self.blocks.read(index)), indices)
            yield from self._ticking(results)
        else:
            tiles = (self.blocks.read(index) for index in indices)
            yield from self._ticking(map_ahead(self._pool, work, tiles, MAX_TILES_AHEAD))

    def run(self, settings: TileSettings, coding: Coding) -> Outcome:
        """Code the tiles; the outcome that the series would have, by their weights."""
        return self.run_all([(settings, coding)])[0]

    def run_all(self, trials: Sequence[tuple[TileSettings, Coding]]) -> list[Outcome]:
        """Return the outcome of `run` for each pair of settings and coding.

        All trials run at once, so that a few large tiles keep all processors busy, too. What was
        coded before is not coded again.
        """
        runs = [self._known.run(*trial) for trial in trials]
        new = [trial for trial, run in zip(trials, runs, strict=True) if run is None]
        jobs = [
            _Job(tile, *trial, before)
            for trial in new
            for tile, before in zip(self.tiles, self._before(*trial), strict=True)
        ]
        results = list(self._ticking(self._pool.map(lambda job: job.run()[0], jobs)))
        number = len(self.tiles)
        fresh = [
            Run(*trial, results[start : start + number])
            for start, trial in zip(range(0, len(results), number), new, strict=True)
        ]
        for run in fresh:
            self._known.keep(run)
        found = iter(fresh)
        whole = [next(found) if run is None else run for run in runs]
        return [total([tile.outcome for tile in run.tiles], self.weights) for run in whole]

    def coded(self, settings: TileSettings, coding: Coding) -> dict[Index, TileRun]:
        """Return the tiles by their indices if they were coded so before, else nothing."""
        run = self._known.run(settings, coding)
        return {} if run is None else dict(zip(self.indices, run.tiles, strict=True))

    def decoded(self, settings: TileSettings, coding: Coding) -> list[npt.NDArray[np.float32]]:
        """Code and decode the tiles; the decoded values, float32."""
        before = self._before(settings, coding)
        jobs = [
            _Job(tile, settings, coding, known)
            for tile, known in zip(self.tiles, before, strict=True)
        ]
        runs = list(self._ticking(self._pool.map(_Job.run, jobs)))
        self._known.keep(Run(settings, coding, [run for run, _ in runs]))
        return [values.astype(np.float32) for _, values in runs]

    def _before(self, settings: TileSettings, coding: Coding) -> Sequence[TileRun | None]:
        """Return each tile as it was coded before, where it was, perhaps with another head."""
        run = self._known.same_streams(settings, coding)
        return [None] * len(self.tiles) if run is None else run.tiles

    def _ticking(self, results: Iterable[Result]) -> Iterator[Result]:
        """Yield results, and call `tick` after each has come."""
        for result in results:
            self.tick()
            yield result


def _choose_tiles(tiles: int, count: int, costs: Sequence[float] | None) -> list[tuple[int, int]]:
    """Choose `count` of the tiles; pairs as of `strata`."""
    if count == tiles:
        return [(number, 1) for number in range(count)]
    if costs is not None:
        return strata(costs, count)
    # In C order: a reader of a large series keeps one layer of tiles only.
    weights = [tiles * (place + 1) // count - tiles * place // count for place in range(count)]
    return list(zip(sorted(spread_order(tiles)[:count]), weights, strict=True))


EDGE_OFFSETS = {
    1: (0, 0.15, 0.35, 0.6, 1, 1.5, 2.2, 3.2),
    2: (0, 0.4, 1, 2.2),
    5: (0, 0.8),
    MAX_EDGES: (0,),
}
"""Edges to both sides of a threshold, in errors, by the largest number of thresholds for them."""
MIN_PROBABILITY = 2.0**-16
"""Smallest probability that a score expresses."""
CLASSES = 16
"""Number of classes of values where scores are learned."""


def mask_levels(
    features: Sequence[Feature], dilation: int, error: float, tiles: Iterable[Tile]
) -> MaskLevels:
    """Return the scores for features.

    Features without thresholds, or with too many of them, are learned from tiles.

    features: what was selected.
    dilation: vertices by which the features were grown.
    error: root of the mean squared error of the decoded values, in data units.
    tiles: tiles of a sample.
    """
    reach = min(dilation, MAX_REACH)
    error = max(error, 1e-30)
    if len(features) == 1 and isinstance(features[0], Isosurface):
        return _isosurface_levels(features[0].value, reach, error)
    spans = [_span(feature) for feature in features]
    thresholds = sorted(
        {end for span in spans if span is not None for end in span if math.isfinite(end)}
    )
    if None in spans or not 1 <= len(thresholds) <= MAX_EDGES:
        return _learned_levels(tiles)
    edges = _edges(thresholds, error)
    outside = [
        math.prod(
            1 - _normal((high - center) / error) + _normal((low - center) / error)
            for low, high in filter(None, spans)
        )
        for center in _centers(edges, error)
    ]
    return MaskLevels(edges=edges, scores=tuple(_score(1 - p) for p in outside), reach=reach)


def _isosurface_levels(value: float, reach: int, error: float) -> MaskLevels:
    """Return the scores that a vertex lies above and below an isosurface."""
    edges = _edges([value], error)
    above = [_normal((center - value) / error) for center in _centers(edges, error)]
    return MaskLevels(
        edges=edges,
        scores=tuple(_score(p) for p in above),
        others=tuple(_score(1 - p) for p in above),
        reach=max(reach, 1),
    )


def _span(feature: Feature) -> tuple[float, float] | None:
    """Return the interval of values that a feature selects; None if it selects otherwise."""
    if isinstance(feature, Interval):
        return feature.low, feature.high
    if isinstance(feature, Segmentation) and feature.threshold is not None:
        return feature.threshold, math.inf
    return None


def _edges(thresholds: list[float], error: float) -> tuple[float, ...]:
    """Return the edges of the classes of values around thresholds."""
    offsets = EDGE_OFFSETS[min(count for count in EDGE_OFFSETS if count >= len(thresholds))]
    edges = {
        _rounded(threshold + sign * offset * error)
        for threshold in thresholds
        for offset in offsets
        for sign in (-1, 1)
    }
    return tuple(sorted(edges))[:MAX_EDGES]


def _centers(edges: tuple[float, ...], error: float) -> list[float]:
    """Return a value that stands for each class."""
    inner = [low + (high - low) / 2 for low, high in pairwise(edges)]
    return [edges[0] - 0.8 * error, *inner, edges[-1] + 0.8 * error]


def _learned_levels(tiles: Iterable[Tile]) -> MaskLevels:
    """Return scores by the share of vertices that count in each of some classes of equal size."""
    tiles = list(tiles)
    values = np.concatenate([tile.values.ravel() for tile in tiles])
    counted = np.concatenate(
        [
            np.ones(tile.values.size, bool) if tile.counted is None else tile.counted.ravel()
            for tile in tiles
        ]
    )
    finite = np.isfinite(values)
    values, counted = values[finite].astype(np.float64), counted[finite]
    if not values.size:
        return MaskLevels()
    quantiles = np.quantile(values, np.arange(1, CLASSES) / CLASSES)
    edges = tuple(sorted({_rounded(float(edge)) for edge in quantiles}))
    classes = np.searchsorted(edges, values, side="right")
    sizes = np.bincount(classes, minlength=len(edges) + 1)
    counted_sizes = np.bincount(classes, weights=counted, minlength=len(edges) + 1)
    shares = counted_sizes / np.maximum(sizes, 1)
    return MaskLevels(edges=edges, scores=tuple(_score(float(p)) for p in shares))


def _score(p: float) -> int:
    """Return the score of a probability that a vertex counts."""
    return round(-UNIT * math.log2(max(1 - p, MIN_PROBABILITY)))


def _normal(deviation: float) -> float:
    """Return the standard normal distribution function."""
    if not math.isfinite(deviation):
        return float(deviation > 0)
    return 0.5 * (1 + math.erf(deviation / math.sqrt(2)))


def _rounded(value: float) -> float:
    """Return a value of few digits: the settings are stored as text."""
    return float(f"{value:.7g}")


LEFT_OUT = 16
"""Steps that are left out to choose the rule, at most."""
READ = 7
"""Frames that are held for it: of neighbours that are left out, none is read twice."""
VERTICES = 4096
"""Vertices that are compared at each of them, at most: a millisecond."""


def choose_between(series: Series, extent: Extent, value_range: ValueRange) -> dict[str, Any]:
    """Return what a header's `model` says of times between steps; nothing where none is measured.

    Some steps are left out and rebuilt from those at both sides, by each rule, at some vertices of
    the coreset. Integers stay linear.
    """
    count, width = series.shape[0], value_range.high - value_range.low
    if (series.source_dtype or series.dtype).kind != "f" or not 0 < width < math.inf or count < 5:
        return {}
    scale, squares = power_of_two(width), np.zeros(2)
    times = time_axis(series.coords["t"].values)

    frame = lru_cache(maxsize=READ)(lambda step: series.frame(step).reshape(-1))
    for left_out in np.unique(np.linspace(1, count - 2, LEFT_OUT).round().astype(int)).tolist():
        around = range(left_out - 3, left_out + 4, 2)
        keys = tuple(key for key in around if 0 <= key < count)
        vertices = _vertices(extent, range(left_out - 1, left_out + 2))
        held = {key: scale * frame(key)[vertices].astype(np.float64) for key in (*keys, left_out)}
        for key in keys:
            held[key][~_in_coreset(extent, key, vertices)] = np.nan
        frames = [held.get(key) for key in around]
        key_times, first = KeyTimes(times=times, key_frames=keys), keys.index(left_out - 1)
        distances = key_times.distances(first)
        share = np.array([key_times.key_index(left_out) - first])
        linear, _ = values_between([None, *frames[1:3], None], distances, share)
        cubic, _ = values_between(frames, distances, share)
        with np.errstate(invalid="ignore", over="ignore"):  # of values that are not finite
            errors = np.square(np.stack([linear, cubic]) - held[left_out])
        squares += errors[:, np.isfinite(errors).all(axis=0)].sum(axis=1)
    if squares[0] == squares[1]:
        return {}
    gain = 10 * math.log10(squares[0] / squares[1]) if squares.all() else None
    rule = CUBIC if squares[1] < squares[0] else LINEAR
    return {BETWEEN: {"rule": rule, "gain_db": None if gain is None else round(gain, 2)}}


def _vertices(extent: Extent, steps: range) -> Longs:
    """Return vertices of a frame that are in the coreset at all of some steps.

    They follow the golden ratio, so that no row or column is preferred.
    """
    size, vertices = math.prod(extent.domain), None
    if extent.fraction < 1:
        packed = np.bitwise_and.reduce(extent.packed[steps.start : steps.stop])
        vertices = np.flatnonzero(np.unpackbits(packed, count=size))
        size = vertices.size
    spread = np.arange(min(VERTICES, size)) * GOLDEN_RATIO % 1.0 * size
    chosen = spread.astype(np.int64)
    return chosen if vertices is None else vertices[chosen]


def _in_coreset(extent: Extent, step: int, vertices: Longs) -> npt.NDArray[np.bool_]:
    """Return which vertices of a frame are in the coreset at a step."""
    bits = extent.packed[step][vertices >> 3] >> (7 - (vertices & 7)) & 1
    return np.asarray(bits, np.bool_)
