"""Where streamed rays cross isosurfaces: between two samples one below and one above the value, found by the Illinois method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fhash_codec.render.task import Surface

__all__ = ["Crossings", "crossings"]

Floats = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int64]

CLOSE = 1e-8
"""Steps that a root moves at most in the last turn, and the width of what it lies within."""
MOST_TURNS = 60


@dataclass(frozen=True, kw_only=True, eq=False)
class Crossings:
    """Before each sample of a pass, as many places as there are surfaces, the nearest first.

    at: (rays, samples, surfaces), in samples of the ray. opacity: the same shape, 0 where there is no crossing. which: of the surfaces.
    """

    at: Floats
    opacity: Floats
    which: Numbers


def crossings(values: Callable[[Numbers, Floats], Floats], at: Floats, steps: Floats, surfaces: Sequence[Surface]) -> Crossings:
    """The crossings of a pass.

    values: of rows (n,) of the pass at places (n,) in samples. at, steps: places and values (rays, 1 + samples), those before the first
    sample included; NaN where there is no value.
    """
    shape = (len(at), at.shape[1] - 1, len(surfaces))
    places, opacity = np.full(shape, np.inf), np.zeros(shape)
    before, now = steps[:, :-1], steps[:, 1:]
    known = ~np.isnan(before) & ~np.isnan(now)
    for number, surface in enumerate(surfaces):
        row, column = np.nonzero(known & ((before < surface.value) != (now < surface.value)))
        if not row.size:
            continue

        def beyond(part: Numbers, place: Floats, row: Numbers = row, value: float = surface.value) -> Floats:
            return values(row[part], place) - value

        ends = before[row, column] - surface.value, now[row, column] - surface.value
        root = _roots(beyond, at[row, column], at[row, column + 1], *ends)
        found = np.isfinite(root)
        places[row[found], column[found], number] = root[found]
        opacity[row[found], column[found], number] = surface.opacity
    which = np.argsort(places, axis=2, kind="stable")
    places, opacity = (np.take_along_axis(part, which, axis=2) for part in (places, opacity))
    return Crossings(at=np.where(np.isfinite(places), places, 0.0), opacity=opacity, which=which)


def _roots(function: Callable[[Numbers, Floats], Floats], near: Floats, far: Floats, at_near: Floats, at_far: Floats) -> Floats:
    """Roots between places near and far, where a function of (numbers, places) has values of two signs; NaN where it has none."""
    near, far, at_near, at_far = (part.copy() for part in (near, far, at_near, at_far))
    root = np.where(at_far == 0, far, near)
    going = np.flatnonzero((at_near != 0) & (at_far != 0))
    for _ in range(MOST_TURNS):
        if not going.size:
            break
        place = far[going] - at_far[going] * (far[going] - near[going]) / (at_far[going] - at_near[going])
        found = function(going, place)
        root[going] = np.where(np.isnan(found), np.nan, place)
        same = (found < 0) == (at_far[going] < 0)
        moved = np.abs(place - far[going])
        # The end that stays twice has its value halved, so that the other one moves too.
        at_near[going] = np.where(same, at_near[going] / 2, at_far[going])
        near[going] = np.where(same, near[going], far[going])
        far[going], at_far[going] = place, found
        open_ = (moved > CLOSE) & (np.abs(far[going] - near[going]) > CLOSE) & (found != 0) & ~np.isnan(found)
        going = going[open_]
    return root
