"""Search for the quantiser: its step, its dead zone and its reconstruction."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fhash_codec.compact.goal import (
    EXCHANGE,
    RATIO_SLACK,
    SLOPE,
    Goal,
    PsnrSearch,
    SizeSearch,
    Slope,
    cheapest,
    exchange,
    search,
    step_after_gain,
)
from fhash_codec.compact.sample import Sample
from fhash_codec.compact.tiles import MIN_STEP_SHARE, Coding, Outcome
from fhash_formats.errors import InputError
from fhash_formats.transform.tile import (
    OFFSETS,
    TRELLIS_WEIGHT,
    WEIGHT,
    plain_step,
    with_trellis,
)
from fhash_formats.transform.tile_format import TileSettings


def octave_gain(tried: Sequence[Outcome], data_range: float) -> float:
    """Return the dB that an octave of bytes buys, by outcomes of one coding at several steps.

    data_range: range of the values, in data units.
    """
    points = [
        (math.log2(outcome.size), outcome.psnr(data_range)) for outcome in tried if outcome.size
    ]
    return exchange(points, EXCHANGE)


MIN_EFFORT = 2
"""Least effort that uses the trellis."""


def allows_trellis(settings: TileSettings, goal: Goal, effort: int) -> bool:
    """Whether the trellis may be used.

    Values that are exact after all have no use for it. Steps so fine that they need float64 come
    near the finest step there is, with which the plain quantiser errs less.
    """
    exact = goal.error == 0 or goal.data_range <= 0
    return effort >= MIN_EFFORT and not exact and not settings.double


def on_trellis(settings: TileSettings, coding: Coding) -> tuple[TileSettings, Coding]:
    """Return settings and coding with the trellis, at about the same error."""
    return with_trellis(settings), replace(coding, weight=TRELLIS_WEIGHT)


def off_trellis(settings: TileSettings, coding: Coding) -> tuple[TileSettings, Coding]:
    """Return settings and coding with the plain quantiser, at about the same error."""
    settings = replace(settings, trellis=False, step=plain_step(settings), offsets=OFFSETS)
    return settings, replace(coding, weight=WEIGHT)


def step_after(settings: TileSettings, outcome: Outcome, goal: Goal, slope: float = SLOPE) -> float:
    """Return the step at which a promised PSNR should be reached, by one outcome of the settings.

    For other promises it is the step of the settings. slope: dB per factor of e.
    """
    psnr = outcome.psnr(goal.data_range)
    if goal.psnr is None or not math.isfinite(psnr):
        return settings.step
    gain = min(max(psnr - goal.psnr, -SLOPE), SLOPE)
    return step_after_gain(settings.step, gain * SLOPE / slope)


MAX_STEP_SHARE = 16.0
"""Largest step as a multiple of the value range: with a larger one nothing at all is coded."""


@dataclass(frozen=True)
class Precision:
    """Distance in dB to which a search for the step comes near a promised PSNR.

    Attributes:
        aim: above the PSNR asked for: all tiles should not fall short again.
        close: distance from that aim at which a search ends.
        slope: what the search begins with, and what it finds; None for the usual one.
    """

    aim: float
    close: float
    slope: Slope | None = None


EXACT = Precision(0.005, 0.004)
"""Precision of the last search."""
QUICK = Precision(0.013, 0.012)
"""The same where seconds count more than the 0.1 % of the bytes that this may cost."""
NEAR = Precision(0.005, 0.03)
"""Precision before a head is tried: candidates are compared at equal quality, and the step is
searched once more for the best."""
STEPS_TO_OCTAVE = 3
"""Steps per octave that are tried under a strict bound."""
MAX_STEP_NUMBER = 15
"""Number of the largest step tried under a strict bound; step 0 is the bound itself."""
FINEST_PSNR = 167.0
"""PSNR in dB of errors spread evenly over the finest step: 20 log10(sqrt(12) / MIN_STEP_SHARE)."""
OUT_OF_REACH = 1.0
"""dB that the finest step must miss before a promise is called out of reach: a sample may err."""
MIN_SIZE_SHARE = 0.8
"""Share of the bytes that are no values below which a file cannot be: they are known roughly."""
SLACK = 1e-6
"""Share of twice the bound by which the residual's quantum is smaller, rounding not included."""
MAX_ROUNDING_SLACK = 0.1
"""Largest such share for rounding: it does not help a bound near the precision of the type."""
MIN_STEP = 1e-153
"""Smallest step: its square is above 0. Ranges that need a smaller one are coded exactly."""
DOUBLE_STEPS = 2.0**20
"""Number of steps in the range above which float32 is not precise enough."""


