"""Stages of planning: each takes the best attempt so far and returns a better one.

Another order of the trials would give other bytes in the file.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from math import prod

import numpy as np

from fhash_codec.compact.attempt import Attempt, PlanTask
from fhash_codec.compact.choices.estimate import tile_costs
from fhash_codec.compact.choices.fillings import choose_filling
from fhash_codec.compact.choices.head import choose_head
from fhash_codec.compact.choices.mask import mask_levels
from fhash_codec.compact.choices.predictor import choose_predictor
from fhash_codec.compact.choices.quantiser import (
    allows_trellis,
    is_smaller,
    off_trellis,
    on_trellis,
    step_after,
)
from fhash_codec.compact.choices.step import find_step, require_reach, with_step
from fhash_codec.compact.choices.transform import choose_transform, refit, usual_transform
from fhash_codec.compact.tiles.blocks import Blocks
from fhash_codec.compact.tiles.coding import OFFSETS, Coding, Outcome
from fhash_codec.compact.tiles.sample import Sample
from fhash_codec.compact.tiles.tiling import even_tile, tile_for
from fhash_codec.stage_clock import skip, stage
from fhash_formats.transform.tile.sections import Shape
from fhash_formats.transform.tile.settings import TileSettings

__all__ = [
    "choose_step",
    "choose_tiles",
    "fill_tiles",
    "first_guess",
    "first_settings",
    "other_tiles",
    "try_head",
    "try_predictor",
]

LOOK_VERTICES = 1 << 18
"""Vertices coded for the first size estimate."""
TRIAL_VERTICES = 3 << 20
"""Vertices coded for each trial of a transform."""
SAMPLE_VERTICES = 6 << 20
"""Vertices coded for each trial of a step."""
MAX_SEARCHED_VERTICES = 12 << 20
"""Vertices up to which a series is searched whole instead of on a sample."""
PRICE_OF_TILES = 1.3
"""Factor by which smaller tiles may make a file larger: random access is worth it."""
MAX_TILE_VERTICES = 12 << 20
"""Vertices of a tile that is chosen for its bytes alone: a larger one takes long to decode."""
SMALL_FILE_BYTES = 60_000
"""Bytes up to which a file is read in a moment as a whole, so that its tiles may be large."""
MAX_TILE_STEPS = 32
"""Longest tile in time steps that may span the whole series for its bytes alone."""
PRICE_OF_STEPS = 0.97
"""Size ratio below which slower access to a single step is accepted."""
MIN_HEAD_EFFORT = 5
"""Least effort that trains a head."""
SAMPLE_WHY = "tiles on which the choices are tried"
"""Reason for the stage that reads and fills a sample."""
HEAD_TRIES = 3
"""Trials of the step with a head: the search begins within some hundredths of a dB of its end."""
REFITS = 3
"""Times that the data's own bases are made anew for another step."""
SAME_STEP = 0.1
"""Difference of log steps below which bases are not made anew."""


def first_settings(task: PlanTask, tiled: Blocks) -> TileSettings:
    """Return settings to begin with: the usual transform, the mean as centre, a guessed step."""
    sample = Sample(tiled, LOOK_VERTICES, task.workers, tick=task.parts.tick)
    goal, value_range = task.goal, task.value_range
    if goal.psnr is not None:
        step = 4 * goal.expected_error
    elif goal.error is not None:
        step = 2.5 * goal.error
    else:
        step = goal.data_range * 0.05
    center = value_range.low + goal.data_range / 2
    with np.errstate(all="ignore"):
        means = [
            float(np.mean(values if counted is None else values[counted], dtype=np.float64))
            for values, counted in sample.tiles
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
        coder="signs",
    )
    return with_step(settings, step, goal)


def first_guess(task: PlanTask, tiled: Blocks, settings: TileSettings) -> Attempt:
    """Code a few tiles for a first idea of the size."""
    coding = Coding(filled=task.blocks.complete, density=0, bulk=task.goal.bulk)
    sample = _sample(task, tiled, settings, LOOK_VERTICES)
    settings = _with_mask(task, sample, settings, task.goal.expected_error)
    settings, outcome = find_step(sample, settings, coding, task.goal, tries=2)
    require_reach(task.goal, settings, outcome)
    task.gains.note("start", outcome)
    return Attempt(sample=sample, settings=settings, outcome=outcome, coding=coding)


