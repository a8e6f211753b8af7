"""Ticks of a scale: round values with texts that tell them apart."""

from __future__ import annotations

import math

__all__ = ["ticks"]

STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)
"""Distances between ticks, as multiples of a power of ten."""


def ticks(low: float, high: float, count: int) -> list[tuple[float, str]]:
    """Choose round values from low to high, about `count` of them and at least one.

    Returns (value, text) in ascending order. An empty or infinite range has one tick, at `low`.
    """
    extent = high - low
    if not extent > 0 or not math.isfinite(extent):
        return [(low, f"{low:.6g}")]
    step = _round_step(extent / max(count, 1))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    values = [number * step for number in range(first, last + 1)]
    if not values:
        return [(low, f"{low:.6g}")]
    return [(value, text) for value, text in zip(values, _texts(values, step), strict=True)]


def _round_step(rough: float) -> float:
    """The smallest round distance that is not below a rough one, but for rounding."""
    power = 10.0 ** math.floor(math.log10(rough))
    return power * next(
        multiple
        for multiple in STEPS
        if multiple * power >= rough * (1 - 1e-9) or multiple == STEPS[-1]
    )


def _texts(values: list[float], step: float) -> list[str]:
    """Texts with as many decimals as the distance between the values needs."""
    largest = max(abs(value) for value in values) or step
    digits = math.floor(math.log10(step) + 1e-9)
    # A step of 2.5 needs one digit more than its power of ten.
    finer = 1 if abs(step / 10.0**digits - 2.5) < 1e-6 else 0
    if largest >= 1e6 or step < 1e-4:
        places = max(0, math.floor(math.log10(largest)) - digits + finer)
        return [f"{value:.{places}e}" if value else "0" for value in values]
    # Adding 0 turns -0.0 into 0.0.
    return [f"{value + 0.0:.{max(0, finer - digits)}f}" for value in values]