def with_step(
    settings: TileSettings, step: float, goal: Goal, rounding: float = 0.0
) -> TileSettings:
    """Return settings with a step, and the working type and residual quantum that go with it.

    rounding: largest relative rounding error of the type that values are decoded to.
    """
    data_range = settings.high - settings.low
    largest = max(abs(settings.low), abs(settings.high))
    # Integers beyond 2^30 cannot be coded. In a constant series the step only has to be small
    # enough for the centre, a float32.
    constant_step = largest * 2.0**-30 if data_range == 0 else 0.0
    step = max(step, data_range * MIN_STEP_SHARE, constant_step, MIN_STEP)
    double = (
        data_range / step > DOUBLE_STEPS
        or largest > step * DOUBLE_STEPS
        or largest > 1e37
        or step < 1e-30
    )
    # An error of half a quantum, plus the rounding to the type of the source, must still keep the
    # bound: otherwise the whole tile is stored exactly.
    quantum = 0.0
    if goal.error:
        slack = min(rounding * largest / goal.error, MAX_ROUNDING_SLACK)
        quantum = 2 * goal.error * (1 - SLACK - slack)
    # A residual takes values beyond the range, and so does the rounding of its ends.
    working = float if double else np.float32
    beyond = quantum > 0 or any(float(working(end)) != end for end in (settings.low, settings.high))
    return replace(settings, step=step, double=double, quantum=quantum, clip=beyond)


def psnr_search(settings: TileSettings, slope: float = SLOPE) -> PsnrSearch:
    """Begin a search for the step of a PSNR within the steps that the settings allow."""
    data_range = settings.high - settings.low
    return PsnrSearch(data_range * MIN_STEP_SHARE, data_range * MAX_STEP_SHARE, slope)


def require_reach(goal: Goal, settings: TileSettings, outcome: Outcome) -> None:
    """Raise InputError where the finest step leaves a PSNR far below what is promised.

    outcome: of the settings, on a sample or on all tiles.
    """
    finest = (settings.high - settings.low) * MIN_STEP_SHARE
    if goal.psnr is None or goal.data_range == 0 or settings.step > finest * (1 + 1e-9):
        return
    if goal.psnr > FINEST_PSNR and outcome.psnr(goal.data_range) < goal.psnr - OUT_OF_REACH:
        raise InputError(
            f"the promised PSNR is out of reach: {goal.psnr:.4g} dB over the whole range are "
            f"needed, and the finest step of the quantiser gives about {FINEST_PSNR:.4g} dB at "
            "most; --max-error 0 stores every value exactly"
        )


def find_step(
    sample: Sample,
    settings: TileSettings,
    coding: Coding,
    goal: Goal,
    *,
    tries: int = 5,
    tried: list[Outcome] | None = None,
    precision: Precision = EXACT,
) -> tuple[TileSettings, Outcome]:
    """Return settings with the step that keeps the promise on the sample, and their outcome.

    Of the steps that keep a strict bound, it is the one that costs least.

    tries: number of trials for a PSNR; the other searches derive theirs from it.
    tried: list to which a search for a PSNR appends all its outcomes.
    precision: of a search for a PSNR.

    Raises InputError for a ratio that is out of reach.
    """
    if goal.psnr is not None:
        if goal.data_range == 0:
            return settings, sample.run(settings, coding)
        outcomes = [] if tried is None else tried
        return _step_for_psnr(sample, settings, coding, goal, tries, outcomes, precision)
    if goal.error is not None:
        if goal.error == 0:
            return settings, sample.run(settings, replace(coding, error=0.0))
        return _step_for_bound(sample, settings, coding, goal, goal.error, quick=tries <= 2)
    assert goal.size is not None
    if goal.size < MIN_SIZE_SHARE * goal.overhead:
        raise InputError(
            f"the ratio is out of reach: it leaves {goal.size:.0f} bytes for the file, and all but "
            f"the values take about {goal.overhead} already; ask for a smaller ratio"
        )
    size = max(goal.size / math.sqrt(RATIO_SLACK) - goal.overhead, 1.0)
    return _step_for_size(sample, settings, coding, size, goal.data_range, tries)


