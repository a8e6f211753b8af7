"""Where a search looks next: for a PSNR, for a number of bytes, for the step that is cheapest under a strict bound."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

Result = TypeVar("Result")

FLATTEST, STEEPEST = 2.0, 12.0
"""dB that a step larger by a factor of e is believed to cost at the least and at the most."""
MIN_APART = 1e-9
"""Of two steps (their logarithms) from which a slope is taken."""
EXCHANGE = 4.5
"""dB that an octave of bytes buys, where no search says it better."""
MIN_LOSS = 0.02
"""dB between two outcomes from which their exchange rate is taken."""


def secant(points: Sequence[tuple[float, float]], target: float, slope: float) -> float:
    """The log step at which a PSNR (dB) should be reached, by the slope between the two last of the points (log step, PSNR).

    slope: dB by which the PSNR falls per unit of the log step, for a single point or two at one place.
    """
    log_step, reached = points[-1]
    if len(points) > 1 and abs(points[-2][0] - log_step) > MIN_APART:
        slope = min(
            max(-(reached - points[-2][1]) / (log_step - points[-2][0]), FLATTEST), STEEPEST
        )
    return log_step + (reached - target) / slope


def exchange(points: Sequence[tuple[float, float]], usual: float) -> float:
    """dB that one more octave of bytes buys, by the last points (log2 of the bytes, PSNR) that are some way apart; else `usual`."""
    for (size, psnr), (before, other) in zip(points[::-1], points[-2::-1], strict=False):
        if abs(psnr - other) >= MIN_LOSS and (psnr - other) * (size - before) > 0:
            return (psnr - other) / (size - before)
    return usual


def cheapest(
    run: Callable[[Sequence[int]], Sequence[tuple[float, Result] | None]],
    start: int,
    most: int,
    *,
    strides: Sequence[int],
) -> Result:
    """The result of the cheapest whole number from 0 to `most`: downhill from `start`, in strides that get smaller.

    run: cost and result at each of some numbers, None where there is none (never at `start`).
    """
    known: dict[int, tuple[float, Result] | None] = {}
    best = start

    def cost(number: int) -> float:
        found = known.get(number)
        return float("inf") if found is None else found[0]

    for stride in strides:
        while True:
            near = (best, best + stride, best - stride)
            new = [number for number in near if number not in known and 0 <= number <= most]
            known.update(zip(new, run(new), strict=True))
            nearest = min(near, key=cost)
            if nearest == best:
                break
            best = nearest
    found = known[best]
    assert found is not None
    return found[1]
