"""From a promise of quality to the settings of every tile, on a sample of them."""

from __future__ import annotations

import math
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from math import prod
from typing import Any

import numpy as np

from fhash_codec.compact import heads
from fhash_codec.compact.blocks import Blocks, even_tile, parse_tile
from fhash_codec.compact.choice import choose_transform, refit, usual_transform
from fhash_codec.compact.sample import OFFSETS, SLOPE, SMALLEST_STEP, Outcome, Sample, Way, solve_step
from fhash_codec.config import EncodeConfig
from fhash_codec.normalise import ValueRange
from fhash_codec.progress import Progress
from fhash_formats.errors import InputError
from fhash_formats.transform.settings import Settings
from fhash_formats.transform.tile import Shape

DEFAULT_PSNR = 50.0
LARGEST_VALUE, SMALLEST_RANGE = 1e145, 1e-145
"""Squared errors of larger values or of a smaller range do not fit float64."""
SAMPLE_VERTICES = 2 << 20
QUICK_VERTICES = 1 << 20
TILE_BYTES, TILE_VERTICES, FEWEST_TILES = 1500, 1 << 19, 27
"""A tile should take at least so many bytes, and hold at most so many vertices once there are enough tiles for random access."""
TILE_STEPS = 4
PRICE_OF_TILES = 1.3
"""By what factor small tiles may make a file larger."""
MOST_TILE_VERTICES, SMALL_FILE_BYTES = 12 << 20, 60_000
"""Of a tile chosen for its bytes alone; and only a file that is read in a moment as a whole may have such tiles."""
STEPS_OF_ERROR = (1.0, 1.6, 2.5, 4.0)
"""Quantiser steps, in units of a strict bound, that are tried."""
SLACK = 1e-6
"""The quantum of the residual is this part less than twice the bound, for the rounding of what is decoded."""
DOUBLE_STEPS = 2.0**20
"""Steps in the range from which on float32 is not precise enough."""


@dataclass(frozen=True, kw_only=True)
class Goal:
    """What was promised: exactly one of a PSNR in dB, a bound in data units, and a number of bytes."""

    psnr: float | None = None
    error: float | None = None
    size: float | None = None


@dataclass(kw_only=True)
class Planned:
    """Settings and tiles for the whole series. gains: what each step of the way bought, history: of the training."""

    blocks: Blocks
    settings: Settings
    way: Way
    goal: Goal
    sample: Sample | None = None
    gains: list[dict[str, Any]] = field(default_factory=list)
    history: list[dict[str, float | None]] = field(default_factory=list)


def goal_of(config: EncodeConfig, value_range: ValueRange, raw_bytes: int) -> Goal:
    """The one promise of the settings (that there is no other, `EncodeConfig` has seen to)."""
    if config.max_error is not None:
        return Goal(error=config.max_error)
    if config.max_error_rel is not None:
        return Goal(error=config.max_error_rel * (value_range.high - value_range.low))
    if config.ratio is not None:
        return Goal(size=raw_bytes / config.ratio)
    return Goal(psnr=DEFAULT_PSNR if config.psnr is None else config.psnr)


