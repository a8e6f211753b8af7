"""Choice of the quantiser: plain, or two in turn on a trellis (dependent quantisation).

Transforms, tiles and fill values are chosen with the plain quantiser, which is as good for that.
Then the trellis takes its place where it makes the sample smaller at the same quality. It does so
for most series. It does not for few coefficients, whose statistics it splits in two, nor where
neighbours foretell the signs, which then are less regular.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from fhash_codec.compact.choices.octave import octave_gain
from fhash_codec.compact.choices.search import SLOPE, step_after_gain
from fhash_codec.compact.goal import Goal
from fhash_codec.compact.tiles.coding import Coding, Outcome
from fhash_codec.compact.tiles.sample import Sample
from fhash_formats.transform.tile.integers import (
    OFFSETS,
    SHARE,
    TRELLIS_WEIGHT,
    WEIGHT,
    with_trellis,
)
from fhash_formats.transform.tile.settings import TileSettings

__all__ = [
    "allows_trellis",
    "choose_quantiser",
    "is_smaller",
    "off_trellis",
    "on_trellis",
    "plain_step",
    "step_after",
]

MIN_EFFORT = 2
"""Least effort that uses the trellis."""


def allows_trellis(settings: TileSettings, goal: Goal, effort: int) -> bool:
    """Whether the trellis may be used.

    Values that are exact after all have no use for it. Steps so fine that they need float64 come
    near the finest step there is, with which the plain quantiser errs less.
    """
    exact = goal.error == 0 or goal.data_range <= 0
    return effort >= MIN_EFFORT and not exact and not settings.double


def choose_quantiser(
    sample: Sample, settings: TileSettings, coding: Coding, goal: Goal
) -> tuple[TileSettings, Coding, Outcome]:
    """Return settings and coding with the trellis if that makes a sample smaller, and the outcome.

    Otherwise those with the plain quantiser are returned. Either have a better step: the trial of
    the plain quantiser tells where the search for the step begins.
    """
    plain = sample.run(settings, goal.bounded(coding))
    settings = replace(settings, step=step_after(settings, plain, goal))
    other, other_coding = on_trellis(settings, coding)
    outcome = sample.run(other, goal.bounded(other_coding))
    tried = [outcome]
    if goal.psnr is not None:
        other = replace(other, step=step_after(other, outcome, goal))
        outcome = sample.run(other, other_coding)
        tried.append(outcome)
    if is_smaller(outcome, plain, tried, goal):
        return other, other_coding, outcome
    return settings, coding, plain


def on_trellis(settings: TileSettings, coding: Coding) -> tuple[TileSettings, Coding]:
    """Return settings and coding with the trellis, at about the same error."""
    return with_trellis(settings), replace(coding, weight=TRELLIS_WEIGHT)


def off_trellis(settings: TileSettings, coding: Coding) -> tuple[TileSettings, Coding]:
    """Return settings and coding with the plain quantiser, at about the same error."""
    settings = replace(settings, trellis=False, step=plain_step(settings), offsets=OFFSETS)
    return settings, replace(coding, weight=WEIGHT)


def plain_step(settings: TileSettings) -> float:
    """Return the step with which the plain quantiser errs about as much, in units of the values."""
    return settings.step / SHARE if settings.trellis else settings.step


def step_after(settings: TileSettings, outcome: Outcome, goal: Goal) -> float:
    """Return the step at which a promised PSNR should be reached, by one outcome of the settings.

    For other promises it is the step of the settings.
    """
    psnr = outcome.psnr(goal.data_range)
    if goal.psnr is None or not math.isfinite(psnr):
        return settings.step
    return step_after_gain(settings.step, min(max(psnr - goal.psnr, -SLOPE), SLOPE))


def is_smaller(outcome: Outcome, plain: Outcome, tried: Sequence[Outcome], goal: Goal) -> bool:
    """Whether the trellis takes fewer bytes than the plain quantiser at the same quality.

    outcome: with the trellis.
    plain: with the plain quantiser, at about the same quality.
    tried: outcomes with the trellis at several steps, which tell what a difference is worth.
    """
    better = plain.psnr(goal.data_range) - outcome.psnr(goal.data_range)
    if goal.error is not None or not math.isfinite(better) or not plain.size:
        return outcome.size < plain.size
    return outcome.size < plain.size * 2 ** (-better / octave_gain(tried, goal.data_range))
