"""Choice of the tiles by trial: those of the fastest region whose price is allowed.

Each tiling tried is coded whole, with one step and plainly (no head, no second pass), beside the
series as one tile. What later stages save, they save in about the same proportion with any tiles.
Two tilings, one cut in time and one in space, tell the price of the others roughly, so that few
more need a trial.
"""

from __future__ import annotations

import math
from dataclasses import replace
from math import prod

from fhash_codec.compact.attempt import PlanTask
from fhash_codec.compact.choices.bases import MAX_BASIS_LENGTH
from fhash_codec.compact.choices.step import find_step
from fhash_codec.compact.choices.transform import (
    ERROR_PRICE,
    rough_transform,
    usual_transform,
    wavelet,
)
from fhash_codec.compact.tiles.access import (
    MARGIN,
    MAX_WHOLE_VERTICES,
    PRICES,
    Tiling,
    TilingTrial,
    burden,
    cheap_tiling,
    region_vertices,
    tiles_to_try,
)
from fhash_codec.compact.tiles.blocks import Blocks
from fhash_codec.compact.tiles.coding import Coding, Outcome
from fhash_codec.compact.tiles.sample import Sample
from fhash_codec.compact.tiles.tiling import MAX_VERTICES
from fhash_formats.transform.axes.spec import AxisTransform
from fhash_formats.transform.tile.sections import Shape
from fhash_formats.transform.tile.settings import TileSettings

__all__ = ["choose_tiling", "largest_tile", "tiling_without_trials"]

PICKED_VERTICES = 1 << 19
"""Vertices coded for each trial of a transform."""
FITTED_LINES = 1 << 15
"""Lines of a series that the data's own bases are fitted on, for trials."""
MIN_LINES = 256
"""The least of them in each tile."""
TRIALS = 9
"""Tilings that are coded at most."""
STEEPNESS = 0.75
"""Power of the cuts that the extra bytes grow with."""
MIN_EXTRA = 0.03
"""Share of extra bytes that a cut is assumed to cost at least."""
FASTER = 0.8
"""Ratio of a region's vertices below which it is worth another trial."""
ENTRY_BYTES = 16
"""Bytes of the directory of a file for each tile."""


def tiling_without_trials(task: PlanTask, size: float) -> Tiling | None:
    """Return tiles by what is foretold where none are tried, at effort 1 or if asked; else None.

    size: bytes of the series, roughly.
    """
    config = task.config
    if config.effort > 1 and "tiles" not in config.without:
        return None
    return cheap_tiling(task.blocks.shape, size, config.access)


