"""Crossings of streamed rays with isosurfaces.

A crossing lies between two samples of which one is below the surface's value and one above. Its
place is found by the Illinois method.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fhash_codec.rendering.task.arrays import NUMPY, Array, Arrays
from fhash_codec.rendering.task.task import Surface

__all__ = ["Crossings", "crossings"]

CLOSE = 1e-8
"""Distance, in samples. A root is found when the last turn moved it by no more, or when the
interval that holds it is no wider.
"""
MAX_TURNS = 60
"""Turns of the search for a root, at most."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Crossings:
    """Crossings before each sample of a pass, the nearest first; as many places as surfaces.

    Attributes:
        at: (rays, samples, surfaces), places in samples of the ray.
        opacity: (rays, samples, surfaces), 0 where there is no crossing.
        which: int64 (rays, samples, surfaces), number of the surface.
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

    values: function of rows (n,) of the pass and places (n,) in samples; values (n,) there.
    at: (rays, 1 + samples), places of the samples and, first, of the one before the pass.
    steps: (rays, 1 + samples), the values there, NaN where there is none.
    """
    xp = arrays.xp
    shape = (len(at), at.shape[1] - 1, len(surfaces))
    places, opacity = arrays.full(shape, np.inf), arrays.full(shape, 0.0)
    before, after = steps[:, :-1], steps[:, 1:]
    both = ~xp.isnan(before) & ~xp.isnan(after)
    for number, surface in enumerate(surfaces):
        row, column = arrays.nonzero(both & ((before < surface.value) != (after < surface.value)))
        if not len(row):
            continue

        def above(
            chosen: Array, place: Array, row: Array = row, value: float = surface.value
        ) -> Array:
            return values(row[chosen], place) - value

        ends = before[row, column] - surface.value, after[row, column] - surface.value
        root = _roots(above, at[row, column], at[row, column + 1], *ends, arrays)
        exists = xp.isfinite(root)
        places[row[exists], column[exists], number] = root[exists]
        opacity[row[exists], column[exists], number] = surface.opacity
    which = xp.argsort(places, axis=2, stable=True)
    places, opacity = (arrays.take_along(array, which, 2) for array in (places, opacity))
    return Crossings(at=xp.where(xp.isfinite(places), places, 0.0), opacity=opacity, which=which)


def _roots(
    function: Callable[[Array, Array], Array],
    near: Array,
    far: Array,
    at_near: Array,
    at_far: Array,
    arrays: Arrays,
) -> Array:
    """Roots of a function between places, where its values have two signs.

    function: values (m,) for numbers (m,) of the roots searched for and places (m,).
    near, far: places (n,) around the roots. at_near, at_far: values (n,) there.
    The result is NaN where the search met a place without a value.
    """
    xp = arrays.xp
    near, far, at_near, at_far = (arrays.copy(array) for array in (near, far, at_near, at_far))
    root = xp.where(at_far == 0, far, near)
    (going,) = arrays.nonzero((at_near != 0) & (at_far != 0))
    for _ in range(MAX_TURNS):
        if not len(going):
            break
        place = far[going] - at_far[going] * (far[going] - near[going]) / (
            at_far[going] - at_near[going]
        )
        value = function(going, place)
        root[going] = xp.where(xp.isnan(value), np.nan, place)
        same = (value < 0) == (at_far[going] < 0)
        moved = xp.abs(place - far[going])
        # The end that stays twice has its value halved, so that the other one moves, too.
        at_near[going] = xp.where(same, at_near[going] / 2, at_far[going])
        near[going] = xp.where(same, near[going], far[going])
        far[going], at_far[going] = place, value
        unfinished = (
            (moved > CLOSE)
            & (xp.abs(far[going] - near[going]) > CLOSE)
            & (value != 0)
            & ~xp.isnan(value)
        )
        going = going[unfinished]
    return root