def choose_tiles(task: PlanTask, attempt: Attempt) -> Attempt:
    """Choose the tiles, by the size of the first guess and by trial, and the transform."""
    tiled = attempt.sample.blocks
    if task.fixed_tile is None:
        tiled = task.blocks.retile(tile_for(task.blocks.shape, attempt.outcome.size))
    settings = replace(attempt.settings, transform=usual_transform(tiled.tile))
    with stage("sample", SAMPLE_WHY):
        sample = _sample(task, tiled, settings, TRIAL_VERTICES)
    attempt = replace(attempt, sample=sample, settings=settings)
    if task.config.effort == 1:
        for name in ("transform", "tiles"):
            skip(name, "effort 1 tries none; from 2 on")
        return attempt
    if _asked(task, "transform"):
        with stage("transform", f"trials along each axis, at effort {task.config.effort}"):
            attempt = _choose_transform(task, attempt)
    else:
        with stage("step", "size of the tiles where the promise is kept"):
            attempt = _choose_transform(task, attempt)
    if task.fixed_tile is not None:
        skip("tiles", f"--tile {task.config.tile}")
    elif _asked(task, "tiles"):
        attempt = _tryother_tiles(task, attempt)
    vertices = prod(task.blocks.shape)
    searched = MAX_SEARCHED_VERTICES if vertices <= MAX_SEARCHED_VERTICES else SAMPLE_VERTICES
    with stage("sample", SAMPLE_WHY):
        return replace(attempt, sample=attempt.sample.wider(searched))


def fill_tiles(task: PlanTask, attempt: Attempt) -> Attempt:
    """Set the options of the encoder, and fill the vertices that do not count."""
    effort = task.config.effort
    coding = replace(
        attempt.coding,
        passes=2 if effort > 2 else 1,
        rounds=0 if effort == 1 else 2 if effort < 7 else 4,
    )
    sample, settings = attempt.sample, attempt.settings
    if task.blocks.complete:
        skip("filling", "every vertex of the box counts")
        return replace(attempt, coding=coding)
    coding = replace(coding, rounds=2, filled=True)
    if effort > 1 and _asked(task, "filling"):
        with stage("filling", "trials of values where none count"):
            sample = choose_filling(sample, settings, coding, task.goal, task.density)
    else:
        with stage("sample", SAMPLE_WHY):
            sample = sample.filled(settings, task.density)
    return replace(attempt, sample=sample, coding=coding)


def choose_step(task: PlanTask, attempt: Attempt) -> Attempt:
    """Choose quantiser and step that keep the promise, and fit the data's own bases to the step."""
    with stage("step", "largest step of the quantiser at which a sample keeps the promise"):
        if not allows_trellis(attempt.settings, task.goal, task.config.effort):
            return _searched_step(task, attempt)
        return _searched_step(task, _choose_quantiser(task, attempt))


def _choose_quantiser(task: PlanTask, attempt: Attempt) -> Attempt:
    """Return the attempt with the trellis if that makes the sample smaller, and a better step.

    The trial of the plain quantiser tells where the search for the step begins.
    """
    sample, goal = attempt.sample, task.goal
    plain = sample.run(attempt.settings, goal.bounded(attempt.coding))
    attempt = replace(
        attempt,
        settings=replace(attempt.settings, step=step_after(attempt.settings, plain, goal)),
        outcome=plain,
    )
    settings, coding = on_trellis(attempt.settings, attempt.coding)
    tried: list[Outcome] = []
    outcome = sample.run(settings, goal.bounded(coding))
    tried.append(outcome)
    if goal.psnr is not None:
        settings = replace(settings, step=step_after(settings, outcome, goal))
        outcome = sample.run(settings, coding)
        tried.append(outcome)
    if not is_smaller(outcome, plain, tried, goal):
        return attempt
    return replace(attempt, settings=settings, coding=coding, outcome=outcome)