class _Trials:
    """Tilings of a series, or of a part of it, coded at one step."""

    def __init__(
        self, task: PlanTask, blocks: Blocks, settings: TileSettings, coding: Coding
    ) -> None:
        self._task, self._blocks = task, blocks
        self._settings, self._coding = settings, task.goal.bounded(coding)
        self._known: dict[tuple[int, int], AxisTransform] = {}
        self._squares: float | None = None
        self.sizes: dict[Shape, float] = {}
        """Bytes at equal quality of each tiling, in the order of the trials."""

    def size(self, tile: Shape) -> float:
        """Return the bytes of the series with a tile, which is coded if it was not before."""
        if tile not in self.sizes:
            if self._settings.labels:
                outcome = self._sample(tile, 1 << 62).run(self._settings, self._coding)
                return self._note(tile, outcome, self._settings)
            settings, tried = self._picked(tile)
            if tried is None:
                tried = self._sample(tile, 1 << 62).run(settings, self._coding)
            self._note(tile, tried, settings)
        return self.sizes[tile]

    def settle(self, whole: Shape, in_space: Shape | None) -> None:
        """Look for the step that keeps the promise with one tile, which all trials then take.

        The first guess knows no good transform, and its step may be far too fine. With other tiles
        another step may be better; at that of one tile they then seem to cost more, never less.

        whole: of one tile.
        in_space: tile of all steps, on which transforms are tried sooner than on all vertices.
        """
        goal, settings = self._task.goal, self._settings
        if settings.labels or goal.size is not None or (not goal.error and not goal.psnr):
            return
        if in_space is not None:
            self._picked(in_space)
        found, _ = self._picked(whole)
        coding = replace(self._coding, error=None)
        sample = self._sample(whole, 1 << 62)
        found, outcome = find_step(sample, found, coding, goal, tries=2)
        self._settings = replace(found, transform=settings.transform)
        self._note(whole, outcome, found)

    def _picked(self, tile: Shape) -> tuple[TileSettings, Outcome | None]:
        """Return settings with a transform, and the outcome of the series if it was coded."""
        sample = self._sample(tile, PICKED_VERTICES)
        settings, tried = rough_transform(
            sample,
            self._settings,
            self._coding,
            self._known_for(tile),
            max(FITTED_LINES // prod(sample.blocks.grid), MIN_LINES),
        )
        for axis in (0, 1):
            self._known.setdefault((axis, tile[axis]), settings.transform.axes[axis])
        return settings, tried if sample.complete else None

    def price(self, tile: Shape) -> float:
        """Return the bytes of a tiling as a multiple of the fewest of those tried."""
        return self.size(tile) / min(self.sizes.values())

    def _sample(self, tile: Shape, vertices: int) -> Sample:
        blocks = self._blocks.retile(tile)
        settings = replace(self._settings, transform=usual_transform(blocks.tile))
        sample = Sample(blocks, vertices, self._task.workers, tick=self._task.parts.tick)
        return sample.filled(settings, 1)

    def _known_for(self, tile: Shape) -> dict[int, AxisTransform]:
        """Return the transforms that need no trial: those of axes as long, and wavelets along z."""
        known: dict[int, AxisTransform] = {}
        for (axis, length), transform in self._known.items():
            same = length == tile[axis] and (axis == 0 or transform.basis is None)
            if same or (axis == 1 and transform.wavelet and tile[1] > 1):
                kind, depth = transform.kind, transform.depth
                known[axis] = transform if same else wavelet(kind, depth, tile[1])
        return known

    def _note(self, tile: Shape, outcome: Outcome, settings: TileSettings) -> float:
        tiles = prod(self._blocks.retile(tile).grid)
        self.sizes[tile] = self._at_equal_quality(outcome, settings, tiles)
        return self.sizes[tile]

    def _at_equal_quality(self, outcome: Outcome, settings: TileSettings, tiles: int) -> float:
        bases = [axis.basis for axis in settings.transform.axes if axis.basis is not None]
        size = outcome.size + ENTRY_BYTES * tiles + sum(len(b.to_bytes()) * 4 / 3 for b in bases)
        if self._coding.error is not None:
            return size
        if self._squares is None:
            self._squares = outcome.squares
        worse = (outcome.squares - self._squares) / (ERROR_PRICE * settings.step**2)
        return max(size + worse, 0.5 * size)


def choose_tiling(task: PlanTask, settings: TileSettings, coding: Coding, access: str) -> Tiling:
    """Choose the tiles of a series that is to be cut, by trial.

    settings: with the step that all trials take.
    access: the wish, a name of `PRICES`.
    """
    blocks, part = task.blocks, None
    if prod(blocks.shape) > MAX_WHOLE_VERTICES:
        blocks = task.blocks.window(largest_tile(task.blocks.shape))
        part = blocks.shape
    trials = _Trials(task, blocks, settings, coding)
    tile = _search(trials, blocks.shape, access)
    tried = [TilingTrial(tile=tile, size=size) for tile, size in trials.sizes.items()]
    price = trials.price(tile) if tried else 1.0
    return Tiling(tile=tile, price=price, trials=tried, part=part)


def _search(trials: _Trials, shape: Shape, access: str) -> Shape:
    """Return the tile of the least burden among those tried whose price is allowed."""
    allowed = max(PRICES[access] - MARGIN, 1.0)
    candidates = tiles_to_try(shape, MAX_WHOLE_VERTICES)
    if candidates == [shape]:
        return shape
    in_space, in_time = _cut_in_space(candidates, shape), _cut_in_time(candidates, shape)
    trials.settle(shape, in_space)
    for tile in (in_space, shape, in_time):
        if tile is not None:
            trials.size(tile)
    cuts = [_Cuts(trials, shape, in_time, range(1)), _Cuts(trials, shape, in_space, range(1, 4))]

    def work(tile: Shape) -> float:
        return region_vertices(shape, tile)

    def foretold(tile: Shape) -> float:
        lowest = trials.sizes[shape] / min(trials.sizes.values())
        return lowest * prod(1 + cut.extra(tile) for cut in cuts)

    def burden_of(tile: Shape) -> float:
        return burden(access, trials.price(tile), work(tile))

    def best() -> Shape:
        return min((tile for tile in trials.sizes if trials.price(tile) <= allowed), key=burden_of)

    while len(trials.sizes) < TRIALS:
        least, limit = burden_of(best()), FASTER * work(best())
        likely = [
            (burden(access, foretold(tile), work(tile)), tile)
            for tile in candidates
            if tile not in trials.sizes and work(tile) < limit and foretold(tile) <= allowed
        ]
        told, tile = min(likely, default=(math.inf, shape))
        if told >= least:
            break
        expected = foretold(tile) - 1
        found = trials.price(tile) - 1
        if expected > 0:
            _blame(cuts, tile, min(max(found / expected, 0.5), 6.0))
    return best()


class _Cuts:
    """Price of cuts along some axes, by one trial with such cuts alone."""

    def __init__(self, trials: _Trials, shape: Shape, tried: Shape | None, axes: range) -> None:
        self._shape, self._axes, self.tried = shape, axes, tried
        self.share = 0.0
        """Extra bytes of the trial, as a share of those of one tile."""
        if tried is not None:
            # Smaller tiles cost more at last, also where these cost nothing.
            self.share = max(trials.size(tried) / trials.size(shape) - 1, MIN_EXTRA)

    def ratio(self, tile: Shape) -> float:
        """Return the cuts of a tile as a multiple of those of the trial."""
        if self.tried is None:
            return 0.0
        many, few = (
            sum(
                1 / one[axis] - 1 / self._shape[axis]
                for axis in self._axes
                if one[axis] < self._shape[axis]
            )
            for one in (tile, self.tried)
        )
        return many / few

    def extra(self, tile: Shape) -> float:
        """Return the extra bytes that a tile is likely to cost, as a share."""
        return self.share * math.pow(self.ratio(tile), STEEPNESS)


def _blame(cuts: list[_Cuts], tile: Shape, factor: float) -> None:
    """Correct what cuts cost by a trial: most where it went furthest beyond the trial before."""
    beyond = [abs(math.log(max(cut.ratio(tile), 1e-9))) if cut.extra(tile) else 0.0 for cut in cuts]
    for cut, far in zip(cuts, beyond, strict=True):
        cut.share *= factor ** (far / sum(beyond) if sum(beyond) else 1.0)


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
    return min(cut, key=lambda tile: abs(max(tile[1:]) - edge), default=None)


def largest_tile(shape: Shape) -> Shape:
    """Return the largest tile of a series that is too long for a single one."""
    candidates = [tile for tile in tiles_to_try(shape, MAX_VERTICES) if tile[0] >= min(8, shape[0])]
    return max(candidates or tiles_to_try(shape, MAX_VERTICES), key=prod)
