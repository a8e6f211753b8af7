"""Plan of a compact file: from a promise of quality to tiles and their settings."""

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
    cheap_tiling,
    first_tile,
    parse_tile,
)
from fhash_codec.compact.goal import Goal, integer_goal
from fhash_codec.compact.labels import (
    LabelTrial,
    ends_trials,
    has_labels,
    holds_beside,
    look_at_labels,
    tiled_labels,
    with_step_of,
)
from fhash_codec.compact.sample import Sample
from fhash_codec.compact.stages import (
    choose_step,
    choose_tiles,
    fill_tiles,
    first_guess,
    first_settings,
    refit_bases,
    try_head,
    try_predictor,
)
from fhash_codec.compact.step import with_step
from fhash_codec.compact.tiles import Blocks, Coding, Outcome
from fhash_codec.compact.transform import estimated_size, estimated_step, usual_transform
from fhash_codec.config import EncodeConfig
from fhash_codec.features.features import Feature
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.progress import Parts, Progress, stage
from fhash_formats.transform.coder import MaskLevels
from fhash_formats.transform.encoding import OFFSETS
from fhash_formats.transform.tile_format import Shape, TileSettings

__all__ = ["CodingPlan", "plan"]

MAX_VALUE = 1e145
"""Largest magnitude of a value whose squared errors fit float64."""
MIN_RANGE = 1e-145
"""Smallest range of values, other than 0, whose squared errors fit float64."""
MAX_BYTES_KEPT = 128 << 20
"""Largest size of the box over all steps, in bytes, whose decoded values effort 1 keeps."""
LIKELY = 1.5
"""Ratio of labels to the rest up to which tiles are chosen for labels, which may then win."""
ROUNDING_ERROR = 12**-0.5
"""Root of the mean squared error of rounding to integers, in data units."""
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
        goal=integer_goal(0, goal.data_range),
        gains=GainLog(OVERHEAD_BYTES),
        parts=Parts("planning exact values", STAGES, progress),
    )
    exact = _planned(exact_task, tiled)
    assert exact.size is not None
    assert found.size is not None
    return exact if exact.size < found.size else found


def _may_be_exact(task: PlanTask, found: CodingPlan) -> bool:
    """Whether exact integers may take fewer bytes than a PSNR that leaves hardly any error.

    Decoded values are rounded to integers. Below the error of that rounding, hardly any step of the
    quantiser gives the PSNR: a little finer, and all values are exact.
    """
    return (
        task.goal.psnr is not None
        and task.blocks.dtype.kind in "iu"
        and found.size is not None
        and not found.settings.labels
        and task.goal.expected_error < ROUNDING_ERROR
    )


def _planned(task: PlanTask, tiled: Blocks) -> CodingPlan:
    """Return the plan for the goal of a task, from the tiles of a first guess on."""
    parts = task.parts
    parts.begin("first guess")
    with stage("first guess", "mean and approximate bytes, by which tiles are chosen"):
        settings = first_settings(task, tiled)
    trial = _label_trial(task, tiled, settings)
    if trial is not None and trial.clearly:
        parts.end()
        return _label_plan(task, tiled_labels(task, trial))
    if _can_estimate(task, tiled, settings) and not _beats_estimate(trial, task, tiled, settings):
        with stage("estimate", "effort 1: step and tiles from coefficients, without trials"):
            estimated_plan = _estimated_plan(task, tiled, settings)
        parts.end()
        return estimated_plan
    found = _by_trial(task, tiled, settings, trial)
    parts.end()
    return found


def _label_trial(task: PlanTask, tiled: Blocks, settings: TileSettings) -> LabelTrial | None:
    """Return the trial of coding as labels; None where values are no labels, and for a ratio."""
    if task.goal.size is not None:
        return None
    with stage("labels", "values of which few may differ"):
        return look_at_labels(task, tiled, settings) if has_labels(task, tiled) else None


def _beats_estimate(
    trial: LabelTrial | None, task: PlanTask, tiled: Blocks, settings: TileSettings
) -> bool:
    """Whether labels take fewer bytes than effort 1 estimates for a transform."""
    if trial is None:
        return False
    return trial.attempt.outcome.size < _estimated_bytes(task, tiled, settings)