def _step_for_psnr(
    sample: Sample,
    settings: TileSettings,
    coding: Coding,
    goal: Goal,
    tries: int,
    tried: list[Outcome],
    precision: Precision,
) -> tuple[TileSettings, Outcome]:
    """Search for the step of the PSNR of a goal; the trial nearest to it."""
    assert goal.psnr is not None
    target, slope = goal.psnr + precision.aim, precision.slope
    secants = psnr_search(settings, SLOPE if slope is None else slope.slope)

    def run(settings: TileSettings) -> tuple[TileSettings, Outcome]:
        tried.append(sample.run(settings, coding))
        if slope is not None:
            slope.note(settings.step, tried[-1].psnr(goal.data_range))
        return settings, tried[-1]

    def following(trial: tuple[TileSettings, Outcome], _number: int) -> TileSettings | None:
        reached = trial[1].psnr(goal.data_range)
        if abs(reached - target) < precision.close or math.isinf(reached):
            return None
        return replace(trial[0], step=secants.after(trial[0].step, reached, target))

    def missed(trial: tuple[TileSettings, Outcome]) -> float:
        return abs(trial[1].psnr(goal.data_range) - target)

    if slope is not None:
        slope.restart()
    return search(
        run(settings), following, run, tries - 1, lambda new, best: missed(new) < missed(best)
    )


def _step_for_bound(
    sample: Sample, settings: TileSettings, coding: Coding, goal: Goal, error: float, *, quick: bool
) -> tuple[TileSettings, Outcome]:
    """Search for the step at which coefficients and residual together cost least."""
    dtype = sample.blocks.dtype
    rounding = float(np.finfo(dtype).eps) / 2 if dtype.kind == "f" else 0.0
    plain = plain_step(settings)
    share = settings.step / plain

    def settings_of(number: int) -> TileSettings | None:
        step = error * 2 ** (number / STEPS_TO_OCTAVE) * share
        stepped = with_step(replace(settings, head=None), step, goal, rounding)
        if settings.head is None:
            return stepped
        # A head works in float32 only.
        return None if stepped.double else replace(stepped, head=settings.head)

    def run(numbers: Sequence[int]) -> list[tuple[float, tuple[TileSettings, Outcome]] | None]:
        trials = [settings_of(number) for number in numbers]
        bounded = replace(coding, error=error)
        outcomes = iter(sample.run_all([(trial, bounded) for trial in trials if trial is not None]))
        return [
            None if trial is None else ((outcome := next(outcomes)).size, (trial, outcome))
            for trial in trials
        ]

    # Rounded up: with a head, a smaller step could need float64.
    number = math.ceil(STEPS_TO_OCTAVE * math.log2(plain / error) - 1e-6)
    start = min(max(number, 0), MAX_STEP_NUMBER)
    return cheapest(run, start, MAX_STEP_NUMBER, strides=(2,) if quick else (2, 1))


def _step_for_size(
    sample: Sample,
    settings: TileSettings,
    coding: Coding,
    size: float,
    data_range: float,
    tries: int,
) -> tuple[TileSettings, Outcome]:
    """Search for the step at which the tiles take a number of bytes."""
    if data_range == 0:
        return settings, sample.run(settings, coding)
    steps = SizeSearch(max(data_range, 1e-300), (2.0**-24, 4.0), size, drifts=True)

    def run(log_step: float) -> tuple[float, TileSettings, Outcome]:
        stepped = replace(settings, step=math.exp(log_step))
        return log_step, stepped, sample.run(stepped, coding)

    def following(trial: tuple[float, TileSettings, Outcome], _number: int) -> float | None:
        log_step, _, outcome = trial
        if abs(outcome.size - size) < 0.005 * size:
            return None
        following_step = steps.after(log_step, outcome.size, too_fine=outcome.size > size)
        return None if steps.is_flat else following_step

    return search(run(steps.inside(math.log(settings.step))), following, run, 2 * tries + 1)[1:]
