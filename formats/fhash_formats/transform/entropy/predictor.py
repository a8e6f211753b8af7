"""Predictor of the integers of a tile from each other: lattices, passes, taps and trained weights.

A tile is coded on ever finer lattices. The first lattice halves each axis as often as `levels`
says. Then, from the coarsest level on and in the given order of the axes, each pass doubles the
resolution along one axis. A vertex of a pass lies between two known vertices. Its prediction is
their mean, the *base*, plus a weighted sum of the differences of other known vertices, the *taps*,
from the base. The encoder trains the weights.
"""

from __future__ import annotations

import base64
import binascii
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.transform.entropy.coder import decode_block, encode_block

__all__ = [
    "CLASSES",
    "MAX_WEIGHT",
    "WEIGHT_UNIT",
    "Pass",
    "Predictor",
    "pass_arrays",
    "passes_of",
]

CLASSES = 16
"""Kinds of passes, each with statistics of its own.

Kind 0 is the last pass, 1 the one before, and so on; the earliest passes share kind CLASSES - 2,
and the first lattice has kind CLASSES - 1.
"""
WEIGHT_UNIT = 4096
"""Weight of a tap that counts in full."""
MAX_WEIGHT = 32767
"""Largest magnitude of a weight."""
MAX_LEVELS = 8
"""Most halvings along an axis."""
MAX_REACH = 2
"""Largest reach of the taps."""

Tap = tuple[int, int, int, int, int]
"""A vertex that a prediction uses: the lattice, then offsets along t, z, y, x in that lattice.

The lattice is 1 for the vertices of the pass itself and 0 for the lattice known before the pass.
"""


@dataclass(frozen=True, kw_only=True)
class Pass:
    """A pass over a tile.

    Attributes:
        axis: axis along which it doubles the resolution, -1 for the first lattice.
        kind: 0 to CLASSES - 1.
        taps: the vertices that it uses besides those of the base.
    """

    axis: int
    kind: int
    taps: tuple[Tap, ...]


@dataclass(frozen=True, kw_only=True)
class Predictor:
    """Settings with which a tile is coded by prediction.

    Raises InputError for settings that do not fit together.

    Attributes:
        step: distance of neighbouring values, above 0, in units of the values: nearly twice the
            bound on the error.
        origin: value of the integer 0.
        levels: halvings along t, z, y, x, 0 to MAX_LEVELS.
        order: order of the axes within a level.
        reach: 0 to MAX_REACH; a larger reach has more taps.
        weights: weight of each tap of each pass, in 1/WEIGHT_UNIT.
    """

    step: float
    origin: float
    levels: tuple[int, int, int, int]
    order: tuple[int, int, int, int]
    reach: int
    weights: tuple[int, ...]

    def __post_init__(self) -> None:
        for name in ("step", "origin"):
            value = getattr(self, name)
            if (
                isinstance(value, bool)
                or not isinstance(value, int | float)
                or not math.isfinite(value)
            ):
                raise InputError(f"predictor: {name} is {value!r:.40}; a finite number is needed")
        if self.step <= 0:
            raise InputError(f"predictor: step is {self.step}; it must be above 0")
        if not _are_integers(self.levels, 4, 0, MAX_LEVELS):
            raise InputError(
                f"predictor: levels are {self.levels!r:.60}; "
                f"four whole numbers from 0 to {MAX_LEVELS} are needed"
            )
        if not _is_order(self.order):
            raise InputError(
                f"predictor: order is {self.order!r:.60}; 0, 1, 2, 3 in some order are needed"
            )
        if type(self.reach) is not int or not 0 <= self.reach <= MAX_REACH:
            raise InputError(
                f"predictor: reach is {self.reach!r:.40}; 0 to {MAX_REACH} is possible"
            )
        count = sum(len(a_pass.taps) for a_pass in self.passes)
        if not _are_integers(self.weights, count, -MAX_WEIGHT, MAX_WEIGHT):
            raise InputError(f"predictor: {count} weights within +-{MAX_WEIGHT} are needed")

    @property
    def passes(self) -> tuple[Pass, ...]:
        """The passes, in order."""
        return passes_of(self.levels, self.order, self.reach)

    def to_dict(self) -> dict[str, Any]:
        """JSON values; the weights are coded as a block, in base64."""
        packed = encode_block(np.array(self.weights, dtype=np.int32).reshape(1, 1, 1, -1))
        return {
            "step": self.step,
            "origin": self.origin,
            "levels": list(self.levels),
            "order": list(self.order),
            "reach": self.reach,
            "weights": base64.b64encode(packed).decode("ascii"),
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Predictor:
        """The inverse of `to_dict`.

        Raises InputError, naming the key, or DamagedFileError for anything else.
        """
        keys = ("step", "origin", "levels", "order", "reach", "weights")
        if not isinstance(values, Mapping):
            raise InputError(
                f"a predictor is a mapping with the keys {', '.join(keys)}, not {values!r:.60}"
            )
        for key in (*values, *keys):
            if key not in keys or key not in values:
                raise InputError(
                    f"predictor: {'unknown' if key not in keys else 'missing'} key {key!r:.40}; "
                    f"the keys are {', '.join(keys)}"
                )
        levels, order = (
            tuple(values[key]) if isinstance(values[key], list | tuple) else ()
            for key in ("levels", "order")
        )
        # The number of weights follows from these three, so they are checked before the weights.
        if not _are_integers(levels, 4, 0, MAX_LEVELS) or not _is_order(order):
            raise InputError(
                f"predictor: levels {levels!r:.60} and order {order!r:.60} are no such lists"
            )
        if type(values["reach"]) is not int or not 0 <= values["reach"] <= MAX_REACH:
            raise InputError(
                f"predictor: reach is {values['reach']!r:.40}; 0 to {MAX_REACH} is possible"
            )
        passes = passes_of(levels, order, values["reach"])
        count = sum(len(a_pass.taps) for a_pass in passes)
        try:
            block = decode_block(
                base64.b64decode(values["weights"], validate=True), (1, 1, 1, count)
            )
        except (binascii.Error, TypeError, ValueError) as error:
            if isinstance(error, DamagedFileError):
                raise
            raise DamagedFileError("the weights of a predictor are not base64") from error
        return cls(
            step=values["step"],
            origin=values["origin"],
            levels=levels,
            order=order,
            reach=values["reach"],
            weights=tuple(block.ravel().tolist()),
        )


@lru_cache(maxsize=64)
def passes_of(
    levels: tuple[int, int, int, int], order: tuple[int, int, int, int], reach: int
) -> tuple[Pass, ...]:
    """The passes of a predictor: the first lattice, then each level along the axes in order."""
    axes = [axis for level in range(max(levels), 0, -1) for axis in order if levels[axis] >= level]
    first = Pass(axis=-1, kind=CLASSES - 1, taps=_first_taps())
    others = (
        Pass(axis=axis, kind=min(len(axes) - 1 - i, CLASSES - 2), taps=_taps(axis, reach))
        for i, axis in enumerate(axes)
    )
    return (first, *others)


def pass_arrays(
    predictor: Predictor,
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32], npt.NDArray[np.int16]]:
    """The passes as the native coder takes them.

    Returns:
        Passes, int32 (n, 4): axis, kind, number of the first tap, number of taps.
        Taps of all passes, int32 (m, 5), see `Tap`.
        Weights of the taps, int16 (m,).
    """
    rows: list[tuple[int, ...]] = []
    taps: list[Tap] = []
    for a_pass in predictor.passes:
        rows.append((a_pass.axis, a_pass.kind, len(taps), len(a_pass.taps)))
        taps += a_pass.taps
    return (
        np.array(rows, dtype=np.int32),
        np.array(taps, dtype=np.int32),
        np.array(predictor.weights, dtype=np.int16),
    )