def _searched_step(task: PlanTask, attempt: Attempt) -> Attempt:
    """Return the attempt with the step that the sample asks for, and with bases fitted to it."""
    sample, coding, goal = attempt.sample, attempt.coding, task.goal
    tries = 3 if task.config.effort == 1 else 5
    tried: list[Outcome] = []
    settings, outcome = find_step(sample, attempt.settings, coding, goal, tries=tries, tried=tried)
    if goal.psnr is None and outcome.count:
        error = math.sqrt(outcome.squares / outcome.count)
        settings = _with_mask(task, sample, settings, error)
    for _ in range(REFITS):
        # A basis is as precise as the step that it was made for needs: a finer step needs another.
        refitted = refit(sample, settings)
        if refitted is settings:
            break
        step_before = settings.step
        settings, outcome = find_step(sample, refitted, coding, goal, tried=tried)
        if abs(math.log(settings.step / step_before)) < SAME_STEP:
            break
    if task.config.effort > 1:
        task.gains.note("transform by trial", outcome)
    return replace(attempt, settings=settings, outcome=outcome, tried=tried)


def try_head(task: PlanTask, attempt: Attempt) -> Attempt:
    """Train a head, and keep it if the file gets smaller by it."""
    config, goal = task.config, task.goal
    if not _asked(task, "head"):
        return attempt
    if reason := _without_head(task, attempt):
        skip("head", reason)
        return attempt

    def find(settings: TileSettings) -> tuple[TileSettings, Outcome]:
        return find_step(attempt.sample, settings, attempt.coding, goal, tries=HEAD_TRIES)

    def look(settings: TileSettings) -> Outcome:
        return attempt.sample.run(settings, goal.bounded(attempt.coding))

    settings, outcome, history = choose_head(
        attempt.sample,
        attempt.settings,
        attempt.outcome,
        attempt.coding,
        find,
        look,
        attempt.tried,
        strict=goal.error is not None,
        data_range=goal.data_range,
        effort=config.effort,
        seed=config.seed,
        parts=task.parts,
    )
    task.gains.note("head" if settings.head is not None else "head (left out)", outcome)
    return replace(attempt, settings=settings, outcome=outcome, history=history)


def _without_head(task: PlanTask, attempt: Attempt) -> str:
    """Return why no head is to be trained; "" where one is."""
    goal, effort = task.goal, task.config.effort
    if effort < MIN_HEAD_EFFORT:
        return f"effort {effort} trains none; from {MIN_HEAD_EFFORT} on"
    if goal.size is not None:
        return "a promised ratio: the step changes once the whole file is known"
    if goal.error == 0 or goal.data_range <= 0:
        return "exact values leave nothing to correct"
    if attempt.settings.double:
        return "the step is too fine for float32, in which heads compute"
    return ""


def try_predictor(task: PlanTask, attempt: Attempt) -> Attempt:
    """Train a predictor for a strict bound, and keep it if the file gets smaller by it."""
    goal, effort = task.goal, task.config.effort
    if not goal.error or goal.data_range <= 0:
        skip("predictor", "only a bound on each error has use for it")
        return attempt
    if effort == 1 or not _asked(task, "predictor"):
        return attempt
    with stage("predictor", "trials beside the transform, for the bound on each error"):
        settings, size = choose_predictor(
            attempt.sample, attempt.settings, attempt.outcome.size, error=goal.error, effort=effort
        )
    outcome = replace(attempt.outcome, size=size)
    kept = settings.predictor is not None
    if kept and settings.trellis:
        settings, _ = off_trellis(settings, attempt.coding)  # no tile has coefficients now
    task.gains.note("prediction" if kept else "prediction (left out)", outcome)
    return replace(attempt, settings=settings, outcome=outcome)


def _asked(task: PlanTask, name: str) -> bool:
    """Whether the settings leave a stage in; one that they leave out is recorded."""
    if name not in task.config.without:
        return True
    skip(name, f"--without {name}")
    return False


