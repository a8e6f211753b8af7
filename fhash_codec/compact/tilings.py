"""Choice of the shape of the tiles by trials."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from math import prod

from fhash_codec.compact.attempt import (
    FIRST_STEPS,
    MARGIN,
    MAX_VERTICES,
    MAX_WHOLE_VERTICES,
    PRICES,
    PlanTask,
    Tiling,
    burden,
    cheap_tiling,
    decoding_ns,
    is_small,
    region_vertices,
    tiles_to_try,
)
from fhash_codec.compact.goal import EXCHANGE, exchange, find_step, step_after, step_after_gain
from fhash_codec.compact.sample import MAX_PRICED_EFFORT, Sample, priced, strata
from fhash_codec.compact.tiles import Blocks, Coding, Index, Outcome
from fhash_codec.compact.transform import (
    MAX_BASIS_LENGTH,
    basis_bytes,
    in_plane,
    lines_of_trials,
    refit,
    rough_transform,
    tile_costs,
    usual_transform,
    wavelet,
)
from fhash_formats.container.reader import CACHE_BYTES
from fhash_formats.transform.spec import AxisTransform
from fhash_formats.transform.tile_format import Shape, TileSettings

PICKED_VERTICES = 1 << 19
"""Vertices coded for each trial of a transform."""
ENTRY_BYTES = 16
"""Bytes of the directory of a file for each tile."""
MIN_EXCHANGE = 2.0
"""Fewest dB that an octave of bytes is believed to buy."""
MAX_EXCHANGE = 8.0
"""Most dB that it is believed to buy."""
FAR = 0.25
"""Difference in dB from which on a tiling is coded again, with a step of its own."""
MOST_MISSING = 6.0
"""Difference in dB that is corrected for, at most."""


class Trials:
    """Tilings of a series, or of parts of it, coded at one step.

    Where the fast coder is used for trials, and no residual, they are priced by it instead.

    Attributes:
        shape: of the series, or of each part.
        sizes: bytes of the series at equal quality by tiling, in the order of the trials.
        found: settings of each of them, and their outcome.
    """

    def __init__(
        self,
        task: PlanTask,
        blocks: Blocks,
        settings: TileSettings,
        coding: Coding,
        *,
        sharp: bool = False,
    ) -> None:
        self._task, self._blocks, self.shape = task, blocks, blocks.shape
        self._settings, self._coding = settings, task.goal.bounded(coding)
        self._is_priced = coding.fast and task.goal.error is None
        self._is_sharp = sharp
        self._known: dict[tuple[int, int], AxisTransform] = {}
        self._psnr: float | None = None
        self._plane: AxisTransform | None = None
        self._tries_own = True
        self._settled: list[Outcome] = []
        self.sizes: dict[Shape, float] = {}
        self.found: dict[Shape, tuple[TileSettings, Outcome]] = {}

    def size(self, tile: Shape) -> float:
        """Return the bytes of the series with a tile, which is coded if it was not before."""
        if tile not in self.sizes:
            settings, tried = self._settings, None
            if not settings.labels:
                settings, tried = self._picked(tile)
            sample = self._whole(tile)
            outcome = tried or sample.run(settings, self._coding)
            missing = self._missing(outcome)
            if abs(missing) > FAR and self._coding.error is None and not settings.labels:
                settings = replace(settings, step=step_after_gain(settings.step, -missing))
                outcome = sample.run(settings, self._coding)
            self._note(sample, outcome, settings)
        return self.sizes[tile]

    def settle(self, in_space: Shape | None) -> TileSettings:
        """Look for the step that keeps the promise with one tile, and return settings with it.

        All trials then take it.

        The first guess knows no good transform, and its step may be far too fine. With other tiles
        another step may be better; at that of one tile they then seem to cost more, never less.

        in_space: tile of all steps, on which transforms are tried sooner than on all vertices.
        """
        goal, settings = self._task.goal, self._settings
        if settings.labels or goal.size is not None or (not goal.error and not goal.psnr):
            return settings
        few = None
        if in_space is not None:
            few = self._sample(in_space, PICKED_VERTICES), self._picked(in_space)[0]
        found, tried = self._picked(self.shape)
        coding = self._coding
        if self.shape != self._task.blocks.shape:
            # A part coded without its bound seems cheap, and wins. With it columns of many steps
            # win under loose bounds, where they took 1.7 times the bytes (a shock within 5 %).
            coding = replace(coding, error=None)
        sample = self._whole(self.shape)
        if coding.fast and goal.psnr is not None:
            outcome = tried or sample.run(found, coding)
            slope = self._task.slope
            slope.restart()
            slope.note(found.step, outcome.psnr(goal.data_range))
            self._settled.append(outcome)
            found = refit(sample, replace(found, step=step_after(found, outcome, goal)))
            outcome = sample.run(found, coding)
            slope.note(found.step, outcome.psnr(goal.data_range))
            self._settled.append(outcome)
        elif coding.fast and few is not None and not self._is_sharp:
            searched, _ = find_step(*few, coding, goal, tries=2)
            found = refit(sample, replace(searched, transform=found.transform))
            outcome = sample.run(found, coding)
        else:
            found, outcome = find_step(sample, found, coding, goal, tries=2, tried=self._settled)
            # Bases made for the finer step of the first guess would take too many bytes.
            refitted = refit(sample, found)
            if refitted is not found:
                found, outcome = refitted, sample.run(refitted, coding)
        self._settings = replace(found, transform=settings.transform)
        self._note(sample, outcome, found)
        return self._settings

    def _picked(self, tile: Shape) -> tuple[TileSettings, Outcome | None]:
        """Return settings with a transform, and the outcome of the series if it was coded."""
        sample = self._sample(tile, PICKED_VERTICES)
        trials = priced(sample, self._settings, self._task.config.effort)
        settings, tried = rough_transform(
            trials,
            self._settings,
            self._coding,
            self._known_transforms(tile),
            lines_of_trials(sample.blocks),
            own=self._tries_own,
            sharp=self._is_sharp and self._is_priced,
        )
        if self._coding.fast and min(tile[1:]) > 1:
            # Bases in space that are no good for one tile are none for others.
            self._tries_own = settings.transform.axes[3].basis is not None
        for axis in (0, 1):
            self._known.setdefault((axis, tile[axis]), settings.transform.axes[axis])
        if self._coding.fast and self._plane is None:
            self._plane = settings.transform.axes[3]
        same = trials is sample or self._is_priced
        return settings, tried if sample.complete and same else None

    def _whole(self, tile: Shape) -> Sample:
        """Return all tiles, priced where that stands for coding them."""
        sample = self._sample(tile, 1 << 62)
        if not self._is_priced:
            return sample
        return priced(sample, self._settings, self._task.config.effort)

    def _sample(self, tile: Shape, vertices: int) -> Sample:
        blocks = self._blocks.retile(tile)
        settings = replace(self._settings, transform=usual_transform(blocks.tile))
        sample = Sample(blocks, vertices, self._task.workers, tick=self._task.parts.tick)
        return sample.filled(settings, 1)

    def _known_transforms(self, tile: Shape) -> dict[int, AxisTransform]:
        """Return the transforms that need no trial: those of axes as long, and wavelets along z."""
        known: dict[int, AxisTransform] = {}
        for (axis, length), transform in self._known.items():
            same = length == tile[axis] and (axis == 0 or transform.basis is None)
            if same or (axis == 1 and transform.wavelet and tile[1] > 1):
                kind, depth = transform.kind, transform.depth
                known[axis] = transform if same else wavelet(kind, depth, tile[1])
        if self._plane is not None and self._plane.wavelet:
            known |= in_plane(self._plane.kind, self._plane.depth, tile)
        return known

    def _note(self, sample: Sample, outcome: Outcome, settings: TileSettings) -> None:
        size = float(outcome.size)
        if self._coding.error is None:
            size *= 2 ** (self._missing(outcome) / self._exchange())
        size += ENTRY_BYTES * sum(sample.weights) + basis_bytes(settings.transform)
        self.sizes[sample.blocks.tile] = size
        self.found[sample.blocks.tile] = settings, outcome

    def _missing(self, outcome: Outcome) -> float:
        """Return the dB that an outcome is worse by than the first one."""
        psnr = outcome.psnr(self._task.goal.data_range)
        if math.isinf(psnr):
            return 0.0
        if self._psnr is None:
            self._psnr = psnr
        return min(max(self._psnr - psnr, -MOST_MISSING), MOST_MISSING)

    def _exchange(self) -> float:
        """Return the dB that an octave of bytes buys."""
        points = [(math.log2(o.size), o.psnr(self._task.goal.data_range)) for o in self._settled]
        return min(max(exchange(points, EXCHANGE), MIN_EXCHANGE), MAX_EXCHANGE)


TRIALS = 9
"""Tilings that are coded at most."""
STEEPNESSES = (0.75, 1.5)
"""Powers of the cuts that the extra bytes may grow with; the first one is assumed at first.

