"""Goals of an encode, the search for the coarsest setting that keeps one, and what is promised.

One loop goes from trial to trial (`search`). Where it goes, a PSNR says by secants of the log step
(`PsnrSearch`), a number of bytes by secants within a bracket (`SizeSearch`): on a sample by
`find_step`, on all tiles in encode.py. Under a bound the cheapest of a few steps is looked for
(`cheapest`). Searches know no codec; `find_step` codes a sample.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from fhash_codec.compact.sample import Sample
from fhash_codec.compact.tiles import MIN_STEP_SHARE, BulkPart, Coding, Outcome
from fhash_codec.config import DEFAULT_PSNR, DEFAULT_PSNR_BULK, PROMISES, EncodeConfig
from fhash_codec.measure.errors import is_wide, whole_psnr
from fhash_codec.measure.value_range import ValueRange
from fhash_formats.errors import InputError
from fhash_formats.transform.tile import (
    plain_step,
)
from fhash_formats.transform.tile_format import TileSettings

Result = TypeVar("Result")
State = TypeVar("State")

SLOPE = 5.5
"""dB by which the PSNR falls when the step grows by a factor of e: the first assumption."""
MIN_SLOPE = 2.0
"""Smallest such slope (dB per factor of e) that is believed."""
MAX_SLOPE = 12.0
"""Largest such slope (dB per factor of e) that is believed."""
MIN_APART = 1e-9
"""Smallest difference of two log steps from which a slope is taken."""
EXCHANGE = 4.5
"""dB that an octave of bytes buys, where no search says it better."""
USUAL_FALL = SLOPE / EXCHANGE
"""Octaves of bytes that a step larger by a factor of e saves: the first assumption."""


class PsnrSearch:
    """Search for the quantiser step at which a PSNR is reached, by secants of the log step."""

    def __init__(self, min_step: float, max_step: float) -> None:
        """Begin a search between two steps."""
        self._ends = min_step, max_step
        self._slope = SLOPE
        self._before: tuple[float, float] | None = None

    def after(self, step: float, psnr: float, target: float) -> float:
        """Take up a trial, the PSNR in dB of a step; return the step that should reach `target`."""
        log_step = math.log(step)
        if self._before is not None and abs(self._before[0] - log_step) > MIN_APART:
            fall = -(psnr - self._before[1]) / (log_step - self._before[0])
            if math.isfinite(fall):
                self._slope = min(max(fall, MIN_SLOPE), MAX_SLOPE)
        self._before = log_step, psnr
        low, high = map(math.log, self._ends)  # 0 where nothing but a first trial is made
        wanted = log_step + (psnr - target) / self._slope
        return math.exp(min(max(wanted, low), high))


def step_after_gain(step: float, gain: float) -> float:
    """Return the step whose PSNR is lower by `gain` dB than that of `step`, by the usual slope."""
    return step * math.exp(gain / SLOPE)


def search(
    result: Result,
    following: Callable[[Result, int], State | None],
    run: Callable[[State], Result],
    tries: int,
    prefers: Callable[[Result, Result], bool] = lambda result, best: True,
) -> Result:
    """Return the best result of trials, each of which says what is tried next.

    result: of the first trial.
    following: what is tried after a result, and after the number of trials before it; None to end.
    run: does a trial.
    tries: trials after the first one, at most.
    prefers: whether a result is better than the best one so far; by default the last one is.
    """
    best = result
    for number in range(tries):
        state = following(result, number)
        if state is None:
            break
        result = run(state)
        if prefers(result, best):
            best = result
    return best


@dataclass(frozen=True)
class Bracket:
    """An interval that holds the number looked for, narrowed by each trial."""

    low: float
    high: float

    def narrowed(self, tried: float, *, too_low: bool) -> Bracket:
        """Return the part of the interval above a number that was too low, or else below it."""
        if too_low:
            return replace(self, low=max(self.low, tried))
        return replace(self, high=min(self.high, tried))

    def inside(self, prediction: float) -> float:
        """Return a prediction that lies inside the interval, else the middle of the interval."""
        if self.low < prediction < self.high:
            return prediction
        return (self.low + self.high) / 2


FLAT_STEPS = 0.5
"""Difference of two log steps from which on their bytes say whether coarser ones save more."""
FLAT = 0.01
"""Share of the bytes that such a coarser step saves at least. Usually it saves a third; where it
does not, tiles are nearly empty, and what they take beside their values is too much."""


class SizeSearch:
    """Search for the quantiser step at which tiles take a number of bytes.

    The bytes are predicted to fall by a number of octaves for each factor of e of the step, which
    secants measure; a prediction stays inside the steps that are too fine and too coarse.
    """

    def __init__(
        self, data_range: float, shares: tuple[float, float], target: float, *, drifts: bool
    ) -> None:
        """Begin a search.

        data_range: of the values; above 0.
        shares: finest and coarsest step, as shares of this range.
        target: the number of bytes.
        drifts: whether a measured fall may be up to 3 times the one believed before, or else up to
            4 times the usual one.
        """
        low, high = (math.log(data_range * share) for share in shares)
        self._bracket = Bracket(low, high)
        self._target, self._drifts = target, drifts
        self._fall = USUAL_FALL
        self._before: tuple[float, int] | None = None
        self._coarsest: tuple[float, int] | None = None
        self.is_flat = False
        """Whether coarser steps have saved hardly any of the bytes, which are too many."""

    def inside(self, log_step: float) -> float:
        """Return the nearest log step within what the search allows."""
        return min(max(log_step, self._bracket.low), self._bracket.high)

    def after(self, log_step: float, size: int, *, too_fine: bool) -> float:
        """Take up a trial, and return the log step to try next.

        too_fine: whether these bytes are too many.
        """
        self._bracket = self._bracket.narrowed(log_step, too_low=too_fine)
        if too_fine and (self._coarsest is None or log_step > self._coarsest[0]):
            if self._coarsest is not None and log_step > self._coarsest[0] + FLAT_STEPS:
                self.is_flat = size > (1 - FLAT) * self._coarsest[1]
            self._coarsest = log_step, size
        if self._before is not None:
            log_step_before, size_before = self._before
            if (log_step_before - log_step) * (size - size_before) > 0:
                measured = math.log2(size / size_before) / (log_step_before - log_step)
                usual, times = (self._fall, 3) if self._drifts else (USUAL_FALL, 4)
                self._fall = min(max(measured, usual / times), usual * times)
        self._before = log_step, size
        octaves = math.log2(max(size, 1) / self._target)
        return self._bracket.inside(log_step + octaves / self._fall)


def cheapest(
    run: Callable[[Sequence[int]], Sequence[tuple[float, Result] | None]],
    start: int,
    last: int,
    *,
    strides: Sequence[int],
) -> Result:
    """Return the result of the cheapest whole number from 0 to `last`, by descent from `start`.

    run: returns cost and result at each of some numbers; None where there is none (never at
        `start`).
    strides: distances to the neighbours that are tried, one after the other.
    """
    trials: dict[int, tuple[float, Result] | None] = {}
    best = start

    def cost(number: int) -> float:
        trial = trials.get(number)
        return float("inf") if trial is None else trial[0]

    for stride in strides:
        while True:
            neighbours = (best, best + stride, best - stride)
            new = [number for number in neighbours if number not in trials and 0 <= number <= last]
            trials.update(zip(new, run(new), strict=True))
            cheapest_neighbour = min(neighbours, key=cost)
            if cheapest_neighbour == best:
                break
            best = cheapest_neighbour
    trial = trials[best]
    assert trial is not None
    return trial[1]


MAX_INTEGER_ERROR = 2.0**40
"""Bound on integers from which on a half more makes no difference."""
RATIO_SLACK = 1.05
"""Factor by which a file may be smaller than a promised ratio asks for, where a step allows it."""


@dataclass(frozen=True, kw_only=True)
class Goal:
    """The promise: exactly one of a PSNR, a bound and a size."""

    psnr: float | None = None
    """PSNR in dB that `Outcome.psnr` must reach: over the vertices that count, or what stands for
    a promise about the bulk alone."""
    error: float | None = None
    """Strict bound of the absolute error, in data units."""
    size: float | None = None
    """Size of the file in bytes."""
    lossless: bool = False
    """Whether the bound allows no error at all."""
    data_range: float
    """Range of the values of the series, in data units."""
    overhead: int = 0
    """Approximate bytes of the file that are no tiles."""
    bulk: BulkPart | None = None
    """Part of a promised PSNR that is about the bulk."""

    @property
    def even_psnr(self) -> float | None:
        """PSNR in dB that keeps the promise if errors are everywhere alike."""
        if self.psnr is None or self.bulk is None:
            return self.psnr
        return self.psnr + max(0.0, 10 * math.log10(self.bulk.weight))

    @property
    def expected_error(self) -> float:
        """Approximate root of the mean squared error, in data units, before anything is coded."""
        if self.even_psnr is not None:
            return float(self.data_range * 10 ** (-self.even_psnr / 20))
        return self.data_range / 100 if self.error is None else self.error / 2

    def aim(self, effort: int) -> float:
        """Return the PSNR in dB that a step is for."""
        assert self.psnr is not None
        return self.psnr + (AIM if effort > 1 else QUICK_AIM)

    def bounded(self, coding: Coding) -> Coding:
        """Return the coding under the bound, if one was promised."""
        return coding if self.error is None else replace(coding, error=self.error)


def goal_of(
    config: EncodeConfig,
    value_range: ValueRange,
    raw_bytes: int,
    overhead: int,
    bulk: ValueRange | None = None,
    *,
    integers: bool = False,
) -> Goal:
    """Return the promise of the settings; `EncodeConfig` allows one at most, or both PSNRs.

    raw_bytes: bytes of the series without compression.
    overhead: approximate bytes of the file that are no tiles.
    bulk: of the series, in data units; None if it has none.
    integers: whether the values are integers, so that their errors are as well.

    Raises InputError for a promise about a bulk that is not there.
    """
    goal = _goal_of(config, value_range, raw_bytes, bulk, integers=integers)
    return replace(goal, overhead=overhead)


def _goal_of(
    config: EncodeConfig,
    value_range: ValueRange,
    raw_bytes: int,
    bulk: ValueRange | None,
    *,
    integers: bool,
) -> Goal:
    data_range = value_range.high - value_range.low
    error = config.max_error
    if config.max_error_rel is not None:
        error = config.max_error_rel * data_range
    if error is not None and integers and error < MAX_INTEGER_ERROR:
        return integer_goal(error, data_range)
    if error is not None:
        return Goal(error=error, data_range=data_range, lossless=error == 0)
    if config.ratio is not None:
        return Goal(size=raw_bytes / config.ratio, data_range=data_range)
    promised = promise(config, value_range, bulk)
    psnr, psnr_bulk = promised.get("psnr"), promised.get("psnr_bulk")
    if psnr_bulk is None or bulk is None:
        return Goal(psnr=DEFAULT_PSNR if psnr is None else psnr, data_range=data_range)
    even = whole_psnr(psnr_bulk, bulk, data_range)
    if psnr is None:
        part = BulkPart(low=bulk.low, high=bulk.high, alone=True)
        return Goal(psnr=even, data_range=data_range, bulk=part)
    part = BulkPart(low=bulk.low, high=bulk.high, weight=10 ** ((even - psnr) / 10))
    return Goal(psnr=psnr, data_range=data_range, bulk=part)


def integer_goal(error: float, data_range: float) -> Goal:
    """Return the promise that integers are off by an error at most; below 1 they are exact."""
    # Before a decoded value is rounded to an integer, it may be off by half of one more.
    return Goal(error=math.floor(error) + 0.5, data_range=data_range, lossless=error < 1)


def promise(
    config: EncodeConfig, value_range: ValueRange | None = None, bulk: ValueRange | None = None
) -> dict[str, float]:
    """Return the promise of the settings by the names of its options.

    value_range: of the series, in data units; None if it is not known.
    bulk: of the series, in data units; None if it has none. Without a promise in the settings it
        is promised only if it is wide (`is_wide`): where nearly all values are nearly the same,
        it says nothing of the others, and would cost many times the bytes.

    Raises InputError for a promise about a bulk that is not there.
    """
    options = {name: getattr(config, name) for name in PROMISES}
    given = {name: value for name, value in options.items() if value is not None}
    varied = value_range is not None and value_range.low < value_range.high
    if "psnr_bulk" in given and bulk is None and varied:
        raise InputError(
            "psnr-bulk has nothing to measure: the middle 98 % of the values are all the same; "
            "promise --psnr, --max-error or --max-error-rel"
        )
    if given:
        return given
    if bulk is None or value_range is None or not is_wide(bulk, value_range):
        return {"psnr": DEFAULT_PSNR}
    return {"psnr": DEFAULT_PSNR, "psnr_bulk": DEFAULT_PSNR_BULK}


FAR_BELOW = 15.0
"""dB by which the PSNR of the bulk may be below that of the whole range without a remark."""

DECIDED = 0.3
"""dB by which a PSNR must exceed its promise, and the other one may, where that one decided."""


def missed_promise(
    config: EncodeConfig, figures: Mapping[str, Any], rounding: float = 0.0
) -> str | None:
    """Text on a promise that a file misses; None if it keeps what the settings promise.

    figures: of the file, as in `report`; `promised` has what its header says was promised.
    rounding: difference between values of two readers at most, as a share of the range.
    """
    promised, whole = figures["promised"], (figures["psnr"], figures["rmse"])
    return (
        _missed_bound(config, figures)
        or _missed_psnr(promised.get("psnr"), *whole, rounding, "the coreset")
        or _missed_bulk(promised.get("psnr_bulk"), figures, rounding)
        or _missed_ratio(config, figures)
    )


def held_psnr(psnr: float | None, rounding: float) -> float:
    """Return the PSNR in dB that every reader has at least, by that of one (None for no error).

    Root mean squares add up at most.

    rounding: as in `missed_promise`, of the range that the PSNR is relative to.
    """
    error = (0.0 if psnr is None else 10 ** (-psnr / 20)) + rounding
    return -20 * math.log10(error) if error else math.inf


def remarks(config: EncodeConfig, figures: Mapping[str, Any]) -> Iterator[str]:
    """Remarks on a file that keeps its promise, for the user, one line each.

    figures: of the file, as in `report`.
    """
    bulk = figures["quality"]["bulk"]
    psnr, psnr_bulk = figures["psnr"], figures["psnr_bulk"]
    plain = config.published and not config.coded
    if config.psnr_bulk is None and not plain and None not in (psnr, psnr_bulk):
        enough = min(DEFAULT_PSNR_BULK, psnr - FAR_BELOW)
        if psnr_bulk < enough:
            low, high = bulk["range"]
            yield (
                f"98 % of the values lie from {low:g} to {high:g}, and have {psnr_bulk:.1f} dB "
                f"within that range, beside {psnr:.1f} dB within the whole; "
                f"{_mending(config)} keeps them"
            )
    if config.ratio is not None and figures["ratio"] > config.ratio * RATIO_SLACK:
        why = (
            "its values are exact already"
            if figures["rmse"] == 0
            else "no step of the quantiser comes nearer"
        )
        yield (
            f"the file is {figures['ratio']:.4g} times smaller than the data, "
            f"{config.ratio:g} times were asked for: {why}"
        )


def decided_by_bulk(config: EncodeConfig, figures: Mapping[str, Any]) -> str | None:
    """Text on a file that is larger for its bulk's sake; None where that did not decide.

    figures: of the file, as in `report`.
    """
    given = [name for name in PROMISES if getattr(config, name) is not None]
    psnr, psnr_bulk = figures["psnr"], figures["psnr_bulk"]
    if config.published or None in (psnr, psnr_bulk):
        return None
    if given not in ([], ["psnr", "psnr_bulk"]):
        return None
    whole = DEFAULT_PSNR if config.psnr is None else config.psnr
    bulk = DEFAULT_PSNR_BULK if config.psnr_bulk is None else config.psnr_bulk
    if psnr < whole + DECIDED or psnr_bulk > bulk + DECIDED:
        return None
    low, high = figures["quality"]["bulk"]["range"]
    share = 1 - 2 ** (-(psnr - whole) / EXCHANGE)
    return (
        f"the bulk decided: {bulk:g} dB within it, from {low:g} to {high:g}, took {psnr:.1f} dB "
        f"over all values, where {whole:g} are promised; that is about {share:.0%} of the file, "
        f"and --psnr {whole:g} alone leaves it out"
    )


def _mending(config: EncodeConfig) -> str:
    """The option that keeps the bulk, beside the promise or in its place."""
    option = f"--psnr-bulk {DEFAULT_PSNR_BULK:g}"
    given = [name for name in PROMISES if getattr(config, name) is not None]
    if not given:
        return option
    name = given[0]
    relation = "beside" if name == "psnr" else "instead of"
    return f"{option} {relation} --{name.replace('_', '-')}"


def _missed_bound(config: EncodeConfig, figures: Mapping[str, Any]) -> str | None:
    """Text on an error beyond the promised bound; None if there is no such promise or it holds."""
    bound = math.inf
    if config.max_error is not None:
        bound = config.max_error
    elif config.max_error_rel is not None:
        bound = config.max_error_rel * figures["data_range"]
    largest = figures["max_abs_error"]
    if largest is not None and largest > bound:
        return f"a largest error of {largest:g}, at most {bound:g} was asked for"
    return None


def _missed_psnr(
    promised: float | None, psnr: float | None, rmse: float | None, rounding: float, where: str
) -> str | None:
    """Text on a PSNR below the promised one; None if there is no such promise or it holds."""
    if promised is None:
        return None
    if psnr is None and rmse != 0:
        return f"an unknown PSNR over {where}, {promised:g} dB were asked for"
    held = held_psnr(psnr, rounding)
    if held >= promised:
        return None
    if psnr is None or psnr >= promised:
        return (
            f"{held:.2f} dB over {where} in every reader, since float32 rounds otherwise in each, "
            f"{promised:g} dB were asked for"
        )
    return f"{psnr:.2f} dB over {where}, {promised:g} dB were asked for"


def _missed_bulk(promised: float | None, figures: Mapping[str, Any], rounding: float) -> str | None:
    """Text on a PSNR of the bulk below the promised one; None if there is none or it holds."""
    bulk = figures["quality"]["bulk"]
    if promised is None or (bulk is None and figures["rmse"] == 0):
        return None
    if bulk is None:
        return (
            "the middle 98 % of the values are all the same, and have no PSNR, "
            f"{promised:g} dB were asked for"
        )
    low, high = bulk["range"]
    rounding = rounding * figures["data_range"] / (high - low) if rounding else 0.0
    return _missed_psnr(promised, bulk["psnr"], bulk["rmse"], rounding, "the bulk")


def _missed_ratio(config: EncodeConfig, figures: Mapping[str, Any]) -> str | None:
    """Text on a file that is too large for the promised ratio; None if it is not."""
    if config.ratio is None or figures["ratio"] >= config.ratio:
        return None
    return f"{figures['ratio']:.4g} times smaller than the data, {config.ratio:g} were asked for"


def step_after(settings: TileSettings, outcome: Outcome, goal: Goal) -> float:
    """Return the step at which a promised PSNR should be reached, by one outcome of the settings.

    For other promises it is the step of the settings.
    """
    psnr = outcome.psnr(goal.data_range)
    if goal.psnr is None or not math.isfinite(psnr):
        return settings.step
    gain = min(max(psnr - goal.psnr, -SLOPE), SLOPE)
    return step_after_gain(settings.step, gain)


MAX_STEP_SHARE = 16.0
"""Largest step as a multiple of the value range: with a larger one nothing at all is coded."""


AIM = 0.02
"""dB above a promised PSNR that a step is for: all tiles are coded again where they fall short."""
QUICK_AIM = 0.1
"""The same at effort 1, whose parts tell less: a second coding takes a third of its seconds."""
STEP_AIM = 0.005
"""dB above a promised PSNR that a search on a sample is for: all tiles should keep it, too."""
CLOSE = 0.004
"""Distance in dB from that aim at which such a search ends."""
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


def psnr_search(settings: TileSettings) -> PsnrSearch:
    """Begin a search for the step of a PSNR within the steps that the settings allow."""
    data_range = settings.high - settings.low
    return PsnrSearch(data_range * MIN_STEP_SHARE, data_range * MAX_STEP_SHARE)


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
    tries: int,
) -> tuple[TileSettings, Outcome]:
    """Return settings with the step that keeps the promise on the sample, and their outcome.

    Of the steps that keep a strict bound, it is the one that costs least.

    tries: number of trials for a PSNR; the other searches derive theirs from it.

    Raises InputError for a ratio that is out of reach.
    """
    if goal.psnr is not None:
        if goal.data_range == 0:
            return settings, sample.run(settings, coding)
        return _step_for_psnr(sample, settings, coding, goal, tries)
    if goal.error is not None:
        if goal.error == 0:
            return settings, sample.run(settings, replace(coding, error=0.0))
        return _step_for_bound(sample, settings, coding, goal, goal.error)
    assert goal.size is not None
    if goal.size < MIN_SIZE_SHARE * goal.overhead:
        raise InputError(
            f"the ratio is out of reach: it leaves {goal.size:.0f} bytes for the file, and all but "
            f"the values take about {goal.overhead} already; ask for a smaller ratio"
        )
    size = max(goal.size / math.sqrt(RATIO_SLACK) - goal.overhead, 1.0)
    return _step_for_size(sample, settings, coding, size, goal.data_range, tries)


def _step_for_psnr(
    sample: Sample, settings: TileSettings, coding: Coding, goal: Goal, tries: int
) -> tuple[TileSettings, Outcome]:
    """Search for the step of the PSNR of a goal; the trial nearest to it."""
    assert goal.psnr is not None
    target, secants = goal.psnr + STEP_AIM, psnr_search(settings)

    def run(settings: TileSettings) -> tuple[TileSettings, Outcome]:
        return settings, sample.run(settings, coding)

    def following(trial: tuple[TileSettings, Outcome], _number: int) -> TileSettings | None:
        reached = trial[1].psnr(goal.data_range)
        if abs(reached - target) < CLOSE or math.isinf(reached):
            return None
        return replace(trial[0], step=secants.after(trial[0].step, reached, target))

    def missed(trial: tuple[TileSettings, Outcome]) -> float:
        return abs(trial[1].psnr(goal.data_range) - target)

    return search(
        run(settings), following, run, tries - 1, lambda new, best: missed(new) < missed(best)
    )


def _step_for_bound(
    sample: Sample, settings: TileSettings, coding: Coding, goal: Goal, error: float
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
    return cheapest(run, start, MAX_STEP_NUMBER, strides=(5, 2, 1))


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
