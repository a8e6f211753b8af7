"""From a promise of quality to the settings of every tile, on a sample of them."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from math import prod
from typing import Any

import numpy as np

from fhash_codec.compact.choices import fillings as surroundings
from fhash_codec.compact.choices import head as heads
from fhash_codec.compact.choices import predictor as prediction
from fhash_codec.compact.choices.estimate import foreseen_size, foreseen_step, tile_costs
from fhash_codec.compact.choices.mask import mask_levels
from fhash_codec.compact.choices.step import solve, with_step
from fhash_codec.compact.choices.transform import choose_transform, refit, usual_transform
from fhash_codec.compact.goal import Goal
from fhash_codec.compact.tiles.blocks import Blocks
from fhash_codec.compact.tiles.coding import OFFSETS, Coding, Outcome
from fhash_codec.compact.tiles.sample import Sample
from fhash_codec.compact.tiles.tiling import even_tile, first_tile, parse_tile, tile_for
from fhash_codec.config import EncodeConfig
from fhash_codec.coreset.features import Feature
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.progress import Progress
from fhash_formats.transform.entropy.mask_levels import MaskLevels
from fhash_formats.transform.tile.sections import Shape
from fhash_formats.transform.tile.settings import TileSettings

MAX_VALUE, MIN_RANGE = 1e145, 1e-145
"""Squared errors of larger values or of a smaller range do not fit float64."""
LOOK_VERTICES, TRIAL_VERTICES, SAMPLE_VERTICES = 1 << 18, 3 << 20, 6 << 20
"""Of the tiles that are coded for an idea of the size, for each trial of a transform, and for the search of the step."""
ALL_VERTICES = 12 << 20
"""Of a series for which that search has all tiles."""
PRICE_OF_TILES = 1.3
"""By what factor small tiles may make a file larger."""
MAX_TILE_VERTICES, SMALL_FILE_BYTES = 12 << 20, 60_000
"""Of a tile chosen for its bytes alone; and only a file that is read in a moment as a whole may have such tiles."""
LONGEST_TILE, PRICE_OF_STEPS = 32, 0.97
"""Steps of a tile that is chosen to have all of them, and what part of the bytes is worth that a step alone takes longer to decode."""
REFITS = 3
"""Times that the data's own bases are made anew for another step."""


@dataclass(kw_only=True)
class Planned:
    """Settings and tiles for the whole series. gains: what each step of the way bought, history: of the training."""

    blocks: Blocks
    settings: TileSettings
    coding: Coding
    goal: Goal
    sample: Sample | None = None
    gains: list[dict[str, Any]] = field(default_factory=list)
    history: list[dict[str, float | None]] = field(default_factory=list)


