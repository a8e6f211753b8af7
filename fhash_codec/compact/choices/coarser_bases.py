"""Choice of coarser bases of the data's own, once the final step and the head are known.

The bases were made for the step before there was a head. Coarser ones take fewer bytes, and in a
small file they are a fifth of it; a head also corrects what they leave.
"""

from __future__ import annotations

from fhash_codec.compact.choices.octave import octave_gain
from fhash_codec.compact.choices.step import find_step
from fhash_codec.compact.choices.transform import basis_bytes, refit
from fhash_codec.compact.goal import Goal
from fhash_codec.compact.tiles.coding import Coding, Outcome
from fhash_codec.compact.tiles.sample import Sample
from fhash_codec.stage_clock import skip, stage
from fhash_formats.transform.tile.settings import TileSettings

__all__ = ["coarser_bases"]

FACTORS = (1.5, 2.2)
"""Factors of the final step for which bases are tried, until one does not pay."""
LEAST = 0.01
"""Share of tiles and bases that the bases must take, so that coarser ones are tried."""
TRIES = 4
"""Trials of a step for each of them."""


def coarser_bases(
    sample: Sample, settings: TileSettings, outcome: Outcome, coding: Coding, goal: Goal
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