def _by_trial(
    task: PlanTask, tiled: Blocks, settings: TileSettings, trial: LabelTrial | None
) -> CodingPlan:
    """Return the plan after trials of all choices, or of labels where these need fewer bytes."""
    with stage("first guess", "approximate bytes, by which tiles are chosen"):
        attempt = first_guess(task, tiled, settings)
    if trial is not None and not task.goal.lossless:
        trial = with_step_of(trial, attempt)
    if trial is not None and ends_trials(trial, attempt.outcome.size):
        return _label_plan(task, tiled_labels(task, trial))
    attempt = _improved(task, attempt)
    settings = attempt.settings
    if trial is not None and trial.attempt.outcome.size <= LIKELY * attempt.outcome.size:
        labelled = tiled_labels(task, trial)
        if holds_beside(task, labelled, attempt):
            return _label_plan(task, labelled)
    if trial is not None and task.goal.lossless:
        settings = replace(settings, labels=True)
    return CodingPlan(
        blocks=attempt.sample.blocks,
        sample=attempt.sample,
        settings=settings,
        coding=task.goal.bounded(_final_coding(task, attempt)),
        goal=task.goal,
        gains=task.gains.entries,
        history=attempt.history,
        tiling=attempt.tiling,
        size=attempt.outcome.size if _keeps_promise(task, attempt.outcome) else math.inf,
    )


def _improved(task: PlanTask, attempt: Attempt) -> Attempt:
    """Return the attempt after all choices that are made by trial, in their order."""
    for part, choose in (
        ("tiles and transform", choose_tiles),
        ("fill values", fill_tiles),
        ("quantiser step", choose_step),
        ("head", try_head),
        ("coarser bases", refit_bases),
        ("prediction", try_predictor),
    ):
        task.parts.begin(part)
        attempt = choose(task, attempt)
    return attempt


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


def _final_coding(task: PlanTask, attempt: Attempt) -> Coding:
    """Return the options of the encoder for all tiles.

    The fill values of the sample are used again if the sample has all tiles. Fill values of
    integer data are not: rounded ones would cost more than those that they were rounded from.
    """
    if task.blocks.complete or (attempt.sample.complete and task.blocks.dtype.kind == "f"):
        return attempt.coding
    return replace(attempt.coding, filled=False, density=task.density)


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
    settings = settings if blocks.complete else replace(settings, mask=MaskLevels())
    return CodingPlan(
        blocks=blocks.retile(tile), settings=settings, coding=Coding(exact=True), goal=goal
    )


def _can_estimate(task: PlanTask, tiled: Blocks, settings: TileSettings) -> bool:
    """Whether estimates replace the trials: at effort 1, where they are precise enough."""
    return (
        task.config.effort == 1
        and task.goal.psnr is not None
        and task.goal.data_range > 0
        and tiled.in_memory
        and tiled.complete
        and not settings.double
    )


def _estimated_bytes(task: PlanTask, tiled: Blocks, settings: TileSettings) -> float:
    """Return the bytes of all tiles at the promised PSNR, by their coefficients."""
    psnr = task.goal.even_psnr
    assert psnr is not None
    return estimated_size(
        tiled, settings, psnr=psnr, data_range=task.goal.data_range, workers=task.workers
    )


def _estimated_plan(task: PlanTask, tiled: Blocks, settings: TileSettings) -> CodingPlan:
    """Return the plan of effort 1: tiles and step from estimates, the usual transform."""
    goal = task.goal
    assert goal.psnr is not None
    assert goal.even_psnr is not None
    tiling = None
    if task.fixed_tile is None:
        size = _estimated_bytes(task, tiled, settings)
        tiling = cheap_tiling(task.blocks.shape, size, task.config.access)
        tiled = task.blocks.retile(tiling.tile)
    settings = replace(settings, transform=usual_transform(tiled.tile))
    coding = Coding(filled=True, density=0, bulk=goal.bulk)
    step = estimated_step(
        tiled,
        settings,
        coding,
        psnr=goal.psnr,
        even_psnr=goal.even_psnr,
        data_range=goal.data_range,
        workers=task.workers,
    )
    return CodingPlan(
        blocks=tiled,
        settings=with_step(settings, step, goal),
        coding=coding,
        goal=goal,
        tiling=tiling,
        keeps_decoded=prod(tiled.shape) * tiled.dtype.itemsize <= MAX_BYTES_KEPT,
    )
