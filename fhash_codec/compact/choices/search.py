"""Searches for a quantiser step and other numbers. They know no codec: callers do the trials.

Three searches share these tools, and differ in how they predict the next trial:

- A PSNR (choices/step.py on a sample, tiles_to_promise.py on all tiles): `PsnrSearch`, a secant of
  the PSNR over the logarithm of the step.
- A number of bytes (choices/step.py): a `Bracket` of logarithms of steps; the bytes are predicted
  to fall by a number of octaves per unit.
- An error of trained tables (paper/tables/step.py): a `Bracket` of steps; the squared error is
  predicted to grow as the square of the step.

bench/rate/search.py shares no arithmetic with them: it looks for the smallest file that any codec
makes at a given quality, among all its trials, and interpolates between the two levels around it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

Result = TypeVar("Result")

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
MIN_LOSS = 0.02
"""Smallest difference in dB of two outcomes from which their exchange rate is taken."""


def secant(points: Sequence[tuple[float, float]], target: float, slope: float) -> float:
    """Return the log step at which a PSNR should be reached, by the last two points.

    points: pairs (log step, PSNR in dB) that were tried, at least one.
    target: the PSNR in dB.
    slope: dB by which the PSNR falls per unit of the log step, for a single point or two points
        at one place.
    """
    log_step, psnr = points[-1]
    if len(points) > 1 and abs(points[-2][0] - log_step) > MIN_APART:
        slope = min(max(-(psnr - points[-2][1]) / (log_step - points[-2][0]), MIN_SLOPE), MAX_SLOPE)
    return log_step + (psnr - target) / slope


class PsnrSearch:
    """Search for the quantiser step at which a PSNR is reached, by secants of the log step."""

    def __init__(self, min_step: float, max_step: float) -> None:
        """Begin a search between two steps."""
        self._min_step, self._max_step = min_step, max_step
        self._points: list[tuple[float, float]] = []

    def add(self, step: float, psnr: float) -> None:
        """Take up a trial: a step and the PSNR in dB that it gave."""
        self._points.append((math.log(step), psnr))

    def step_for(self, psnr: float) -> float:
        """Return the step at which a PSNR should be reached; needs at least one trial."""
        log_step = secant(self._points, psnr, SLOPE)
        low, high = math.log(self._min_step), math.log(self._max_step)
        return math.exp(min(max(log_step, low), high))


def step_after_gain(step: float, gain: float) -> float:
    """Return the step whose PSNR is lower by `gain` dB than that of `step`, by the usual slope."""
    return step * math.exp(gain / SLOPE)


def arithmetic_mean(low: float, high: float) -> float:
    """Return the middle of an interval of logarithms."""
    return (low + high) / 2


def geometric_mean(low: float, high: float) -> float:
    """Return the middle of an interval of positive numbers on a logarithmic scale."""
    return math.sqrt(low * high)


@dataclass(frozen=True)
class Bracket:
    """An interval that holds the number looked for, narrowed by each trial."""

    low: float
    high: float
    middle: Callable[[float, float], float]
    """Mean of the two ends that a bisection goes on with."""

    def narrowed(self, tried: float, *, too_low: bool) -> Bracket:
        """Return the part of the interval above a number that was too low, or else below it."""
        if too_low:
            return replace(self, low=max(self.low, tried))
        return replace(self, high=min(self.high, tried))

    def inside(self, prediction: float) -> float:
        """Return a prediction that lies inside the interval, else the middle of the interval."""
        if self.low < prediction < self.high:
            return prediction
        return self.middle(self.low, self.high)


def exchange(points: Sequence[tuple[float, float]], usual: float) -> float:
    """Return the dB that one more octave of bytes buys, by the last points some way apart.

    points: pairs (log2 of the bytes, PSNR in dB) in the order of their trials.
    usual: the result where no two successive points are apart.
    """
    for (size, psnr), (size_before, psnr_before) in zip(points[::-1], points[-2::-1], strict=False):
        gain = psnr - psnr_before
        if abs(gain) >= MIN_LOSS and gain * (size - size_before) > 0:
            return gain / (size - size_before)
    return usual


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