Where few steps are as good as many, and one step alone is not, they grow fast.
"""
DOUBT = 0.003
"""Squared error of foretold prices, as logarithms, that is worth a share e times another."""
FIT_SWEEPS = 3
"""Times that each share is fitted, given the others."""
MIN_EXTRA = 0.03
"""Share of extra bytes that a cut is assumed to cost at least."""
FASTER = 0.8
"""Ratio of a region's vertices below which it is worth another trial."""
CHEAPER = 0.98
"""Ratio of a large series' bytes below which slower tiles are worth another trial."""
CHEAPER_TRIALS = 3
"""Such trials at most."""
PLACES = 3
"""Columns of many steps, at most; there are two at least.

A single tile has bases of its own that fit no other.
"""
COLUMN_VERTICES = 4 << 20
"""Vertices of more than two of them together, at most."""
COLUMN_SPACE = 4096
"""Vertices of a column in space, at least."""


def tiling_without_trials(
    task: PlanTask, size: float, time: AxisTransform | None = None
) -> Tiling | None:
    """Return tiles by what is foretold where none are tried, at effort 1 or if asked; else None.

    size, time: see `cheap_tiling`.
    """
    config, shape = task.config, task.blocks.shape
    few = config.effort <= MAX_PRICED_EFFORT and config.access == "balanced"
    if few and is_small(shape):
        return Tiling(tile=shape, price=1.0)
    if config.effort > 1 and "tiles" not in config.without:
        return None
    return cheap_tiling(task.blocks.shape, size, config.access, time)