def plan(
    blocks: Blocks,
    value_range: ValueRange,
    config: EncodeConfig,
    goal: Goal,
    overhead: int,
    workers: ThreadPoolExecutor,
    progress: Progress,
    features: Sequence[Feature],
) -> Planned:
    """Choose tiles, transform, step and head. `blocks` come as one tile; overhead: bytes of the file that are no tiles, roughly."""
    begun = time.perf_counter()
    fixed = parse_tile(config.tile, blocks.shape)
    first = fixed or first_tile(blocks.shape)
    if (
        max(abs(value_range.low), abs(value_range.high)) > MAX_VALUE
        or 0 < goal.data_range < MIN_RANGE
    ):
        return _exact(blocks, first, value_range, goal)
    gains: list[dict[str, Any]] = []

    def note(what: str, now: Outcome) -> None:
        gains.append(
            {
                "what": what,
                "bytes": round(now.size + overhead),
                "seconds": round(time.perf_counter() - begun, 3),
            }
        )

    def sampled(tiled: Blocks, settings: TileSettings, most: int) -> Sample:
        # What a tile costs does not depend much on the transform.
        usual = replace(settings, transform=usual_transform(tiled.tile))
        return Sample(tiled, most, workers, tile_costs(tiled, usual, workers)).filled(usual, 1)

    def masked(settings: TileSettings, error: float) -> TileSettings:
        return (
            settings
            if blocks.complete
            else replace(settings, mask=mask_levels(features, config.dilation, error, sample.tiles))
        )

    progress("planning", 0, 4, "")
    thorough = 8 if config.effort >= 4 else 4 if config.effort > 1 else 1
    coding = Coding(filled=blocks.complete, density=0)
    tiled = blocks.retile(first)
    settings = _first(Sample(tiled, LOOK_VERTICES, workers), value_range, goal)
    if (
        config.effort == 1
        and goal.psnr is not None
        and goal.data_range > 0
        and tiled.held
        and tiled.complete
        and not settings.double
    ):
        if fixed is None:
            tiled = blocks.retile(
                tile_for(
                    blocks.shape,
                    foreseen_size(
                        tiled, settings, psnr=goal.psnr, data_range=goal.data_range, workers=workers
                    ),
                )
            )
        settings = replace(settings, transform=usual_transform(tiled.tile))
        step = foreseen_step(
            tiled, settings, coding, psnr=goal.psnr, data_range=goal.data_range, workers=workers
        )
        progress("planning", 4, 4, "")
        return Planned(
            blocks=tiled, settings=with_step(settings, step, goal), coding=coding, goal=goal
        )
    sample = sampled(tiled, settings, LOOK_VERTICES)
    settings = masked(settings, goal.expected)
    settings, outcome = solve(sample, settings, coding, goal, tries=2)
    note("start", outcome)
    if fixed is None:
        tiled = blocks.retile(tile_for(blocks.shape, outcome.size))
    settings = replace(settings, transform=usual_transform(tiled.tile))
    progress("planning", 1, 4, "")
    sample = sampled(tiled, settings, TRIAL_VERTICES)
    if config.effort > 1:
        settings, outcome = _tried(sample, settings, coding, goal)
        if fixed is None:
            for tile in _other_tiles(tiled, outcome.size):
                other = sampled(
                    blocks.retile(tile),
                    settings,
                    MAX_TILE_VERTICES if tiled.complete else TRIAL_VERTICES,
                )
                changed, found = _tried(other, settings, coding, goal, quick=True)
                if found.size < outcome.size * (
                    1 / PRICE_OF_TILES if prod(tile[1:]) > prod(tiled.tile[1:]) else PRICE_OF_STEPS
                ):
                    sample, settings, outcome = other, changed, found
            if not tiled.complete and sample.blocks.tile != tiled.tile:
                settings, outcome = _tried(sample, settings, coding, goal)
        sample = sample.wider(
            ALL_VERTICES if prod(blocks.shape) <= ALL_VERTICES else SAMPLE_VERTICES
        )
    progress("planning", 2, 4, "")
    coding = replace(
        coding,
        passes=2 if config.effort > 2 else 1,
        rounds=0 if config.effort == 1 else 2 if config.effort < 7 else 4,
    )
    if not blocks.complete:
        coding = replace(coding, rounds=2, filled=True)
        sample = (
            surroundings.race(sample, settings, coding, goal, thorough)
            if config.effort > 1
            else sample.filled(settings, thorough)
        )
    outcomes: list[Outcome] = []
    settings, outcome = solve(
        sample, settings, coding, goal, tries=3 if config.effort == 1 else 5, tried=outcomes
    )
    if goal.psnr is None and outcome.count:
        settings = masked(settings, math.sqrt(outcome.squares / outcome.count))
    for _ in range(REFITS):
        # A basis is as precise as the step it was made for, and leaves out what is smaller: with a finer step comes another.
        refitted = refit(sample, settings)
        if refitted is settings:
            break
        before = settings.step
        settings, outcome = solve(sample, refitted, coding, goal, tried=outcomes)
        if abs(math.log(settings.step / before)) < 0.1:
            break
    if config.effort > 1:
        note("transform by trial", outcome)
    history: list[dict[str, float | None]] = []
    trainable = (
        goal.size is None and goal.error != 0 and goal.data_range > 0 and not settings.double
    )
    if config.effort >= 5 and trainable:
        settings, outcome, history = heads.race(
            sample,
            settings,
            outcome,
            coding,
            lambda now, tried: solve(sample, now, coding, goal, tries=4, tried=tried),
            outcomes,
            strict=goal.error is not None,
            data_range=goal.data_range,
            effort=config.effort,
            seed=config.seed,
            device=config.device,
        )
        note("head" if settings.head is not None else "head (left out)", outcome)
    if config.effort > 1 and goal.error and goal.data_range > 0:
        settings, size = prediction.race(
            sample, settings, outcome.size, error=goal.error, effort=config.effort
        )
        outcome = replace(outcome, size=size)
        note("prediction" if settings.predictor is not None else "prediction (left out)", outcome)
    progress("planning", 4, 4, "")
    if not blocks.complete and not (sample.complete and blocks.dtype.kind == "f"):
        # Whole numbers where nothing counts would cost more than what they were rounded from.
        coding = replace(coding, filled=False, density=thorough)
    return Planned(
        blocks=sample.blocks,
        sample=sample,
        settings=settings,
        coding=goal.bounded(coding),
        goal=goal,
        gains=gains,
        history=history,
    )


