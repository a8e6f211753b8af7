"""Where streamed rays cross isosurfaces: between two samples one below and one above the value, found by the Illinois method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fhash_codec.rendering.task.arrays import NUMPY, Array, Arrays
from fhash_codec.rendering.task.task import Surface

__all__ = ["Crossings", "crossings"]

CLOSE = 1e-8
"""Steps that a root moves at most in the last turn, and the width of what it lies within."""
MAX_TURNS = 60


@dataclass(frozen=True, kw_only=True, eq=False)
class Crossings:
    """Before each sample of a pass, as many places as there are surfaces, the nearest first.

    at: (rays, samples, surfaces), in samples of the ray. opacity: the same shape, 0 where there is no crossing. which: of the surfaces.
    """

    at: Array
    opacity: Array
    which: Array


def crossings(
    values: Callable[[Array, Array], Array],
    at: Array,
    steps: Array,
    surfaces: Sequence[Surface],
    arrays: Arrays = NUMPY,
) -> Crossings:
    """The crossings of a pass.

    values: of rows (n,) of the pass at places (n,) in samples. at, steps: places and values (rays, 1 + samples), those before the first
    sample included; NaN where there is no value.
    """
    xp = arrays.xp
    shape = (len(at), at.shape[1] - 1, len(surfaces))
    places, opacity = arrays.full(shape, np.inf), arrays.full(shape, 0.0)
    before, now = steps[:, :-1], steps[:, 1:]
    known = ~xp.isnan(before) & ~xp.isnan(now)
    for number, surface in enumerate(surfaces):
        row, column = arrays.nonzero(known & ((before < surface.value) != (now < surface.value)))
        if not len(row):
            continue

        def beyond(
            part: Array, place: Array, row: Array = row, value: float = surface.value
        ) -> Array:
            return values(row[part], place) - value

        ends = before[row, column] - surface.value, now[row, column] - surface.value
        root = _roots(beyond, at[row, column], at[row, column + 1], *ends, arrays)
        found = xp.isfinite(root)
        places[row[found], column[found], number] = root[found]
        opacity[row[found], column[found], number] = surface.opacity
    which = xp.argsort(places, axis=2, stable=True)
    places, opacity = (arrays.take_along(part, which, 2) for part in (places, opacity))
    return Crossings(at=xp.where(xp.isfinite(places), places, 0.0), opacity=opacity, which=which)


def _roots(
    function: Callable[[Array, Array], Array],
    near: Array,
    far: Array,
    at_near: Array,
    at_far: Array,
    arrays: Arrays,
) -> Array:
    """Roots between places near and far, where a function of (numbers, places) has values of two signs; NaN where it has none."""
    xp = arrays.xp
    near, far, at_near, at_far = (arrays.copy(part) for part in (near, far, at_near, at_far))
    root = xp.where(at_far == 0, far, near)
    (going,) = arrays.nonzero((at_near != 0) & (at_far != 0))
    for _ in range(MAX_TURNS):
        if not len(going):
            break
        place = far[going] - at_far[going] * (far[going] - near[going]) / (
            at_far[going] - at_near[going]
        )
        found = function(going, place)
        root[going] = xp.where(xp.isnan(found), np.nan, place)
        same = (found < 0) == (at_far[going] < 0)
        moved = xp.abs(place - far[going])
        # The end that stays twice has its value halved, so that the other one moves too.
        at_near[going] = xp.where(same, at_near[going] / 2, at_far[going])
        near[going] = xp.where(same, near[going], far[going])
        far[going], at_far[going] = place, found
        open_ = (
            (moved > CLOSE)
            & (xp.abs(far[going] - near[going]) > CLOSE)
            & (found != 0)
            & ~xp.isnan(found)
        )
        going = going[open_]
    return root
