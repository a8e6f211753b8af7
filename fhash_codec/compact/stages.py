"""Stages of planning: centre, mask, filling, coarser bases, each kept where it saves bytes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from math import prod
from operator import itemgetter

import numpy as np

from fhash_codec.compact.attempt import FAST_BYTES, Attempt, PlanTask, Tiling, sub_tile
from fhash_codec.compact.goal import (
    EXACT,
    EXCHANGE,
    NEAR,
    QUICK,
    Goal,
    Precision,
    find_step,
    octave_gain,
    require_reach,
    step_after,
    step_after_gain,
    with_step,
)
from fhash_codec.compact.head import choose_head
from fhash_codec.compact.predictor import choose_predictor
from fhash_codec.compact.sample import MAX_PRICED_EFFORT, Sample, mask_levels, priced
from fhash_codec.compact.tiles import Blocks, Coding, Outcome, off_trellis, on_trellis
from fhash_codec.compact.tilings import choose_tiling, tiling_without_trials
from fhash_codec.compact.transform import (
    adapted_transform,
    basis_bytes,
    cheaper_transform,
    choose_transform,
    chosen_by_prices,
    moved_transform,
    refit,
    tile_costs,
    usual_transform,
)
from fhash_codec.measure.value_range import ValueRange, mean_of
from fhash_codec.progress import skip, stage, tell
from fhash_formats.transform.tile import OFFSETS
from fhash_formats.transform.tile_format import Shape, TileSettings

BINS = 4096
"""Intervals of the value range among which the fullest is looked for."""
PLATEAU = 0.03
"""Share of the values in the fullest interval from which on it is a plateau.