def choose_tiling(
    task: PlanTask, settings: TileSettings, coding: Coding, access: str, *, sharp: bool = False
) -> Tiling:
    """Choose the tiles of a series that is to be cut, by trial.

    settings: with the step that all trials take.
    access: the wish, a name of `PRICES`.
    sharp: see `Attempt`.
    """
    shape = task.blocks.shape
    if prod(shape) > MAX_WHOLE_VERTICES:
        candidates = tiles_of_large(task.blocks)
    else:
        candidates = tiles_to_try(shape, MAX_WHOLE_VERTICES, slabs=True)
    if candidates == [shape]:
        return Tiling(tile=shape, price=1.0)
    prices = _Prices(task, settings, coding, candidates, sharp)
    tile = _search(prices, access, shape)
    return Tiling(
        tile=tile,
        price=prices.price(tile),
        trials=prices.sizes,
        parts=prices.parts,
        found=None if prices.parts else prices.base.found.get(tile),
    )


class _Prices:
    """Prices of tilings of a series, tried on the whole of it or joined from those of its parts.

    A tile of more steps than the part with all of space is compared in a column with one of fewer
    steps and as much space, which fits both.

    Attributes:
        base: trials on the series, or on its parts with all of space.
        sizes: bytes of the series by tiling that was tried, in the order of the trials.
        parts: shapes of the parts; none where the whole series is tried.
        coder: whose work counts: labels have their own, all else may be of the fast one.
    """

    def __init__(
        self,
        task: PlanTask,
        settings: TileSettings,
        coding: Coding,
        candidates: list[Shape],
        sharp: bool,
    ) -> None:
        self._task, self._coding, self._settings, self._sharp = task, coding, settings, sharp
        self.coder = "labels" if settings.labels else "fast"
        self._columns: list[Trials] = []
        self.sizes: dict[Shape, float] = {}
        self.parts: list[Shape] = []
        blocks, longest = task.blocks, None
        if prod(blocks.shape) > MAX_WHOLE_VERTICES:
            blocks = self._cut_out(largest_tile(blocks.shape), 2)
            longest = _longest_column(candidates, blocks.shape)
        bound = (blocks.shape[0] if longest is None else longest[0], *blocks.shape[1:])
        self.candidates = [tile for tile in candidates if _fits(tile, bound)]
        in_space = _cut_in_space(self.candidates, blocks.shape)
        in_time = _cut_in_time(self.candidates, blocks.shape)
        slab = None if longest is None else _slab(self.candidates, blocks.shape)
        if longest is not None:
            in_time = in_space = _few_steps(longest, blocks.shape)
        self.base = Trials(task, blocks, self._settings, coding, sharp=sharp)
        self._settings = self.base.settle(in_space)
        # The error of the first one is what the others are compared at.
        for tile in (blocks.shape, in_space, slab, in_time, longest):
            if tile is not None:
                self.size(tile)
        self._cuts = [_Cuts(bound, in_time, (0,), self._extra(in_time, longest or blocks.shape))]
        across = max((1, 2, 3), key=lambda axis: (blocks.shape[axis], axis))
        if slab is not None:
            self._cuts.append(_Cuts(bound, slab, (across,), self._extra(slab, blocks.shape)))
        others = tuple(axis for axis in (1, 2, 3) if slab is None or axis != across)
        share = self._extra(in_space, blocks.shape)
        if slab is not None and in_space is not None:
            share = max((1 + share) / (1 + self._cuts[1].extra(in_space)) - 1, MIN_EXTRA)
        self._cuts.append(_Cuts(bound, in_space, others, share))
        self._one = self.sizes[blocks.shape] / (1 + self._cuts[0].extra(blocks.shape))
        """Bytes with one tile of as many steps as are tried, and all of space that is."""

    def size(self, tile: Shape) -> float:
        """Return the bytes of the series with a tile, which is tried if it was not before."""
        if tile not in self.sizes:
            if _fits(tile, self.base.shape):
                self.sizes[tile] = self.base.size(tile)
            else:
                few, column = _few_steps(tile, self.base.shape), self._column(tile)
                self.sizes[tile] = self.size(few) * column.size(tile) / column.size(few)
        return self.sizes[tile]

    def price(self, tile: Shape) -> float:
        """Return the bytes of a tiling as a multiple of the fewest of those tried."""
        return self.size(tile) / min(self.sizes.values())

    def foretold(self, tile: Shape) -> float:
        """Return the price that a tiling is likely to have."""
        extra = prod(1 + cuts.extra(tile) for cuts in self._cuts)
        return extra * self._one / min(self.sizes.values())

    def learn(self, tile: Shape) -> None:
        """Try a tiling, and correct what is foretold of others."""
        self.size(tile)
        _fit(self._cuts, {tried: size / self._one for tried, size in self.sizes.items()})

    def _extra(self, cut: Shape | None, uncut: Shape) -> float:
        """Return the extra bytes of cuts that were tried, as a share."""
        # Smaller tiles cost more at last, also where these cost nothing.
        return 0.0 if cut is None else max(self.size(cut) / self.size(uncut) - 1, MIN_EXTRA)

    def _column(self, tile: Shape) -> Trials:
        """Return trials on columns that a tile fits in, which are cut out if there are none."""
        for trials in self._columns:
            if _fits(tile, trials.shape):
                return trials
        columns = self._cut_out(tile, min(PLACES, max(2, COLUMN_VERTICES // prod(tile))))
        trials = Trials(self._task, columns, self._settings, self._coding, sharp=self._sharp)
        self._columns.append(trials)
        return self._columns[-1]

    def _cut_out(self, tile: Shape, count: int) -> Blocks:
        """Return boxes of the shape of a tile at some places, chosen by their costs."""
        self.parts.append(tile)
        blocks = self._task.blocks.retile(tile)
        usual = replace(self._settings, transform=usual_transform(tile))
        costs = tile_costs(blocks, usual, self._task.workers)
        if costs is None:
            return blocks.window(tile)
        indices = list(blocks.indices())
        chosen = strata(costs, count)
        # Transforms are tried on the first one.
        chosen.sort(key=lambda pair: costs[pair[0]], reverse=True)
        places = [_first_vertex(indices[number], tile) for number, _ in chosen]
        return blocks.boxes(tile, places, [weight for _, weight in chosen])


def _search(prices: _Prices, access: str, shape: Shape) -> Shape:
    """Return the tile of the least burden among those tried whose price is allowed."""
    allowed = max(PRICES[access] - MARGIN, 1.0)
    bits = 8 * min(prices.sizes.values()) / prod(shape)
    ns = decoding_ns(bits, prices.coder)

    def work(tile: Shape) -> float:
        return region_vertices(shape, tile)

    def burden_of(tile: Shape) -> float:
        return burden(access, prices.price(tile), work(tile), ns)

    def best() -> Shape:
        return min((tile for tile in prices.sizes if prices.price(tile) <= allowed), key=burden_of)

    if prices.parts:
        _look_for_fewer_bytes(prices)
    while len(prices.sizes) < TRIALS:
        least, limit = burden_of(best()), FASTER * work(best())
        likely = [
            (burden(access, prices.foretold(tile), work(tile), ns), tile)
            for tile in prices.candidates
            if tile not in prices.sizes and work(tile) < limit and prices.foretold(tile) <= allowed
        ]
        told, tile = min(likely, default=(math.inf, shape))
        if told >= least:
            break
        prices.learn(tile)
    return best()


def _look_for_fewer_bytes(prices: _Prices) -> None:
    """Try the tilings of a large series that are likely to take the fewest bytes."""
    for _ in range(CHEAPER_TRIALS):
        fresh = [tile for tile in prices.candidates if tile not in prices.sizes]
        tile = min(fresh, key=prices.foretold, default=None)
        if tile is None or prices.foretold(tile) > CHEAPER:
            break
        prices.learn(tile)


class _Cuts:
    """Price of cuts along some axes, by one trial with such cuts alone.

    Attributes:
        share: extra bytes of the trial, as a share of those without cuts.
        steepness: power of the cuts that the extra bytes grow with.
    """

    def __init__(
        self, shape: Shape, tried: Shape | None, axes: tuple[int, ...], share: float
    ) -> None:
        self._shape, self._axes, self._tried = shape, axes, tried
        self.share = share
        self.steepness = STEEPNESSES[0]
        self.likely = [
            (share * 2.0 ** (power / 2), steepness)
            for power in range(-2, 7)
            for steepness in STEEPNESSES
        ]
        """Shares and steepnesses that a fit may find."""
        self.first = share

    def ratio(self, tile: Shape) -> float:
        """Return the cuts of a tile as a multiple of those of the trial."""
        if self._tried is None:
            return 0.0
        many, few = (
            sum(
                1 / one[axis] - 1 / self._shape[axis]
                for axis in self._axes
                if one[axis] < self._shape[axis]
            )
            for one in (tile, self._tried)
        )
        return many / few if few else 0.0

    def extra(self, tile: Shape) -> float:
        """Return the extra bytes that a tile is likely to cost, as a share."""
        return self.share * math.pow(self.ratio(tile), self.steepness)


def _fit(cuts: list[_Cuts], found: dict[Shape, float]) -> None:
    """Set what cuts cost to what tells the trials best.

    found: bytes of tilings as a multiple of those without cuts.
    """

    def unlikely() -> float:
        wrong = sum(
            math.log(size / prod(1 + cut.extra(tile) for cut in cuts)) ** 2
            for tile, size in found.items()
        )
        # Where trials say nothing of it, a cut costs what the first one did.
        return wrong + DOUBT * sum(
            math.log(cut.share / cut.first) ** 2 for cut in cuts if cut.first
        )

    for cut in FIT_SWEEPS * cuts:
        tried = []
        for option in cut.likely:
            cut.share, cut.steepness = option
            tried.append((unlikely(), option))
        cut.share, cut.steepness = min(tried)[1]


def _cut_in_time(candidates: list[Shape], shape: Shape) -> Shape | None:
    """Return a tile of all space and few steps; None for a series of one step."""
    cut = [tile for tile in candidates if tile[0] < shape[0] and tile[1:] == shape[1:]]
    # Few steps, or as many as a basis of the data's own may have.
    steps = MAX_BASIS_LENGTH if shape[0] > MAX_BASIS_LENGTH else max(4, shape[0] / 4)
    return min(cut, key=lambda tile: abs(tile[0] - steps), default=None)


def _cut_in_space(candidates: list[Shape], shape: Shape) -> Shape | None:
    """Return a tile of all steps and part of the space; None where space is not cut."""
    cut = [tile for tile in candidates if tile[0] == shape[0] and tile[1:] != shape[1:]]
    edge = max(shape[1:]) / 2

    def unlike(tile: Shape) -> float:
        pairs = zip(tile[1:], shape[1:], strict=True)
        return sum(abs(math.log(n / min(m, edge))) for n, m in pairs)

    return min(cut, key=unlike, default=None)


def _slab(candidates: list[Shape], shape: Shape) -> Shape | None:
    """Return a tile that is cut across the longest axis in space alone; None where none is."""
    across = max((1, 2, 3), key=lambda axis: (shape[axis], axis))
    cut = [
        tile
        for tile in candidates
        if [axis for axis in range(4) if tile[axis] < shape[axis]] == [across]
    ]
    return min(cut, key=lambda tile: abs(tile[across] - shape[across] / 2), default=None)


def largest_tile(shape: Shape) -> Shape:
    """Return the tile of the most space and then the most steps, some at least, that may be tried.

    It is that of a series that is too large for a single one.
    """
    tiles = tiles_to_try(shape, MAX_VERTICES)
    some = [tile for tile in tiles if tile[0] >= min(FIRST_STEPS, shape[0])]
    return max(some or tiles, key=lambda tile: (prod(tile[1:]), tile[0]))


def tiles_of_large(blocks: Blocks) -> list[Shape]:
    """Return the tiles that may be tried for a series that is too large for a single one.

    A reader that goes from step to step keeps the tiles of a layer as far as its cache reaches; of
    longer ones it would decode all for each step.
    """
    frame = prod(blocks.shape[1:]) * blocks.dtype.itemsize
    steps = max(CACHE_BYTES // frame, largest_tile(blocks.shape)[0])
    tiles = tiles_to_try(blocks.shape, MAX_VERTICES, slabs=True)
    return [tile for tile in tiles if tile[0] <= steps]


def _longest_column(candidates: list[Shape], base: Shape) -> Shape | None:
    """Return the tile of the most steps, and then the most space, as a column; None for none.

    base: shape of the part with all of space.
    """
    columns = [
        tile
        for tile in candidates
        if tile[0] > base[0]
        and prod(tile[1:]) >= COLUMN_SPACE
        and prod(tile) * PLACES <= COLUMN_VERTICES
        and _fits(tile[1:], base[1:])
        and len({n for n, m in zip(tile[1:], base[1:], strict=True) if n < m}) <= 1
    ]
    return max(columns, key=lambda tile: (tile[0], prod(tile[1:])), default=None)


def _few_steps(tile: Shape, base: Shape) -> Shape:
    """Return the part of a tile that fits in another one."""
    t, z, y, x = (min(n, m) for n, m in zip(tile, base, strict=True))
    return t, z, y, x


def _fits(tile: Sequence[int], other: Sequence[int]) -> bool:
    """Whether a tile is no longer than another one along any axis."""
    return all(n <= m for n, m in zip(tile, other, strict=True))


def _first_vertex(index: Index, tile: Shape) -> Index:
    """Return the first vertex of a tile."""
    t, z, y, x = (number * n for number, n in zip(index, tile, strict=True))
    return t, z, y, x
