"""Which values shall stand where none count: found by several ways, of which the one that takes the fewest bytes is kept."""

from __future__ import annotations

from dataclasses import replace

from fhash_codec.compact.choices.search import EXCHANGE
from fhash_codec.compact.choices.step import solve
from fhash_codec.compact.goal import Goal
from fhash_codec.compact.tiles.coding import Coding, Outcome
from fhash_codec.compact.tiles.sample import Sample
from fhash_formats.transform.tile.settings import TileSettings

__all__ = ["race"]

PARTS = (0.0, 0.25, 0.5, 1.0)
"""Of the quantiser's step that is to come, the steps of the fillings; with 0 the values that are there stay."""
DENSITY, TRIES = 2, 3
"""Of the fillings that compete, and of the search for the step that makes them comparable."""


def race(
    sample: Sample, settings: TileSettings, coding: Coding, goal: Goal, density: int
) -> Sample:
    """The sample with the filling that takes the fewest bytes where the promise is kept, found with `density` (`fill`)."""

    def trial(part: float) -> tuple[float, float]:
        filled = sample.filled(
            replace(settings, step=settings.step * (part or 1.0)), DENSITY if part else 0
        )
        return _cost(solve(filled, settings, coding, goal, tries=TRIES)[1], goal), part

    part = min(trial(part) for part in PARTS)[1]
    return sample.filled(
        replace(settings, step=settings.step * (part or 1.0)), density if part else 0
    )


def _cost(outcome: Outcome, goal: Goal) -> float:
    """Bytes where the promise is kept, by what is left to it."""
    if goal.psnr is None or not outcome.size:
        return outcome.size
    return float(outcome.size * 2 ** ((goal.psnr - outcome.psnr(goal.data_range)) / EXCHANGE))