Series without one had 0.011 at most (wind, still over land), where either centre gave the same
bytes within 0.1 %; counts over a background had 0.07 and took 15 % fewer bytes by it.
"""
MAX_CENTER = 3e38
"""Largest magnitude of a centre that is rounded to float32."""


def mean_center(sample: Sample, value_range: ValueRange) -> float:
    """Return the mean of a sample as the centre, in data units; without values the middle."""
    if not sample.counted:
        return _rounded_center(value_range.low + (value_range.high - value_range.low) / 2)
    means = [mean_of(tile.counted_values) for tile in sample.tiles]
    return _rounded_center(float(np.average(means, weights=sample.weights)))


def plateau_center(sample: Sample, value_range: ValueRange) -> float | None:
    """Return the plateau of a series as the centre, in data units; None without one.

    About a plateau all coefficients are 0 where nothing happens; about the mean they are not.
    """
    low, high = value_range.low, value_range.high
    if not (low < high and math.isfinite(high - low)):
        return None
    counted = (tile.counted_values for tile in sample.tiles)
    numbers = [values[np.isfinite(values)].astype(np.float64) for values in counted]
    edges = np.linspace(low, high, BINS + 1)
    counts = np.zeros(BINS)
    for values, weight in zip(numbers, sample.weights, strict=True):
        counts += weight * np.histogram(values, edges)[0]
    fullest = int(np.argmax(counts))
    if counts[fullest] < PLATEAU * counts.sum() or not counts[fullest]:
        return None
    values = np.concatenate(numbers)
    inside = (values >= edges[fullest]) & (values <= edges[fullest + 1])
    return _rounded_center(float(np.median(values[inside])))


def _rounded_center(center: float) -> float:
    """Return a centre as float32 holds it, where it can."""
    return float(np.float32(center)) if abs(center) < MAX_CENTER else center


STEP_SHARES = (0.0, 0.25, 0.5, 1.0)
"""Quantiser steps tried for filling, as shares of the final step; 0 keeps the existing values."""
TRIAL_DENSITY = 2
"""Thoroughness (density) of the fillings that compete."""
FILLING_TRIES = 3
"""Trials of the search for the step that makes the fillings comparable."""


def choose_filling(
    sample: Sample, settings: TileSettings, coding: Coding, goal: Goal, density: int
) -> Sample:
    """Return the sample with the filling that takes the fewest bytes where the promise is kept.

    density: thoroughness of the chosen filling, see `fill`.
    """

    def filled(share: float, density: int) -> Sample:
        step = settings.step * (share or 1.0)
        return sample.filled(replace(settings, step=step), density if share else 0)

    def trial(share: float) -> tuple[float, float]:
        outcome = find_step(
            filled(share, TRIAL_DENSITY), settings, coding, goal, tries=FILLING_TRIES
        )[1]
        return _cost(outcome, goal), share

    return filled(min(trial(share) for share in STEP_SHARES)[1], density)


def _cost(outcome: Outcome, goal: Goal) -> float:
    """Return the bytes at the PSNR of the goal, by the usual exchange rate of dB for bytes."""
    if goal.psnr is None or not outcome.size:
        return outcome.size
    missing = goal.psnr - outcome.psnr(goal.data_range)
    return float(outcome.size * 2 ** (missing / EXCHANGE))


FACTORS = (1.5, 2.2)
"""Factors of the final step for which bases are tried, until one does not pay."""
LEAST = 0.01
"""Share of tiles and bases that the bases must take, so that coarser ones are tried."""
LEAST_QUICKLY = 0.1
"""The same where seconds count, as a share of tiles alone."""
TRIES = 4
"""Trials of a step for each of them."""


def coarser_bases(
    sample: Sample,
    settings: TileSettings,
    outcome: Outcome,
    coding: Coding,
    goal: Goal,
) -> tuple[TileSettings, Outcome] | None:
    """Return settings with bases made for a coarser step if the sample gets smaller by them.

    Otherwise the settings and their outcome are returned as they are, and None where nothing was
    tried. Sizes are compared at the same PSNR, or under a bound as they are.

    outcome: outcome of the settings, which keeps the promise.
    """
    taken = basis_bytes(settings.transform)
    if not outcome.count or taken < LEAST * (outcome.size + taken):
        skip("coarser bases", f"the data's own bases take {taken:.0f} bytes")
        return None
    best, lowest = (settings, outcome), 0.0
    with stage("coarser bases", f"the data's own bases take {taken:.0f} bytes"):
        for factor in FACTORS:
            tried: list[Outcome] = []
            coarser = refit(sample, settings, factor)
            found, new = find_step(sample, coarser, coding, goal, tries=TRIES, tried=tried)
            cost = new.size + basis_bytes(found.transform) - outcome.size - taken
            if goal.error is None:
                # The rest of the difference in quality between the two searches, in bytes.
                missing = outcome.psnr(goal.data_range) - new.psnr(goal.data_range)
                cost += outcome.size * (2 ** (missing / octave_gain(tried, goal.data_range)) - 1)
            if cost >= lowest:
                break
            best, lowest = (found, new), cost
    return best


LOOK_VERTICES = 1 << 18
"""Vertices coded for the first size estimate."""
TRIAL_VERTICES = 3 << 20
"""Vertices coded for each trial of a transform."""
COMPARED_VERTICES = 1 << 20
"""Vertices of the tiles on which the two coders are compared; one tile may have more."""
WITH_HEAD = 0.6
"""Share of the bytes that no head takes fewer than."""
COMPARED_QUICKLY = 1 << 18
"""The same of parts of tiles, where seconds count."""
UNDECIDED = 0.03
"""Distance of the ratio on small parts from the one allowed from which on it decides."""
FEWEST_BITS = 0.1
"""Bits of a vertex in the first guess below which trials beside a plateau are not quick."""
PLAIN_COSTS = 1.03
"""Factor of the bytes by the plain quantiser on small parts, where the trellis is as good later."""
LEAST_PRICED = 1 << 18
"""Vertices that are priced for each transform at effort 1."""
PRICED_VERTICES = 1 << 19
"""Vertices that are priced for each trial of a transform, in parts of tiles."""
PRICED_SHARP = 1 << 20
"""The same beside a plateau."""
SAMPLE_VERTICES = 6 << 20
"""Vertices coded for each trial of a step."""
MAX_SEARCHED_VERTICES = 12 << 20
"""Vertices up to which a series is searched whole instead of on a sample."""
LARGE = 1.5
"""Vertices of a tile, in TRIAL_VERTICES, from which on a part of it stands for it in trials."""
MIN_HEAD_EFFORT = 5
"""Least effort that trains a head."""
PARTS = 4
"""Parts of a large tile on which a transform is chosen, in all of TRIAL_VERTICES."""
SAMPLE_WHY = "tiles on which the choices are tried"
"""Reason for the stage that reads and fills a sample."""
HEAD_TRIES = 3
"""Trials of the step with a head: the search begins within some hundredths of a dB of its end."""
REFITS = 3
"""Times that the data's own bases are made anew for another step."""
LOST = 0.5
"""Distance in dB from the promise from which on bases made anew lack directions it needs."""
SAME_STEP = 0.1
"""Difference of log steps below which bases are not made anew."""