def _at(lattice: int, *moves: tuple[int, int]) -> Tap:
    """The tap of a lattice at these moves, each an axis and an offset along it."""
    offsets = dict(moves)
    t, z, y, x = (offsets.get(axis, 0) for axis in range(4))
    return (lattice, t, z, y, x)


@lru_cache(maxsize=1)
def _first_taps() -> tuple[Tap, ...]:
    """Taps of the first lattice; all its vertices before this one are known."""
    taps = [_at(1, (axis, -1)) for axis in range(4)]
    taps += [_at(1, (a, -1), (b, -1)) for a, b in combinations(range(4), 2)]
    taps += [_at(1, (axis, -2)) for axis in range(4)]
    taps += [_at(1, (a, -1), (b, 1)) for a, b in combinations(range(4), 2)]
    return tuple(taps)


def _taps(axis: int, reach: int) -> tuple[Tap, ...]:
    """Taps of a pass along an axis.

    Vertices 0 and 1 of the known lattice lie beside the vertex. Vertices of the pass itself are
    known if they come before it in C order.
    """
    others = [other for other in range(4) if other != axis]
    taps = [_at(0, (axis, 1)), _at(0, (axis, -1)), _at(0, (axis, 2))]
    taps += [
        _at(0, (axis, near), (other, side))
        for other in others
        for near in (0, 1)
        for side in (-1, 1)
    ]
    taps += [_at(1, (axis, -1)), *(_at(1, (other, -1)) for other in others)]
    if reach > 0:
        taps += [_at(1, (other, -2)) for other in others]
        pairs = [
            *combinations(others, 2),
            *((min(axis, other), max(axis, other)) for other in others),
        ]
        taps += [_at(1, (first, -1), (second, side)) for first, second in pairs for side in (-1, 1)]
    if reach > 1:
        sides = [(near, a, b) for near in (0, 1) for a in (-1, 1) for b in (-1, 1)]
        taps += [
            _at(0, (axis, near), (first, a), (second, b))
            for first, second in combinations(others, 2)
            for near, a, b in sides
        ]
    return tuple(taps)


def _is_order(values: Any) -> bool:
    return _are_integers(values, 4, 0, 3) and sorted(values) == [0, 1, 2, 3]


def _are_integers(values: Any, count: int, low: int, high: int) -> bool:
    """Whether `values` is a tuple of so many ints from `low` to `high`."""
    return (
        isinstance(values, tuple)
        and len(values) == count
        and all(type(value) is int and low <= value <= high for value in values)
    )
