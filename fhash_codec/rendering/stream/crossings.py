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
    values: Callable[[Array, Array, Array], Array],
    at: Array,
    steps: Array,
    surfaces: Sequence[Surface],
    arrays: Arrays = NUMPY,
) -> Crossings:
    """The crossings of a pass.

    values: function of rows (n,) of the pass, places (n,) in samples, and which of them count, bool
        (n,); values (n,) there.
    at: (rays, 1 + samples), places of the samples and, first, of the one before the pass.
    steps: (rays, 1 + samples), the values there, NaN where there is none.
    """
    xp = arrays.xp
    shape = (len(at), at.shape[1] - 1, len(surfaces))
    places, opacity = arrays.full(shape, np.inf), arrays.full(shape, 0.0)
    before, after = steps[:, :-1], steps[:, 1:]
    both = ~xp.isnan(before) & ~xp.isnan(after)
    crossed = [both & ((before < each.value) != (after < each.value)) for each in surfaces]
    row, column, number = arrays.nonzero(xp.stack(crossed, axis=2))
    if len(row):
        level, share = (arrays.full(len(row), 0.0) for _ in range(2))
        for count, surface in enumerate(surfaces):
            level = xp.where(number == count, surface.value, level)
            share = xp.where(number == count, surface.opacity, share)

        def above(chosen: Array, place: Array, counted: Array) -> Array:
            return values(row[chosen], place, counted) - level[chosen]

        ends = before[row, column] - level, after[row, column] - level
        root = _roots(above, at[row, column], at[row, column + 1], *ends, arrays)
        exists = xp.isfinite(root)
        places[row, column, number] = xp.where(exists, root, np.inf)
        opacity[row, column, number] = xp.where(exists, share, 0.0)
    which = xp.argsort(places, axis=2, stable=True)
    places, opacity = (arrays.take_along(array, which, 2) for array in (places, opacity))
    return Crossings(at=xp.where(xp.isfinite(places), places, 0.0), opacity=opacity, which=which)


def _roots(
    function: Callable[[Array, Array, Array], Array],
    near: Array,
    far: Array,
    at_near: Array,
    at_far: Array,
    arrays: Arrays,
) -> Array:
    """Roots of a function between places, where its values have two signs.

    function: values (m,) for numbers (m,) of the roots searched for, places (m,), and which of them
        are searched for still, bool (m,).
    near, far: places (n,) around the roots. at_near, at_far: values (n,) there.
    The result is NaN where the search met a place without a value.
    """
    xp = arrays.xp
    near, far, at_near, at_far = (arrays.copy(array) for array in (near, far, at_near, at_far))
    root = xp.where(at_far == 0, far, near)
    (going,) = arrays.nonzero((at_near != 0) & (at_far != 0))
    for _ in range(0, MAX_TURNS, arrays.turns):
        if not len(going):
            break
        active = going >= 0
        for _ in range(arrays.turns):
            place = far[going] - at_far[going] * (far[going] - near[going]) / (
                at_far[going] - at_near[going]
            )
            place = arrays.kept(active, place, far[going])
            value = function(going, place, active)
            root[going] = arrays.kept(active, xp.where(xp.isnan(value), np.nan, place), root[going])
            same = (value < 0) == (at_far[going] < 0)
            moved = xp.abs(place - far[going])
            # The end that stays twice has its value halved, so that the other one moves, too.
            halved = xp.where(same, at_near[going] / 2, at_far[going])
            at_near[going] = arrays.kept(active, halved, at_near[going])
            near[going] = arrays.kept(active, xp.where(same, near[going], far[going]), near[going])
            far[going] = place
            at_far[going] = arrays.kept(active, value, at_far[going])
            active = (
                active
                & (moved > CLOSE)
                & (xp.abs(far[going] - near[going]) > CLOSE)
                & (value != 0)
                & ~xp.isnan(value)
            )
        going = going[arrays.nonzero(active)]
    return root