MIN_EFFORT = 2
"""Least effort that uses the trellis."""


def allows_trellis(settings: TileSettings, goal: Goal, effort: int) -> bool:
    """Whether the trellis may be used.

    Values that are exact after all have no use for it. Steps so fine that they need float64 come
    near the finest step there is, with which the plain quantiser errs less.
    """
    exact = goal.error == 0 or goal.data_range <= 0
    return effort >= MIN_EFFORT and not exact and not settings.double


def first_settings(task: PlanTask, tiled: Blocks) -> TileSettings:
    """Return settings to begin with: the usual transform, a centre, a guessed step."""
    sample = Sample(tiled, LOOK_VERTICES, task.workers, tick=task.parts.tick)
    goal, value_range = task.goal, task.value_range
    if goal.psnr is not None:
        step = 4 * goal.expected_error
    elif goal.error is not None:
        step = 2.5 * goal.error
    else:
        step = goal.data_range * 0.05
    # From effort 2 on the centre is chosen once more, on the chosen tiles.
    plateau = plateau_center(sample, value_range) if task.config.effort == 1 else None
    settings = TileSettings(
        transform=usual_transform(sample.blocks.tile),
        step=1.0,
        center=mean_center(sample, value_range) if plateau is None else plateau,
        low=value_range.low,
        high=value_range.high,
        offsets=OFFSETS,
        double=True,
    )
    settings = with_step(settings, step, goal)
    return settings if task.config.effort > 1 else _by_prices(task, tiled, settings)