def _exact(blocks: Blocks, tile: Shape, value_range: ValueRange, goal: Goal) -> Planned:
    """Tiles without loss, for values whose squares overflow."""
    settings = TileSettings(
        transform=usual_transform(tile),
        step=1.0,
        center=0.0,
        low=value_range.low,
        high=value_range.high,
        offsets=OFFSETS,
        double=True,
    )
    settings = settings if blocks.complete else replace(settings, mask=MaskLevels())
    return Planned(
        blocks=blocks.retile(tile), settings=settings, coding=Coding(exact=True), goal=goal
    )


def _tried(
    sample: Sample, settings: TileSettings, coding: Coding, goal: Goal, *, quick: bool = False
) -> tuple[TileSettings, Outcome]:
    """The transform by trial, and what it gives where the promise is kept, so that tiles are compared at equal quality."""
    return solve(
        sample,
        choose_transform(sample, settings, goal.bounded(coding), quick=quick)[0],
        coding,
        goal,
        tries=3 if quick else 4,
    )


def _other_tiles(tiled: Blocks, size: int) -> list[Shape]:
    """Tiles to try beside the usual ones, which take so many bytes.

    Of a small file: all space in one, and everything in one. Random access pays for it, so the price of small tiles must be high, and
    large tiles not too large to decode. Of a series of which a part counts: as many tiles of all steps, since where little counts, what
    goes on in time fills the rest.
    """
    whole = tiled.shape
    found: list[Shape] = []
    if size <= SMALL_FILE_BYTES:
        steps = -(-whole[0] // -(-whole[0] // max(tiled.tile[0], 8)))
        found += [(steps, *whole[1:]), whole]
    if not tiled.complete and whole[0] <= LONGEST_TILE and tiled.grid[0] > 1:
        found.append(even_tile(whole, prod(tiled.grid), whole[0]))
    return [
        tile
        for tile in dict.fromkeys(found)
        if prod(tile) <= MAX_TILE_VERTICES and tile != tiled.tile
    ]


def _first(sample: Sample, value_range: ValueRange, goal: Goal) -> TileSettings:
    """Settings to begin with: a guess of the step."""
    if goal.psnr is not None:
        step = 4 * goal.expected
    elif goal.error is not None:
        step = 2.5 * goal.error
    else:
        step = goal.data_range * 0.05
    center = value_range.low + goal.data_range / 2
    with np.errstate(all="ignore"):
        means = [
            float(np.mean(values if care is None else values[care], dtype=np.float64))
            for values, care in sample.tiles
        ]
    mean = float(np.average(means, weights=sample.weights))
    center = mean if math.isfinite(mean) else center
    settings = TileSettings(
        transform=usual_transform(sample.blocks.tile),
        step=1.0,
        center=float(np.float32(center)) if abs(center) < 3e38 else center,
        low=value_range.low,
        high=value_range.high,
        offsets=OFFSETS,
        double=True,
    )
    return with_step(settings, step, goal)
