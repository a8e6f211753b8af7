"""Plan of an encoding: every choice of the profile compact, made on a sample of the tiles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

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
from fhash_codec.compact.goal import Goal, integer_goal, with_step
from fhash_codec.compact.planner import (
    is_nearly_exact,
    is_priced,
    on_all_tiles,
    plan_by_prices,
)
from fhash_codec.compact.sample import Sample
from fhash_codec.compact.stages import (
    choose_predicted,
    choose_step,
    choose_tiles,
    fill_tiles,
    first_guess,
    first_settings,
    refit_bases,
    try_head,
    try_predictor,
)
from fhash_codec.compact.tiles import Blocks, Coding, Outcome, Tile
from fhash_codec.compact.tilings import choose_tiling, tiling_without_trials
from fhash_codec.compact.transform import estimated_size, estimated_step, usual_transform
from fhash_codec.config import EncodeConfig
from fhash_codec.features.features import Feature
from fhash_codec.measure.value_range import ValueRange, mean_of
from fhash_codec.progress import Parts, Progress, stage
from fhash_formats.transform.spec import MAX_LABELS, MAX_LENGTH, MaskLevels
from fhash_formats.transform.tile import OFFSETS
from fhash_formats.transform.tile_format import (
    FEW,
    Shape,
    TileSettings,
    has_regions,
    surely_exceeds,
)

LOOK_VERTICES = 1 << 18
"""Vertices that are looked at, and coded for the size estimate."""
CLEARLY = 3
"""Ratio of deflated tiles to tiles of labels from which on nothing else is tried."""
HOPELESS = 1.25
"""Size of the first guess, as a multiple of that of labels, from which on nothing else is tried."""
ENERGY = 0.99
"""Share of the squared deviations from the mean that the counted vectors of a basis hold."""
STRUCTURELESS = 0.97
"""Share of the values' own entropy from which on labels are taken for noise."""


@dataclass(frozen=True, kw_only=True)
class LabelTrial:
    """Outcome of coding as labels.

    Attributes:
        attempt: tiles that were looked at, and settings.
        clearly: whether nothing else can take fewer bytes; never where values need not be exact.
        alone: whether nothing but labels may be tried: values must be exact, or all tiles may be
            labels. A sample may lie on a plateau beside a shell, whose tiles then have the settings
            of a first guess.
        entropy: bytes of the values by how often each occurs in its tile, whatever stands around.
        rank: see `rank_share`.
    """

    attempt: Attempt
    clearly: bool
    alone: bool
    entropy: float
    rank: float


def ends_trials(trial: LabelTrial, other: float) -> bool:
    """Whether labels are taken after a first guess of `other` bytes without a transform."""
    size = trial.attempt.outcome.size
    return trial.alone and is_hopeless(size, other, trial.entropy, trial.rank)


def is_hopeless(labels: float, other: float, entropy: float, rank: float) -> bool:
    """Whether trials that begin with a first guess of `other` bytes can end below `labels` bytes.

    They hardly change the size of noise, which neither way takes for anything else. Elsewhere they
    save less, the larger the first guess is beside labels, unless the data's own basis of an axis
    needs but few vectors: a trial of it leaves about this share of the first guess.

    Args:
        labels: bytes as labels.
        other: bytes of the first guess.
        entropy, rank: see `LabelTrial`.
    """
    if labels >= STRUCTURELESS * entropy:
        return other >= labels
    return rank * other >= HOPELESS * labels


def rank_share(tiles: Sequence[npt.NDArray[Any]]) -> float:
    """Return the share of the vectors of an axis that hold ENERGY of tiles (t, z, y, x).

    It is that of the axis with the smallest share, of those along which a tile may have a basis; 1
    for tiles of one value. The basis is the data's own, one for all tiles of one length.
    """
    deviations = [_unit_deviations(tile) for tile in tiles]
    smallest = 1.0
    for axis in range(4):
        moments: dict[int, npt.NDArray[np.float64]] = {}
        for tile in deviations:
            if 1 < tile.shape[axis] <= MAX_LENGTH:
                lines = np.moveaxis(tile, axis, -1).reshape(-1, tile.shape[axis])
                moments[lines.shape[1]] = moments.get(lines.shape[1], 0.0) + lines.T @ lines
        vectors = length = 0
        for moment in moments.values():
            energies = np.cumsum(np.linalg.eigvalsh(moment)[::-1])
            if energies[-1] > 0:
                vectors += 1 + int(np.searchsorted(energies, ENERGY * energies[-1]))
                length += len(moment)
        if length:
            smallest = min(smallest, vectors / length)
    return smallest