def _by_prices(task: PlanTask, tiled: Blocks, settings: TileSettings) -> TileSettings:
    """Return settings with the transform for which parts of the tiles have the least prices."""
    parts = tiled.retile(sub_tile(tiled.tile, LEAST_PRICED // PARTS))
    usual = replace(settings, transform=usual_transform(parts.tile))
    sample = Sample(parts, LEAST_PRICED, task.workers)
    trials = priced(sample, usual, task.config.effort)
    if trials is sample:
        return settings
    chosen = chosen_by_prices(trials, usual, task.goal.bounded(Coding(fast=True)))
    return replace(settings, transform=usual_transform(tiled.tile, chosen))


def first_guess(task: PlanTask, tiled: Blocks, settings: TileSettings) -> Attempt:
    """Code a few tiles for a first idea of the size."""
    sample = _sample(task, tiled, settings, LOOK_VERTICES)
    quick = task.config.effort <= MAX_PRICED_EFFORT and task.config.access != "small"
    coding = Coding(
        filled=task.blocks.complete, density=0, bulk=task.goal.bulk, fast=quick, rough=quick
    )
    settings = _with_mask(task, sample, settings, task.goal.expected_error)
    looked = sample
    if quick and task.goal.psnr is not None:
        looked = priced(sample, settings, task.config.effort)
    settings, outcome = find_step(looked, settings, coding, task.goal, tries=2)
    require_reach(task.goal, settings, outcome)
    task.gains.note("start", outcome)
    sharp = quick and plateau_center(sample, task.value_range) is not None
    if sharp and 8 * outcome.size < FEWEST_BITS * prod(task.blocks.shape):
        # Of a shock in a few bytes, one coder does not tell what the other would choose.
        coding, quick, sharp = replace(coding, fast=False, rough=False), False, False
    return Attempt(
        sample=sample,
        settings=settings,
        outcome=outcome,
        coding=coding,
        quick=quick,
        sharp=sharp,
    )


def choose_tiles(task: PlanTask, attempt: Attempt) -> Attempt:
    """Choose the tiles, by trial or by the size of the first guess, and the transform."""
    tiled, tiling, guessed = attempt.sample.blocks, attempt.tiling, attempt.sample.blocks.tile
    if task.fixed_tile is None:
        tiling = _tiling(task, attempt)
        tiled = task.blocks.retile(tiling.tile)
    else:
        skip("tiles", f"--tile {task.config.tile}")
    chosen = attempt.settings.transform if task.config.effort == 1 else None
    settings = replace(attempt.settings, transform=usual_transform(tiled.tile, chosen))
    found = tiling.found if attempt.quick and tiling is not None else None
    if found is not None:
        settings, outcome = found
        attempt = replace(attempt, outcome=outcome)
    with stage("sample", SAMPLE_WHY):
        sample = _sample(task, tiled, settings, vertices_of_trials(attempt))
    # Tiles were chosen about the mean: about the plateau of a shock wave their trials misled.
    plateau = plateau_center(sample, task.value_range)
    settings = settings if plateau is None else replace(settings, center=plateau)
    attempt = replace(attempt, sample=sample, settings=settings, tiling=tiling)
    if task.config.effort == 1:
        skip("transform", "effort 1 tries none; from 2 on")
        return attempt
    if found is None and sample.is_single and task.goal.error and tiled.tile != guessed:
        # Under a bound, the step of the first guess may be six times too coarse for other tiles.
        with stage("step", "first guess for the tiles that were chosen"):
            settings, _ = find_step(sample, settings, attempt.coding, task.goal, tries=2)
        attempt = replace(attempt, settings=settings)
    if _asked(task, "transform"):
        with stage("transform", f"trials along each axis, at effort {task.config.effort}"):
            attempt = _choose_transform(task, attempt)
    else:
        with stage("step", "size of the tiles where the promise is kept"):
            attempt = _choose_transform(task, attempt)
    vertices = prod(task.blocks.shape)
    searched = MAX_SEARCHED_VERTICES if vertices <= MAX_SEARCHED_VERTICES else SAMPLE_VERTICES
    with stage("sample", SAMPLE_WHY):
        return replace(attempt, sample=attempt.sample.wider(searched))


def vertices_of_trials(attempt: Attempt) -> int:
    """Return the vertices on which each transform is tried."""
    if not attempt.quick:
        return TRIAL_VERTICES
    return PRICED_SHARP if attempt.sharp else PRICED_VERTICES


def is_tried_in_parts(tile: Shape, attempt: Attempt) -> bool:
    """Whether transforms of a tile are tried on parts of it."""
    return prod(tile) > (2 if attempt.quick else LARGE) * vertices_of_trials(attempt)


def _transform_of_large_tile(task: PlanTask, attempt: Attempt) -> TileSettings:
    """Return settings with a transform that is chosen on parts of a large tile.

    The parts are a sample by their costs: one place may be a plateau. They have all steps and all
    of z where they can; what they cannot tell, bases as long as the tile, competes with their
    choice on the sample itself.
    """
    sample, coding = attempt.sample, task.goal.bounded(attempt.coding)
    vertices = vertices_of_trials(attempt)
    usual, small = _in_parts(task, attempt, vertices // PARTS, vertices)
    trials = priced(small, usual, task.config.effort)
    first = usual if not attempt.quick else moved_transform(trials, attempt.settings)
    found, _ = choose_transform(trials, first, coding, coded=_is_coded(task, attempt))
    trials = priced(sample, attempt.settings, task.config.effort)
    return adapted_transform(trials, attempt.settings, found.transform.axes, coding)


def _in_parts(
    task: PlanTask, attempt: Attempt, part: int, vertices: int
) -> tuple[TileSettings, Sample]:
    """Return a sample of parts of the tiles, and settings for them.

    part: vertices of each of them at most.
    vertices: those of all.
    """
    parts = task.blocks.retile(sub_tile(attempt.sample.blocks.tile, part))
    usual = replace(attempt.settings, transform=usual_transform(parts.tile))
    return usual, _sample(task, parts, usual, vertices)


def _tiling(task: PlanTask, attempt: Attempt) -> Tiling:
    """Return the choice of the tiles: by trial from effort 2 on."""
    access = task.config.access
    time = attempt.settings.transform.axes[0]
    cheap = tiling_without_trials(task, attempt.outcome.size, time)
    if cheap is not None:
        if task.config.effort == 1:
            skip("tiles", "effort 1 foretells what tiles cost; from 2 on they are tried")
        else:
            skip("tiles", "--without tiles")
        return cheap
    with stage("tiles", f"trials for --access {access}"):
        settings, coding = attempt.settings, attempt.coding
        tiling = choose_tiling(task, settings, coding, access, sharp=attempt.sharp)
    tell("tiles", f"--access {access}: {tiling.describe()}")
    return tiling


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
        attempt = _with_coder(task, attempt)
        if attempt.quick and task.goal.error is not None:
            attempt = _bounded_step(task, attempt, attempt.settings)
            settings = _with_new_mask(task, attempt.sample, attempt.settings, attempt.outcome)
            attempt = replace(attempt, settings=settings)
        else:
            attempt = _searched_step(task, attempt)
    if task.config.effort > 1:
        task.gains.note("transform by trial", attempt.outcome)
    return attempt


def _with_coder(task: PlanTask, attempt: Attempt) -> Attempt:
    """Return the attempt with coder and quantiser that take the fewest bytes of the sample.

    Where seconds count, parts of few tiles tell, and whole tiles only where these leave it open.
    """
    settings, goal = attempt.settings, task.goal
    slow = task.is_slow(attempt.sample.blocks.tile, attempt.outcome.size)
    if task.config.effort == 1:
        return replace(attempt, coding=replace(attempt.coding, fast=slow))
    part = attempt.sample.narrowed(COMPARED_VERTICES) if attempt.quick else attempt.sample
    few, moved, open_by = part, attempt, 0.0
    if attempt.quick and not attempt.sharp:
        _, few = _in_parts(task, attempt, COMPARED_QUICKLY, COMPARED_QUICKLY)
        moved, open_by = replace(attempt, settings=moved_transform(few, settings)), UNDECIDED
    on_or_off = (True, False) if allows_trellis(settings, goal, task.config.effort) else (False,)
    kinds = [(fast, on) for fast in ((True, False) if slow else (False,)) for on in on_or_off]
    best: dict[bool, tuple[float, bool]] = {}
    for (fast, on), cost in zip(kinds, _costs(task, moved, few, kinds), strict=True):
        known = PLAIN_COSTS * cost if attempt.quick and not on else cost
        best[fast] = min(best.get(fast, (math.inf, on)), (known, on), key=itemgetter(0))
    fast = slow
    if slow:
        found = _is_fast_enough(task, [best[True][0], best[False][0]], open_by)
        if found is None:
            kinds = [(fast, best[fast][1]) for fast in (True, False)]
            found = _is_fast_enough(task, _costs(task, attempt, part, kinds), 0.0)
        fast = found is not False
    if goal.psnr is not None:
        settings = replace(
            settings, step=step_after(settings, attempt.outcome, goal, task.slope.slope)
        )
    coding = replace(attempt.coding, fast=fast)
    settings, coding = on_trellis(settings, coding) if best[fast][1] else (settings, coding)
    return replace(attempt, settings=settings, coding=coding)


def _costs(
    task: PlanTask, attempt: Attempt, part: Sample, kinds: Sequence[tuple[bool, bool]]
) -> list[float]:
    """Return the bytes of a part by some coders and quantisers, at equal quality.

    kinds: whether by the fast coder, and whether on the trellis.
    """
    trials = []
    for fast, on in kinds:
        how = attempt.settings, replace(attempt.coding, fast=fast)
        settings, coding = on_trellis(*how) if on else how
        trials.append((settings, task.goal.bounded(coding)))
    return [_cost(outcome, task.goal) for outcome in part.run_all(trials)]


def _is_fast_enough(task: PlanTask, costs: Sequence[float], undecided: float) -> bool | None:
    """Whether the fast coder takes few enough bytes; None where they come too near the limit.

    costs: bytes by the fast coder and by the other one.
    undecided: distance from the limit up to which it is left open.
    """
    ratio, limit = costs[0] / max(costs[1], 1.0), FAST_BYTES[task.config.access]
    tell("step", f"the fast coder takes {ratio:.3f} times the bytes")
    return None if abs(ratio - limit) < undecided else ratio <= limit


def _bounded_step(task: PlanTask, attempt: Attempt, settings: TileSettings) -> Attempt:
    """Return the attempt with settings of the step that a bound asks for, by few trials.

    Each tile keeps the bound with any step: few of them tell which costs least.
    """
    sample, coding = attempt.sample, task.goal.bounded(attempt.coding)
    few = sample.narrowed(COMPARED_VERTICES)
    settings, outcome = find_step(few, settings, coding, task.goal, tries=3)
    refitted = refit(sample, settings)
    if refitted is not settings:
        extra = basis_bytes(refitted.transform) - basis_bytes(settings.transform)
        if few.run(refitted, coding).size + extra < outcome.size:
            settings = refitted
    return replace(attempt, settings=settings, outcome=sample.run(settings, coding))


def _searched_step(task: PlanTask, attempt: Attempt) -> Attempt:
    """Return the attempt with the step that the sample asks for, and with bases fitted to it."""
    sample, coding, goal = attempt.sample, attempt.coding, task.goal
    tries = 3 if task.config.effort == 1 or attempt.quick else 5
    tried: list[Outcome] = []
    precision = _precision(task, attempt)
    if not attempt.quick and not without_head(task, attempt):
        precision = NEAR
    settings, fitted = attempt.settings, None
    if attempt.quick:
        settings, fitted = refit(sample, settings), settings.step
    settings, outcome = find_step(
        sample, settings, coding, goal, tries=tries, tried=tried, precision=precision
    )
    settings = _with_new_mask(task, sample, settings, outcome)
    for _ in range(1 if attempt.quick else REFITS):
        # A basis is as precise as the step that it was made for needs: a finer step needs another.
        if fitted is not None and abs(math.log(settings.step / fitted)) < SAME_STEP:
            break
        refitted = refit(sample, settings)
        if refitted is settings:
            break
        fitted, before = settings.step, (settings, outcome)
        settings, outcome = find_step(
            sample, refitted, coding, goal, tries=tries, tried=tried, precision=precision
        )
        if goal.psnr is not None and outcome.psnr(goal.data_range) < goal.psnr - LOST:
            settings, outcome = before
            break
    return replace(attempt, settings=settings, outcome=outcome, tried=tried)


def _with_new_mask(
    task: PlanTask, sample: Sample, settings: TileSettings, outcome: Outcome
) -> TileSettings:
    """Return settings with scores of a mask for the error that a bound or a size leaves."""
    if task.goal.psnr is not None or not outcome.count:
        return settings
    return _with_mask(task, sample, settings, math.sqrt(outcome.squares / outcome.count))


def try_head(task: PlanTask, attempt: Attempt) -> Attempt:
    """Train a head, and keep it if the file gets smaller by it."""
    goal = task.goal
    if not _asked(task, "head"):
        return attempt
    predicted = math.inf if attempt.predicted is None else attempt.predicted[1]
    if attempt.quick and predicted < WITH_HEAD * attempt.outcome.size:
        skip("head", "predicted values take fewer bytes than it would leave")
        return attempt
    if reason := without_head(task, attempt):
        skip("head", reason)
        return attempt

    def find(settings: TileSettings) -> tuple[TileSettings, Outcome]:
        return _head_step(task, attempt, settings)

    def look(settings: TileSettings) -> Outcome:
        return attempt.sample.run(settings, goal.bounded(attempt.coding))

    settings, outcome, history = choose_head(task, attempt, find, look)
    if settings.head is None:
        settings, outcome = _at_the_promise(task, attempt)
    task.gains.note("head" if settings.head is not None else "head (left out)", outcome)
    return replace(attempt, settings=settings, outcome=outcome, history=history)


def _at_the_promise(task: PlanTask, attempt: Attempt) -> tuple[TileSettings, Outcome]:
    """Return the settings of an attempt with the step that keeps the promise, and their outcome.

    The search before the head ends near that step.
    """
    goal = task.goal
    if goal.psnr is None:
        return attempt.settings, attempt.outcome
    precision = _precision(task, attempt)
    missing = goal.psnr + precision.aim - attempt.outcome.psnr(goal.data_range)
    if abs(missing) < precision.close or math.isinf(missing):
        return attempt.settings, attempt.outcome
    settings = attempt.settings
    settings = replace(settings, step=step_after_gain(settings.step, -missing))
    return _head_step(task, attempt, settings)


def _head_step(
    task: PlanTask, attempt: Attempt, settings: TileSettings
) -> tuple[TileSettings, Outcome]:
    """Return settings with the step that keeps the promise, and their outcome."""
    if attempt.quick and task.goal.error is not None:
        attempt = _bounded_step(task, attempt, settings)
        return attempt.settings, attempt.outcome
    return find_step(
        attempt.sample,
        settings,
        attempt.coding,
        task.goal,
        tries=HEAD_TRIES,
        precision=_precision(task, attempt),
    )


def _precision(task: PlanTask, attempt: Attempt) -> Precision:
    """Return the precision of the last search for the step."""
    return replace(QUICK, slope=task.slope) if attempt.quick else EXACT


def without_head(task: PlanTask, attempt: Attempt) -> str:
    """Return why no head is to be trained; "" where one is."""
    goal, effort = task.goal, task.config.effort
    if effort < MIN_HEAD_EFFORT:
        return f"effort {effort} trains none; from {MIN_HEAD_EFFORT} on"
    if "head" in task.config.without:
        return "--without head"
    if goal.size is not None:
        return "a promised ratio: the step changes once the whole file is known"
    if goal.error == 0 or goal.data_range <= 0:
        return "exact values leave nothing to correct"
    if attempt.settings.double:
        return "the step is too fine for float32, in which heads compute"
    return ""


def refit_bases(task: PlanTask, attempt: Attempt) -> Attempt:
    """Make the data's own bases anew for the final step, and keep them if the file is smaller."""
    if task.config.effort == 1 or task.goal.size is not None:
        return attempt
    taken = basis_bytes(attempt.settings.transform)
    if attempt.quick and taken < LEAST_QUICKLY * attempt.outcome.size:
        return attempt
    found = coarser_bases(
        attempt.sample, attempt.settings, attempt.outcome, attempt.coding, task.goal
    )
    if found is None:
        return attempt
    settings, outcome = found
    kept = settings is not attempt.settings
    task.gains.note("coarser bases" if kept else "coarser bases (left out)", outcome)
    return replace(attempt, settings=settings, outcome=outcome)


def try_predictor(task: PlanTask, attempt: Attempt) -> Attempt:
    """Train a predictor for a strict bound, which is kept for `choose_predicted`."""
    goal, effort = task.goal, task.config.effort
    if not goal.error or goal.data_range <= 0:
        skip("predictor", "only a bound on each error has use for it")
        return attempt
    if effort == 1 or not _asked(task, "predictor"):
        return attempt
    with stage("predictor", "trials beside the transform, for the bound on each error"):
        predicted = choose_predictor(
            *(attempt.sample, attempt.settings, _rival(task, attempt)),
            error=goal.error,
            effort=effort,
            quick=attempt.quick and not attempt.sharp,
        )
    return replace(attempt, predicted=predicted)


def choose_predicted(task: PlanTask, attempt: Attempt) -> Attempt:
    """Take the predictor if the file gets smaller by it."""
    if attempt.predicted is None:
        return attempt
    settings, size = attempt.predicted
    kept = size < _rival(task, attempt)
    task.gains.note(
        "prediction" if kept else "prediction (left out)",
        replace(attempt.outcome, size=size) if kept else attempt.outcome,
    )
    if not kept:
        return attempt
    if settings.trellis:
        settings, _ = off_trellis(settings, attempt.coding)  # no tile has coefficients now
    return replace(attempt, settings=settings, outcome=replace(attempt.outcome, size=size))


def _rival(task: PlanTask, attempt: Attempt) -> int:
    """Return the bytes that a predictor must stay below.

    What it codes is read slowly: no reason to give up the fast coder for little.
    """
    share = FAST_BYTES[task.config.access] if attempt.coding.fast else 1.0
    return round(attempt.outcome.size / share)


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


def _is_coded(task: PlanTask, attempt: Attempt) -> bool:
    """Whether the best transforms by price are coded by the mixing coder, which may be used."""
    slow = task.is_slow(attempt.sample.blocks.tile, attempt.outcome.size)
    return attempt.sharp or not (attempt.quick and slow)


def _choose_transform(task: PlanTask, attempt: Attempt) -> Attempt:
    """Choose the transform by trial, and the step that keeps the promise with it."""
    sample, coding, goal = attempt.sample, attempt.coding, task.goal
    if "transform" in task.config.without:
        usual = usual_transform(sample.blocks.tile)
        settings = replace(attempt.settings, transform=usual)
    elif sample.is_single or is_tried_in_parts(sample.blocks.tile, attempt):
        settings = _transform_of_large_tile(task, attempt)
    else:
        trials = priced(sample, attempt.settings, task.config.effort)
        settings, _ = choose_transform(
            trials, attempt.settings, goal.bounded(coding), coded=_is_coded(task, attempt)
        )
    found = None if attempt.tiling is None else attempt.tiling.found
    if attempt.quick and found is not None:
        return replace(attempt, settings=settings)  # the step is that of all tiles already
    if found is not None:
        # Trials from the usual transform on miss it where bases pay along all axes alone.
        settings = cheaper_transform(sample, settings, found[0].transform, goal.bounded(coding))
    tries, slope = (2, task.slope) if attempt.quick else (4, None)
    near = replace(NEAR, slope=slope)
    settings, outcome = find_step(sample, settings, coding, goal, tries=tries, precision=near)
    return replace(attempt, settings=settings, outcome=outcome)
