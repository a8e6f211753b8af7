"""The quantiser's step that keeps a promise on a sample, and what goes with it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fhash_codec.compact.choices.search import EXCHANGE, cheapest, secant
from fhash_codec.compact.goal import Goal
from fhash_codec.compact.tiles.coding import SMALLEST_STEP, Coding, Outcome
from fhash_codec.compact.tiles.sample import Sample
from fhash_formats.errors import InputError
from fhash_formats.transform.tile.settings import TileSettings

__all__ = ["SLOPE", "nearer", "solve", "with_step"]

SLOPE = 5.5
"""dB by which the PSNR falls when the step grows by a factor of e: to begin a search with."""
MAX_STEP = 16.0
"""Of the range: with a larger one no more than nothing is coded."""
AIM, CLOSE = 0.005, 0.004
"""dB above what was asked for that a search aims at, and from that aim at which it ends: all tiles should not fall short again."""
STEPS_TO_OCTAVE, MAX_OF_ERROR = 3, 15
"""Quantiser steps that may be tried under a strict bound: from the bound on in so many parts of an octave, and up to which."""
SLACK = 1e-6
"""The quantum of the residual is this part less than twice the bound, and less by the rounding of what is decoded."""
SLACK_OF_TYPE = 0.1
"""At most so much less for that rounding: a bound near the precision of the type is not helped by it."""
MIN_STEP = 1e-153
"""Its square is a number above 0. Ranges that would need a smaller one are coded exactly."""
DOUBLE_STEPS = 2.0**20
"""Steps in the range from which on float32 is not precise enough."""


def with_step(
    settings: TileSettings, step: float, goal: Goal, rounding: float = 0.0
) -> TileSettings:
    """The step, and the working type and residual that go with it. rounding: of the type that is decoded to, as a part of a value."""
    data_range = settings.high - settings.low
    largest = max(abs(settings.low), abs(settings.high))
    # Integers beyond 2^30 cannot be coded. In a constant series the step only has to be small enough for the centre, a float32.
    step = max(
        step, data_range * SMALLEST_STEP, largest * 2.0**-30 if data_range == 0 else 0.0, MIN_STEP
    )
    double = (
        data_range / step > DOUBLE_STEPS
        or largest > step * DOUBLE_STEPS
        or largest > 1e37
        or step < 1e-30
    )
    # Half a quantum off, and then rounded to the type of the source, must still keep the bound: if not, a whole tile is stored exactly.
    quantum = (
        0.0
        if not goal.error
        else 2 * goal.error * (1 - SLACK - min(rounding * largest / goal.error, SLACK_OF_TYPE))
    )
    return replace(settings, step=step, double=double, quantum=quantum)


def nearer(
    settings: TileSettings, points: Sequence[tuple[float, float]], psnr: float
) -> TileSettings:
    """The step at which a PSNR should be reached, from the points (log step, PSNR) that were tried, the last of them with `settings`."""
    smallest, largest = (
        math.log((settings.high - settings.low) * part) for part in (SMALLEST_STEP, MAX_STEP)
    )
    return replace(
        settings, step=math.exp(min(max(secant(points, psnr, SLOPE), smallest), largest))
    )


def solve(
    sample: Sample,
    settings: TileSettings,
    coding: Coding,
    goal: Goal,
    *,
    tries: int = 5,
    tried: list[Outcome] | None = None,
) -> tuple[TileSettings, Outcome]:
    """The step that keeps the promise on the sample, or for a bound the one that costs least; what it gives.

    tried: takes all outcomes on the way of the search for a PSNR. Raises InputError where a ratio cannot be had.
    """
    if goal.psnr is not None:
        if goal.data_range == 0:
            return settings, sample.run(settings, coding)
        return _solve_psnr(
            sample,
            settings,
            coding,
            goal.psnr,
            goal.data_range,
            tries,
            [] if tried is None else tried,
        )
    if goal.error is not None:
        if goal.error == 0:
            return settings, sample.run(settings, replace(coding, error=0.0))
        return _solve_bound(sample, settings, coding, goal, goal.error, quick=tries <= 2)
    assert goal.size is not None
    return _solve_size(sample, settings, coding, goal.size - goal.overhead, goal.data_range, tries)


def _solve_psnr(
    sample: Sample,
    settings: TileSettings,
    coding: Coding,
    psnr: float,
    data_range: float,
    tries: int,
    tried: list[Outcome],
) -> tuple[TileSettings, Outcome]:
    psnr += AIM
    points: list[tuple[float, float]] = []
    best: tuple[float, TileSettings, Outcome] | None = None
    for _ in range(tries):
        if points:
            settings = nearer(settings, points, psnr)
        outcome = sample.run(settings, coding)
        tried.append(outcome)
        reached = outcome.psnr(data_range)
        if best is None or abs(reached - psnr) < abs(best[0] - psnr):
            best = (reached, settings, outcome)
        if abs(reached - psnr) < CLOSE or math.isinf(reached):
            break
        points.append((math.log(settings.step), reached))
    assert best is not None
    return best[1], best[2]


def _solve_bound(
    sample: Sample, settings: TileSettings, coding: Coding, goal: Goal, error: float, *, quick: bool
) -> tuple[TileSettings, Outcome]:
    """The step at which coefficients and residual together cost least."""
    rounding = (
        float(np.finfo(sample.blocks.dtype).eps) / 2 if sample.blocks.dtype.kind == "f" else 0.0
    )

    def trial(number: int) -> TileSettings | None:
        stepped = with_step(
            replace(settings, head=None), error * 2 ** (number / STEPS_TO_OCTAVE), goal, rounding
        )
        if settings.head is not None:
            return None if stepped.double else replace(stepped, head=settings.head)
        return stepped

    def run(numbers: Sequence[int]) -> list[tuple[float, tuple[TileSettings, Outcome]] | None]:
        trials = [trial(number) for number in numbers]
        outcomes = iter(
            sample.run_all(
                [(one, replace(coding, error=error)) for one in trials if one is not None]
            )
        )
        return [
            None if one is None else ((outcome := next(outcomes)).size, (one, outcome))
            for one in trials
        ]

    # Upwards: with a head, a smaller step could need float64.
    start = min(
        max(math.ceil(STEPS_TO_OCTAVE * math.log2(settings.step / error) - 1e-6), 0),
        MAX_OF_ERROR,
    )
    return cheapest(run, start, MAX_OF_ERROR, strides=(2,) if quick else (2, 1))


def _solve_size(
    sample: Sample,
    settings: TileSettings,
    coding: Coding,
    size: float,
    data_range: float,
    tries: int,
) -> tuple[TileSettings, Outcome]:
    """The step at which the tiles take so many bytes."""
    if size <= 0:
        raise InputError(
            "the ratio leaves no room for values: the rest of the file is larger already; ask for a smaller ratio"
        )
    if data_range == 0:
        return settings, sample.run(settings, coding)
    low, high = math.log(max(data_range, 1e-300) * 2.0**-24), math.log(max(data_range, 1e-300) * 4)
    log_step, fall = math.log(settings.step), SLOPE / EXCHANGE
    before: tuple[float, float] | None = None
    for _ in range(2 * tries + 2):
        log_step = min(max(log_step, low), high)
        settings = replace(settings, step=math.exp(log_step))
        outcome = sample.run(settings, coding)
        got = outcome.size
        if abs(got - size) < 0.005 * size:
            break
        low, high = (log_step, high) if got > size else (low, log_step)
        if before is not None and (before[0] - log_step) * (got - before[1]) > 0:
            # Octaves of bytes that a step larger by a factor of e saves, as it was from the last step to this one.
            fall = min(max(math.log2(got / before[1]) / (before[0] - log_step), fall / 3), fall * 3)
        before = log_step, got
        log_step += math.log2(got / size) / fall
        if not low < log_step < high:
            log_step = (low + high) / 2
    return settings, outcome
