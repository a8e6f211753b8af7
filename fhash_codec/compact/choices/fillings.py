"""Choice of the fill values for vertices that do not count: the candidate of fewest bytes wins."""

from __future__ import annotations

from dataclasses import replace

from fhash_codec.compact.choices.search import EXCHANGE
from fhash_codec.compact.choices.step import find_step
from fhash_codec.compact.goal import Goal
from fhash_codec.compact.tiles.coding import Coding, Outcome
from fhash_codec.compact.tiles.sample import Sample
from fhash_formats.transform.tile.settings import TileSettings

__all__ = ["choose_filling"]

STEP_SHARES = (0.0, 0.25, 0.5, 1.0)
"""Quantiser steps tried for filling, as shares of the final step; 0 keeps the existing values."""
TRIAL_DENSITY = 2
"""Thoroughness (density) of the fillings that compete."""
TRIES = 3
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
        outcome = find_step(filled(share, TRIAL_DENSITY), settings, coding, goal, tries=TRIES)[1]
        return _cost(outcome, goal), share

    return filled(min(trial(share) for share in STEP_SHARES)[1], density)


def _cost(outcome: Outcome, goal: Goal) -> float:
    """Return the bytes at the PSNR of the goal, by the usual exchange rate of dB for bytes."""
    if goal.psnr is None or not outcome.size:
        return outcome.size
    missing = goal.psnr - outcome.psnr(goal.data_range)
    return float(outcome.size * 2 ** (missing / EXCHANGE))
