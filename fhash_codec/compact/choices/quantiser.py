"""Choice of the quantiser: plain, or two in turn on a trellis (dependent quantisation).

Transforms, tiles and fill values are chosen with the plain quantiser, which is as good for that.
Then the trellis takes its place, with a step at which it errs about as much.
"""

from __future__ import annotations

from dataclasses import replace

from fhash_codec.compact.goal import Goal
from fhash_codec.compact.tiles.coding import OFFSETS, WEIGHT, Coding
from fhash_formats.transform.tile.settings import TileSettings

__all__ = ["MIN_EFFORT", "SHARE", "allows_trellis", "off_trellis", "on_trellis", "plain_step"]

MIN_EFFORT = 2
"""Least effort that uses the trellis."""
SHARE = 0.65
"""Step on the trellis as a share of the plain quantiser's of about the same error and bytes."""
TRELLIS_WEIGHT = 0.27
"""Squared steps on the trellis that a bit is worth (0.25 to 0.3 are alike in experiments)."""
TRELLIS_OFFSETS = (17, -10, -5, -3, -2, -1)
"""Shift, in 1/128 step, of the magnitudes 1 to 4, odd ones from 5 on, and even ones from 6 on.

It is the mean over coefficients of many series, which differ by 3 or less.
"""


def allows_trellis(settings: TileSettings, goal: Goal, effort: int) -> bool:
    """Whether the trellis may be used.

    Values that are exact after all have no use for it. Steps so fine that they need float64 come
    near the finest step there is, with which the plain quantiser errs less.
    """
    exact = goal.error == 0 or goal.data_range <= 0
    return effort >= MIN_EFFORT and not exact and not settings.double


def on_trellis(settings: TileSettings, coding: Coding) -> tuple[TileSettings, Coding]:
    """Return settings and coding with the trellis, at about the same error."""
    coder = "signs" if settings.coder == "contexts" else settings.coder
    step = settings.step * SHARE
    settings = replace(settings, trellis=True, coder=coder, step=step, offsets=TRELLIS_OFFSETS)
    return settings, replace(coding, weight=TRELLIS_WEIGHT)


def off_trellis(settings: TileSettings, coding: Coding) -> tuple[TileSettings, Coding]:
    """Return settings and coding with the plain quantiser, at about the same error."""
    settings = replace(settings, trellis=False, step=plain_step(settings), offsets=OFFSETS)
    return settings, replace(coding, weight=WEIGHT)


def plain_step(settings: TileSettings) -> float:
    """Return the step with which the plain quantiser errs about as much, in units of the values."""
    return settings.step / SHARE if settings.trellis else settings.step