def _sample(task: PlanTask, tiled: Blocks, settings: TileSettings, max_vertices: int) -> Sample:
    """Return a sample of tiles by their costs, filled for the usual transform.

    The cost of a tile does not depend much on the transform.
    """
    usual = replace(settings, transform=usual_transform(tiled.tile))
    costs = tile_costs(tiled, usual, task.workers)
    return Sample(tiled, max_vertices, task.workers, costs, task.parts.tick).filled(usual, 1)


def _with_mask(
    task: PlanTask, sample: Sample, settings: TileSettings, error: float
) -> TileSettings:
    """Return settings with scores for the mask of the vertices that count, if there is one.

    error: root of the mean squared error of the decoded values, in data units.
    """
    if task.blocks.complete:
        return settings
    levels = mask_levels(task.features, task.config.dilation, error, sample.tiles)
    return replace(settings, mask=levels)


def _choose_transform(task: PlanTask, attempt: Attempt, *, quick: bool = False) -> Attempt:
    """Choose the transform by trial, and the step that keeps the promise with it.

    Attempts with other tiles are compared at this step: at equal quality.
    """
    sample, coding, goal = attempt.sample, attempt.coding, task.goal
    if "transform" in task.config.without:
        usual = usual_transform(sample.blocks.tile)
        settings = replace(attempt.settings, transform=usual)
    else:
        settings, _ = choose_transform(sample, attempt.settings, goal.bounded(coding), quick=quick)
    settings, outcome = find_step(sample, settings, coding, goal, tries=3 if quick else 4)
    return replace(attempt, settings=settings, outcome=outcome)


def _tryother_tiles(task: PlanTask, attempt: Attempt) -> Attempt:
    """Try larger and longer tiles, and keep them if the file gets much smaller by them."""
    tiled = attempt.sample.blocks
    others = other_tiles(tiled.shape, tiled.tile, attempt.outcome.size, complete=tiled.complete)
    if not others:
        skip("tiles", "no other tile is worth the slower access to a region")
        return attempt
    with stage("tiles", "trials of larger and longer tiles, for a small file or a sparse coreset"):
        return _best_tiles(task, attempt, others)


def _best_tiles(task: PlanTask, attempt: Attempt, others: Sequence[Shape]) -> Attempt:
    """Return the best of the attempt and those with other tiles, larger ones at a price."""
    tiled = attempt.sample.blocks
    max_vertices = MAX_TILE_VERTICES if tiled.complete else TRIAL_VERTICES
    for tile in others:
        settings = attempt.settings
        sample = _sample(task, task.blocks.retile(tile), settings, max_vertices)
        other = _choose_transform(task, replace(attempt, sample=sample), quick=True)
        larger_in_space = prod(tile[1:]) > prod(tiled.tile[1:])
        max_ratio = 1 / PRICE_OF_TILES if larger_in_space else PRICE_OF_STEPS
        if other.outcome.size < attempt.outcome.size * max_ratio:
            attempt = other
    if not tiled.complete and attempt.sample.blocks.tile != tiled.tile:
        attempt = _choose_transform(task, attempt)
    return attempt


def other_tiles(shape: Shape, tile: Shape, size: float, *, complete: bool) -> list[Shape]:
    """Return tiles to try beside the usual one.

    shape: of the box over all steps.
    tile: the usual one.
    size: bytes of the tiles.
    complete: whether all vertices of the box count.

    For a small file: all space in one tile, and the whole series in one tile. They make random
    access slower, so they must save much, and they must not be too large to decode.

    For a series that is partly outside the coreset: as many tiles, each of all steps. Where few
    vertices count, those of other steps help to fill the rest.
    """
    tiles: list[Shape] = []
    if size <= SMALL_FILE_BYTES:
        steps = -(-shape[0] // -(-shape[0] // max(tile[0], 8)))
        tiles += [(steps, *shape[1:]), shape]
    if not complete and shape[0] <= MAX_TILE_STEPS and tile[0] < shape[0]:
        count = prod(-(-n // length) for n, length in zip(shape, tile, strict=True))
        tiles.append(even_tile(shape, count, shape[0]))
    return [
        other
        for other in dict.fromkeys(tiles)
        if prod(other) <= MAX_TILE_VERTICES and other != tile
    ]