def plan(
    blocks: Blocks,
    value_range: ValueRange,
    config: EncodeConfig,
    goal: Goal,
    overhead: int,
    workers: ThreadPoolExecutor,
    progress: Progress,
) -> Planned:
    """Choose tiles, transform, step and head. `blocks` come as one tile; overhead: bytes of the file that are no tiles, roughly."""
    begun = time.perf_counter()
    data_range = value_range.high - value_range.low
    fixed = parse_tile(config.tile, blocks.shape)
    tile = fixed or even_tile(blocks.shape, max(1, prod(blocks.shape) // TILE_VERTICES), min(blocks.shape[0], 8))
    if max(abs(value_range.low), abs(value_range.high)) > LARGEST_VALUE or 0 < data_range < SMALLEST_RANGE:
        return _exact(blocks, tile, value_range, goal)
    way = Way(filled=blocks.complete)
    # Only a first idea of the size is needed, for the tiles.
    sample = Sample(blocks.retile(tile), QUICK_VERTICES // 4, workers)
    settings = _first(sample, value_range, goal)
    progress("planning", 0, 4, "")
    settings, outcome = _solve(sample, settings, way, goal, data_range, overhead, tries=2)
    gains: list[dict[str, Any]] = []

    def note(what: str, now: Outcome, of: Sample) -> None:
        gains.append({"what": what, "bytes": round(now.size * of.share + overhead), "seconds": round(time.perf_counter() - begun, 3)})

    note("start", outcome, sample)
    if fixed is None:
        tile = _tile(blocks, outcome.size * sample.share)
    tiled = blocks.retile(tile)
    most = SAMPLE_VERTICES if config.effort > 1 else QUICK_VERTICES
    if tiled.tile != sample.tiles[0][0].shape or config.effort > 1:
        sample = Sample(tiled, most, workers)
        settings = replace(settings, transform=usual_transform(tiled.tile))
    progress("planning", 1, 4, "")
    if config.effort > 1:
        settings, cost = choose_transform(sample, settings, _bounded(way, goal))
        if fixed is None:
            tiled, sample, settings = _larger_tiles(tiled, sample, settings, cost, _bounded(way, goal), workers)
    progress("planning", 2, 4, "")
    way = replace(way, passes=2 if config.effort > 2 else 1, rounds=0 if config.effort == 1 else 2 if config.effort < 7 else 4)
    if not tiled.complete:
        way = replace(way, rounds=2 if config.effort == 1 else 6)
    settings, outcome = _solve(sample, settings, way, goal, data_range, overhead, tries=3 if config.effort == 1 else 5)
    for _ in range(3):
        # A basis is as precise as the step it was made for, and leaves out what is smaller: with a finer step comes another.
        refitted = refit(sample, settings)
        if refitted is settings:
            break
        before = settings.step
        settings, outcome = _solve(sample, refitted, way, goal, data_range, overhead)
        if abs(math.log(settings.step / before)) < 0.1:
            break
    if config.effort > 1:
        note("transform by trial", outcome, sample)
    history: list[dict[str, float | None]] = []
    if config.effort >= 5 and goal.psnr is not None and not settings.double:
        settings, outcome, history = heads.race(
            sample,
            settings,
            outcome,
            way,
            psnr=goal.psnr,
            data_range=data_range,
            effort=config.effort,
            seed=config.seed,
            device=config.device,
        )
        note("head" if settings.head is not None else "head (left out)", outcome, sample)
    progress("planning", 4, 4, "")
    return Planned(blocks=tiled, sample=sample, settings=settings, way=_bounded(way, goal), goal=goal, gains=gains, history=history)


def _exact(blocks: Blocks, tile: Shape, value_range: ValueRange, goal: Goal) -> Planned:
    """Tiles without loss, for values whose squares overflow."""
    settings = Settings(
        transform=usual_transform(tile), step=1.0, center=0.0, low=value_range.low, high=value_range.high, offsets=OFFSETS, double=True
    )
    return Planned(blocks=blocks.retile(tile), settings=settings, way=Way(exact=True), goal=goal)


def _bounded(way: Way, goal: Goal) -> Way:
    return way if goal.error is None else replace(way, error=goal.error)


def _larger_tiles(
    tiled: Blocks, sample: Sample, settings: Settings, cost: float, way: Way, workers: ThreadPoolExecutor
) -> tuple[Blocks, Sample, Settings]:
    """Tiles of all space, or one tile for everything, where small ones cost too much; else as they were.

    Random access pays for it, so the price of small tiles must be high, and large tiles not too large to decode.
    """
    whole = tiled.shape
    steps = -(-whole[0] // -(-whole[0] // max(tiled.tile[0], 8)))
    best = cost * sample.share / PRICE_OF_TILES
    if cost * sample.share > SMALL_FILE_BYTES:
        return tiled, sample, settings
    for tile in ((steps, *whole[1:]), whole):
        if prod(tile) > MOST_TILE_VERTICES or tile == tiled.tile:
            continue
        other = tiled.retile(tile)
        larger = Sample(other, MOST_TILE_VERTICES, workers)
        changed, price = choose_transform(larger, settings, way, quick=True)
        if price * larger.share < best:
            best, tiled, sample, settings = price * larger.share, other, larger, changed
    return tiled, sample, settings


def _tile(blocks: Blocks, size: float) -> Shape:
    """Tiles that take some bytes each; more of them than FEWEST_TILES only where they get too large."""
    vertices = prod(blocks.shape)
    tiles = int(min(size / TILE_BYTES, max(FEWEST_TILES, vertices / TILE_VERTICES)))
    steps = blocks.shape[0]
    if tiles > 1:
        parts = -(-steps // TILE_STEPS) if tiles >= 16 else 1
        steps = -(-steps // min(parts, max(1, tiles // 8)))
    return even_tile(blocks.shape, max(1, tiles), steps)


def _first(sample: Sample, value_range: ValueRange, goal: Goal) -> Settings:
    """Settings to begin with: a guess of the step."""
    data_range = value_range.high - value_range.low
    if goal.psnr is not None:
        step = 4 * data_range * 10 ** (-goal.psnr / 20)
    elif goal.error is not None:
        step = 2.5 * goal.error
    else:
        step = data_range * 0.05
    center = value_range.low + data_range / 2
    values, care = sample.tiles[0]
    counted = values if care is None else values[care]
    if counted.size:
        with np.errstate(all="ignore"):
            mean = float(np.mean(counted, dtype=np.float64))
        center = mean if math.isfinite(mean) else center
    return _with_step(
        Settings(
            transform=usual_transform(values.shape),
            step=1.0,
            center=float(np.float32(center)) if abs(center) < 3e38 else center,
            low=value_range.low,
            high=value_range.high,
            offsets=OFFSETS,
            double=True,
        ),
        step,
        goal,
    )


def _with_step(settings: Settings, step: float, goal: Goal) -> Settings:
    """The step, and the working type and residual that go with it."""
    data_range = settings.high - settings.low
    largest = max(abs(settings.low), abs(settings.high))
    # Integers beyond 2^30 cannot be coded. In a constant series the step only has to be small enough for the centre, a float32.
    step = max(step, data_range * SMALLEST_STEP, largest * 2.0**-30 if data_range == 0 else 0.0, 1e-300)
    double = data_range / step > DOUBLE_STEPS or largest > step * DOUBLE_STEPS or largest > 1e37 or step < 1e-30
    quantum = 0.0 if not goal.error else 2 * goal.error * (1 - SLACK)
    return replace(settings, step=step, double=double, quantum=quantum)


def _solve(
    sample: Sample, settings: Settings, way: Way, goal: Goal, data_range: float, overhead: int, *, tries: int = 5
) -> tuple[Settings, Outcome]:
    """The step that keeps the promise on the sample, or for a bound the one that costs least."""
    if goal.psnr is not None:
        if data_range == 0:
            return settings, sample.run(settings, way)
        return solve_step(sample, settings, way, goal.psnr, data_range, tries=tries)
    if goal.error is not None:
        if goal.error == 0:
            return settings, sample.run(settings, replace(way, error=0.0))
        found = []
        for steps in STEPS_OF_ERROR:
            trial = _with_step(settings, steps * goal.error, goal)
            found.append((sample.run(trial, replace(way, error=goal.error)), trial))
        outcome, settings = min(found, key=lambda pair: pair[0].size)
        return settings, outcome
    assert goal.size is not None
    return _solve_size(sample, settings, way, goal.size - overhead, data_range, tries)


def _solve_size(sample: Sample, settings: Settings, way: Way, size: float, data_range: float, tries: int) -> tuple[Settings, Outcome]:
    """The step at which the sample, for its share, takes so many bytes."""
    if size <= 0:
        raise InputError("the ratio leaves no room for values: the rest of the file is larger already; ask for a smaller ratio")
    low, high = math.log(max(data_range, 1e-300) * 2.0**-24), math.log(max(data_range, 1e-300) * 4)
    log_step = math.log(settings.step)
    for _ in range(2 * tries + 2):
        log_step = min(max(log_step, low), high)
        settings = replace(settings, step=math.exp(log_step))
        outcome = sample.run(settings, way)
        got = outcome.size * sample.share
        if abs(got - size) < 0.005 * size:
            break
        low, high = (log_step, high) if got > size else (low, log_step)
        # Bytes fall roughly as 2^(-PSNR / 4.5).
        log_step += math.log2(got / size) * 4.5 / SLOPE
        if not low < log_step < high:
            log_step = (low + high) / 2
    return settings, outcome