def _unit_deviations(tile: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Return the deviations of a tile from its middle, of magnitudes up to 1; 0 for NaN."""
    values = np.nan_to_num(tile.astype(np.float64), posinf=0.0, neginf=0.0)
    values /= max(np.abs(values).max(), np.finfo(np.float64).tiny)
    values -= values.mean()
    return values


def has_labels(task: PlanTask, tiled: Blocks) -> bool:
    """Whether any tile of a sample has few enough different values, or regions of equal ones."""
    sample = Sample(tiled, LOOK_VERTICES, task.workers)
    return any(_is_labels(tile, tiled) for tile in sample.tiles)


def _are_all_labels(task: PlanTask, tiled: Blocks) -> bool:
    """Whether all tiles of a series may be labels; of one larger than memory, those of a sample."""
    if not tiled.in_memory:
        sample = Sample(tiled, LOOK_VERTICES, task.workers)
        return all(_is_labels(tile, tiled) for tile in sample.tiles)
    return all(_is_labels(tiled.read(index), tiled) for index in tiled.indices())


def _is_labels(tile: Tile, tiled: Blocks) -> bool:
    """Whether a tile has few enough different values to be coded as labels."""
    # Vertices that are not occupied take a label of their own.
    spare = not tiled.complete
    most = (MAX_LABELS if has_regions(tile.values) else FEW) - spare
    return not surely_exceeds(tile.values, most) and np.unique(tile.values).size <= most


def look_at_labels(task: PlanTask, tiled: Blocks, settings: TileSettings) -> LabelTrial:
    """Return the trial of labels on a sample of some tiles."""
    if not task.blocks.complete:
        settings = replace(settings, mask=MaskLevels())
    settings = replace(settings, labels=True, quantum=0.0, clip=False)
    coding = Coding(filled=True, density=0)
    exact = replace(coding, exact=True)
    sample = Sample(tiled, LOOK_VERTICES, task.workers)
    outcome = sample.run(settings, replace(coding, error=0.0))
    entropy = sum(
        weight * _entropy(tile.counted_values)
        for weight, tile in zip(sample.weights, sample.tiles, strict=True)
    )
    rank = rank_share(
        [
            tile.values
            if tile.counted is None
            else np.where(tile.counted, tile.values, mean_of(tile.counted_values))
            for tile in sample.tiles
            if not tile.is_empty
        ]
    )
    clearly = task.goal.lossless and CLEARLY * outcome.size <= sample.run(settings, exact).size
    alone = task.goal.lossless or _are_all_labels(task, tiled)
    task.gains.note("labels", outcome)
    attempt = Attempt(sample=sample, settings=settings, outcome=outcome, coding=coding)
    return LabelTrial(attempt=attempt, clearly=clearly, alone=alone, entropy=entropy, rank=rank)


def with_step_of(trial: LabelTrial, guess: Attempt) -> LabelTrial:
    """Return a trial whose tiles of too many values keep the promise of a first guess.

    guess: its outcome has the promise that is not an exact one.
    """
    mask = trial.attempt.settings.mask
    settings = replace(guess.settings, labels=True, mask=mask, head=None, predictor=None)
    coding = replace(trial.attempt.coding, bulk=guess.coding.bulk)
    return replace(trial, attempt=replace(trial.attempt, settings=settings, coding=coding))


def tiled_labels(task: PlanTask, trial: LabelTrial) -> Attempt:
    """Return the attempt of labels with the tiles that are best for them."""
    attempt = trial.attempt
    settings, sample, outcome = attempt.settings, attempt.sample, attempt.outcome
    tiling = None
    if task.fixed_tile is None:
        tiling = _tiling(task, settings, attempt.coding, outcome.size)
        sample = Sample(task.blocks.retile(tiling.tile), LOOK_VERTICES, task.workers)
        if not tiling.parts:
            size = tiling.trials.get(tiling.tile, outcome.size)
            outcome = replace(outcome, size=round(size))
    settings = replace(settings, transform=usual_transform(sample.blocks.tile))
    return replace(attempt, sample=sample, settings=settings, outcome=outcome, tiling=tiling)


def holds_beside(task: PlanTask, labelled: Attempt, other: Attempt) -> bool:
    """Whether labels take no more bytes than another attempt does.

    Where that is known of a sample only, they must also do so on the sample of the other one: their
    own may lie on a plateau.
    """
    if labelled.outcome.size > other.outcome.size:
        return False
    if other.sample.complete:
        return True
    transform = usual_transform(other.sample.blocks.tile)
    settings = replace(labelled.settings, transform=transform)
    outcome = other.sample.run(settings, task.goal.bounded(labelled.coding))
    return outcome.size <= other.outcome.size


def _tiling(task: PlanTask, settings: TileSettings, coding: Coding, size: float) -> Tiling:
    """Return the choice of the tiles for labels: by trial from effort 2 on."""
    cheap = tiling_without_trials(task, size)
    return choose_tiling(task, settings, coding, task.config.access) if cheap is None else cheap


def _entropy(values: npt.NDArray[Any]) -> float:
    """Bytes of values by how often each occurs."""
    counts = np.unique(values, return_counts=True)[1]
    return float(-(counts * np.log2(counts / max(values.size, 1))).sum()) / 8


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


def _planned(task: PlanTask, tiled: Blocks) -> CodingPlan:
    """Return the plan for the goal of a task, from the tiles of a first guess on."""
    parts = task.parts
    parts.begin("first guess")
    with stage("first guess", "mean and approximate bytes, by which tiles are chosen"):
        settings = first_settings(task, tiled)
    trial = None
    if task.goal.size is None:
        with stage("labels", "values of which few may differ"):
            trial = look_at_labels(task, tiled, settings) if has_labels(task, tiled) else None
    if trial is not None and trial.clearly:
        parts.end()
        return _label_plan(task, tiled_labels(task, trial))
    if _can_estimate(task, tiled, settings) and (
        trial is None or trial.attempt.outcome.size >= _estimated_bytes(task, tiled, settings)
    ):
        with stage("estimate", "effort 1: step and tiles from coefficients, without trials"):
            estimated_plan = _estimated_plan(task, tiled, settings)
        parts.end()
        return estimated_plan
    found = _by_trial(task, tiled, settings, trial)
    parts.end()
    return found


def _by_trial(
    task: PlanTask, tiled: Blocks, settings: TileSettings, trial: LabelTrial | None
) -> CodingPlan:
    """Return the plan after trials of all choices, or of labels where these need fewer bytes."""
    if by_prices := is_priced(task, tiled, settings):
        attempt = plan_by_prices(task, settings)
    else:
        with stage("first guess", "approximate bytes, by which tiles are chosen"):
            attempt = first_guess(task, tiled, settings)
    if trial is not None and not task.goal.lossless:
        trial = with_step_of(trial, attempt)
    if not by_prices:
        if trial is not None and ends_trials(trial, attempt.outcome.size):
            return _label_plan(task, tiled_labels(task, trial))
        attempt = _improved(task, attempt)
    elif trial is not None and trial.attempt.outcome.size <= LIKELY * attempt.outcome.size:
        attempt = on_all_tiles(task, attempt)  # what labels compete with is no estimate
    settings = attempt.settings
    if trial is not None and trial.attempt.outcome.size <= LIKELY * attempt.outcome.size:
        labelled = tiled_labels(task, trial)
        if holds_beside(task, labelled, attempt):
            return _label_plan(task, labelled)
    if trial is not None and task.goal.lossless:
        settings = replace(settings, labels=True)
    blocks = attempt.sample.blocks
    # The tiles are kept as they decode, unless they are coded already, for a head.
    coded = attempt.sample.complete and bool(attempt.tried)
    small = prod(blocks.shape) * blocks.dtype.itemsize <= MAX_BYTES_KEPT
    return CodingPlan(
        blocks=blocks,
        sample=attempt.sample if coded or not by_prices else None,
        settings=settings,
        coding=task.goal.bounded(attempt.coding if by_prices else _final_coding(task, attempt)),
        goal=task.goal,
        gains=task.gains.entries,
        history=attempt.history,
        tiling=attempt.tiling,
        size=attempt.outcome.size if _keeps_promise(task, attempt.outcome) else math.inf,
        keeps_decoded=by_prices and not coded and small,
    )


def _improved(task: PlanTask, attempt: Attempt) -> Attempt:
    """Return the attempt after all choices that are made by trial, in their order."""
    for part, choose in (
        ("tiles and transform", choose_tiles),
        ("fill values", fill_tiles),
        ("quantiser step", choose_step),
        ("prediction", try_predictor),
        ("head", try_head),
        ("coarser bases", refit_bases),
    ):
        task.parts.begin(part)
        attempt = choose(task, attempt)
    return choose_predicted(task, attempt)


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
        chosen = settings.transform
        tiling = cheap_tiling(task.blocks.shape, size, task.config.access, chosen.axes[0])
        tiled = task.blocks.retile(tiling.tile)
        settings = replace(settings, transform=usual_transform(tiled.tile, chosen))
    slow = task.is_slow(tiled.tile, _estimated_bytes(task, tiled, settings))
    coding = Coding(filled=True, density=0, bulk=goal.bulk, fast=slow)
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
