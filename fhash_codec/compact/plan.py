"""Plan of an encoding: every choice of the profile compact, made on a sample of the tiles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from math import prod
from typing import Any

from fhash_codec.compact.attempt import (
    Attempt,
    GainLog,
    HeadHistory,
    PlanTask,
    Tiling,
    first_tile,
    parse_tile,
)
from fhash_codec.compact.goal import Goal, integer_goal, with_step
from fhash_codec.compact.labels import (
    LOOK_VERTICES,
    LabelTrial,
    ends_trials,
    has_labels,
    holds_beside,
    look_at_labels,
    tiled_labels,
    with_step_of,
)
from fhash_codec.compact.planner import mean_center
from fhash_codec.compact.sample import Sample
from fhash_codec.compact.tiles import Blocks, Coding, Outcome
from fhash_codec.compact.transform import usual_transform
from fhash_codec.compact.trials import (
    SEARCHED,
    is_nearly_exact,
    of_filled_tiles,
    on_all_tiles,
    plan_by_prices,
    predicted_or_corrected,
    tiles_of,
    with_fill,
)
from fhash_codec.config import EncodeConfig
from fhash_codec.features.features import Feature
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.progress import Parts, Progress, stage
from fhash_formats.transform.spec import MaskLevels
from fhash_formats.transform.tile import OFFSETS
from fhash_formats.transform.tile_format import Shape, TileSettings

MAX_VALUE = 1e145
"""Largest magnitude of a value whose squared errors fit float64."""
MIN_RANGE = 1e-145
"""Smallest range of values, other than 0, whose squared errors fit float64."""
MAX_BYTES_KEPT = 128 << 20
"""Largest size of the box over all steps, in bytes, whose decoded values effort 1 keeps."""
LIKELY = 1.5
"""Ratio of labels to the rest up to which tiles are chosen for labels, which may then win."""
NEARLY = 0.5
"""Distance in dB that a sample may be below a promise that all tiles then keep."""
OVERHEAD_BYTES = 2000
"""Approximate bytes of a container without its tiles, for the sizes after each stage."""
STAGES = 7
"""Number of parts of the planning that its progress counts."""


@dataclass(frozen=True, kw_only=True)
class CodingPlan:
    """Tiles and settings for a whole series."""

    blocks: Blocks
    """The series in the chosen tiles."""
    settings: TileSettings
    """Settings of all tiles, for encoder and decoder."""
    coding: Coding
    """Options of the encoder."""
    goal: Goal
    """The promise."""
    sample: Sample | None = None
    """Tiles that the settings were chosen on; None if none were coded."""
    gains: list[dict[str, Any]] = field(default_factory=list)
    """Size of the file after each stage, see `GainLog`."""
    history: HeadHistory = field(default_factory=list)
    """Training of the head; empty without one."""
    tiling: Tiling | None = None
    """Choice of the tiles; None where they were asked for."""
    size: float | None = None
    """Bytes that the tiles are likely to take: infinite where the sample missed the promise, None
    where nothing was tried."""
    plain: CodingPlan | None = None
    """The plan without an MLP, where this one has one."""
    saved: float | None = None
    """Share of the bytes of the tiles that the MLP saves, about; None without one."""
    keeps_decoded: bool = False
    """Whether all tiles are kept as they decode, to be measured without being decoded again."""


def plan(
    blocks: Blocks,
    value_range: ValueRange,
    config: EncodeConfig,
    goal: Goal,
    workers: ThreadPoolExecutor,
    progress: Progress,
    features: Sequence[Feature],
) -> CodingPlan:
    """Choose tiles, fill values, transform, step, head and predictor, on a sample of the tiles.

    blocks: the series as one tile.
    features: what is selected.

    Raises InputError for a tile or a ratio that cannot be had.
    """
    gains = GainLog(OVERHEAD_BYTES)
    fixed_tile = parse_tile(config.tile, blocks.shape)
    tile = fixed_tile or first_tile(blocks.shape)
    if _squares_overflow(value_range, goal):
        return _exact_plan(blocks, tile, value_range, goal)
    task = PlanTask(
        blocks=blocks,
        value_range=value_range,
        features=features,
        config=config,
        goal=goal,
        fixed_tile=fixed_tile,
        workers=workers,
        gains=gains,
        parts=Parts("planning", STAGES, progress),
    )
    tiled = blocks.retile(tile)
    found = _planned(task, tiled)
    if not _may_be_exact(task, found):
        return found
    exact_task = replace(
        task,
        goal=replace(integer_goal(0, goal.data_range), overhead=goal.overhead),
        gains=GainLog(OVERHEAD_BYTES),
        parts=Parts("planning exact values", STAGES, progress),
    )
    exact = _planned(exact_task, tiled)
    assert exact.size is not None
    assert found.size is not None
    return exact if exact.size < found.size else found


def _may_be_exact(task: PlanTask, found: CodingPlan) -> bool:
    """Whether exact integers may take fewer bytes than a PSNR that leaves hardly any error."""
    return is_nearly_exact(task) and found.size is not None and not found.settings.labels


def first_settings(task: PlanTask, tiled: Blocks) -> TileSettings:
    """Return settings to begin with: the usual transform, a centre, a guessed step."""
    goal, value_range = task.goal, task.value_range
    sample = Sample(tiled, LOOK_VERTICES, task.workers, tick=task.parts.tick)
    if goal.psnr is not None:
        step = 4 * goal.expected_error
    elif goal.error is not None:
        step = 2.5 * goal.error
    else:
        step = goal.data_range * 0.05
    settings = TileSettings(
        transform=usual_transform(sample.blocks.tile),
        step=1.0,
        center=mean_center(sample, value_range),
        low=value_range.low,
        high=value_range.high,
        offsets=OFFSETS,
        double=True,
    )
    return with_step(settings, step, goal)


def _planned(task: PlanTask, tiled: Blocks) -> CodingPlan:
    """Return the plan for the goal of a task, of labels where these need fewer bytes."""
    parts = task.parts
    parts.begin("first guess")
    settings = first_settings(task, tiled)
    trial = None
    if task.goal.size is None:
        with stage("labels", "values of which few may differ"):
            trial = look_at_labels(task, tiled, settings) if has_labels(task, tiled) else None
    if trial is not None and trial.clearly:
        parts.end()
        return _label_plan(task, tiled_labels(task, trial))
    attempt = plan_by_prices(task, settings)
    found = None
    if trial is not None:
        found = _with_labels(task, trial, attempt)
    if found is None:
        attempt = predicted_or_corrected(task, attempt)
        found = _plan_of(task, attempt, labels=trial is not None and task.goal.lossless)
    parts.end()
    return found


def _with_labels(task: PlanTask, trial: LabelTrial, attempt: Attempt) -> CodingPlan | None:
    """Return the plan of labels where they take fewer bytes than an attempt; else None."""
    if not task.goal.lossless:
        trial = with_step_of(trial, attempt)
    size = trial.attempt.outcome.size
    if ends_trials(trial, attempt.outcome.size):
        return _label_plan(task, tiled_labels(task, trial))
    if size > LIKELY * attempt.outcome.size:
        return None
    attempt = on_all_tiles(task, attempt)  # what labels compete with is no estimate
    labelled = tiled_labels(task, trial)
    return _label_plan(task, labelled) if holds_beside(task, labelled, attempt) else None


def _plan_of(task: PlanTask, attempt: Attempt, *, labels: bool) -> CodingPlan:
    """Return the plan that an attempt has led to.

    Tiles that were all coded are not coded again; else they are kept as they decode. Fill values of
    integers are not used again: rounded ones would cost more than those they were rounded from.
    """
    blocks, coding = task.blocks.retile(attempt.sample.blocks.tile), attempt.coding
    coded = attempt.sample.complete and attempt.coded
    filled = attempt.sample.complete and attempt.sample.filling is not None
    if coding.density and not filled and prod(blocks.shape) <= SEARCHED:
        with stage("filling", "all tiles, once for all steps of the quantiser"):
            attempt = of_filled_tiles(task, replace(attempt, sample=tiles_of(task, attempt)))
            coding = attempt.coding
    filled = coding.density > 0 and attempt.sample.complete and blocks.dtype.kind == "f"
    small = prod(blocks.shape) * blocks.dtype.itemsize <= MAX_BYTES_KEPT
    # Bases are fitted to it again where a finer step needs more precise ones.
    own = coded or filled or blocks.in_memory
    return CodingPlan(
        blocks=blocks,
        sample=attempt.sample if own else None,
        settings=replace(attempt.settings, labels=True) if labels else attempt.settings,
        coding=task.goal.bounded(with_fill(coding) if filled else coding),
        goal=task.goal,
        gains=task.gains.entries,
        history=attempt.history,
        tiling=attempt.tiling,
        plain=None if attempt.plain is None else _plan_of(task, attempt.plain, labels=labels),
        saved=attempt.saved,
        size=attempt.outcome.size if _keeps_promise(task, attempt.outcome) else math.inf,
        keeps_decoded=small and not coded,
    )


def _keeps_promise(task: PlanTask, outcome: Outcome) -> bool:
    """Whether a sample keeps a promised PSNR, or nearly so; another promise is always kept."""
    goal = task.goal
    return goal.psnr is None or outcome.psnr(goal.data_range) > goal.psnr - NEARLY


def _label_plan(task: PlanTask, labelled: Attempt) -> CodingPlan:
    """Return the plan of a series that is coded as labels."""
    return CodingPlan(
        blocks=labelled.sample.blocks,
        settings=labelled.settings,
        coding=task.goal.bounded(labelled.coding),
        goal=task.goal,
        gains=task.gains.entries,
        tiling=labelled.tiling,
        size=labelled.outcome.size,
    )


def _squares_overflow(value_range: ValueRange, goal: Goal) -> bool:
    """Whether squared errors of the values do not fit float64."""
    largest = max(abs(value_range.low), abs(value_range.high))
    return largest > MAX_VALUE or 0 < goal.data_range < MIN_RANGE


def _exact_plan(blocks: Blocks, tile: Shape, value_range: ValueRange, goal: Goal) -> CodingPlan:
    """Return a plan of tiles without loss, for values whose squares overflow."""
    settings = TileSettings(
        transform=usual_transform(tile),
        step=1.0,
        center=0.0,
        low=value_range.low,
        high=value_range.high,
        offsets=OFFSETS,
        double=True,
    )
    settings = replace(settings, mask=MaskLevels()) if blocks.masked else settings
    return CodingPlan(
        blocks=blocks.retile(tile), settings=settings, coding=Coding(exact=True), goal=goal
    )
