"""How the integers of a tile are predicted from each other: lattices, passes, taps and their trained weights.

A tile is coded on ever finer lattices. `levels` says how often each axis is halved at first; then, from the coarsest level on and in the
given order of the axes, a pass doubles the resolution along one axis. A vertex of a pass lies between two known ones; its prediction is
their mean, the base, plus a weighted sum of how other known vertices, the taps, differ from it. The weights are trained by the encoder.
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
"""Kinds of passes that statistics tell apart: 0 the last one, then backwards; all of the first belong to the last kind."""
WEIGHT_UNIT, MAX_WEIGHT = 4096, 32767
MAX_LEVELS, MAX_REACH = 8, 2

Tap = tuple[int, int, int, int, int]
"""1 if among the vertices of the pass itself, else 0; then offsets along t, z, y, x in that lattice."""


@dataclass(frozen=True, kw_only=True)
class Pass:
    """axis: along which it refines, -1 for the first lattice. kind: 0 to 15. taps: what is looked at besides the base."""

    axis: int
    kind: int
    taps: tuple[Tap, ...]


@dataclass(frozen=True, kw_only=True)
class Predictor:
    """Settings of the predicted way to code a tile. Raises InputError for those that do not fit together.

    Attributes:
        step: distance of neighbouring values, > 0, in units of the values: twice the bound, nearly.
        origin: the value of the integer 0.
        levels: halvings along t, z, y, x, 0 to 8. order: of the axes within a level.
        reach: 0 to 2, how many taps.
        weights: of all taps of all passes, in 1/4096.
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
        if not _whole(self.levels, 4, 0, MAX_LEVELS):
            raise InputError(
                f"predictor: levels are {self.levels!r:.60}; four whole numbers from 0 to {MAX_LEVELS} are needed"
            )
        if not _whole(self.order, 4, 0, 3) or sorted(self.order) != [0, 1, 2, 3]:
            raise InputError(
                f"predictor: order is {self.order!r:.60}; 0, 1, 2, 3 in some order are needed"
            )
        if type(self.reach) is not int or not 0 <= self.reach <= MAX_REACH:
            raise InputError(
                f"predictor: reach is {self.reach!r:.40}; 0 to {MAX_REACH} is possible"
            )
        count = sum(len(part.taps) for part in self.passes)
        if not _whole(self.weights, count, -MAX_WEIGHT, MAX_WEIGHT):
            raise InputError(f"predictor: {count} weights within +-{MAX_WEIGHT} are needed")

    @property
    def passes(self) -> tuple[Pass, ...]:
        """The passes, in order."""
        return passes_of(self.levels, self.order, self.reach)

    def to_dict(self) -> dict[str, Any]:
        """JSON values."""
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
        """The inverse of `to_dict`. Raises InputError, naming the key, or DamagedFileError for anything else."""
        keys = ("step", "origin", "levels", "order", "reach", "weights")
        if not isinstance(values, Mapping):
            raise InputError(
                f"a predictor is a mapping with the keys {', '.join(keys)}, not {values!r:.60}"
            )
        for key in (*values, *keys):
            if key not in keys or key not in values:
                raise InputError(
                    f"predictor: {'unknown' if key not in keys else 'missing'} key {key!r:.40}; the keys are {', '.join(keys)}"
                )
        levels, order = (
            tuple(values[key]) if isinstance(values[key], list | tuple) else ()
            for key in ("levels", "order")
        )
        if (
            not _whole(levels, 4, 0, MAX_LEVELS)
            or not _whole(order, 4, 0, 3)
            or sorted(order) != [0, 1, 2, 3]
        ):
            raise InputError(
                f"predictor: levels {levels!r:.60} and order {order!r:.60} are no such lists"
            )
        if type(values["reach"]) is not int or not 0 <= values["reach"] <= MAX_REACH:
            raise InputError(
                f"predictor: reach is {values['reach']!r:.40}; 0 to {MAX_REACH} is possible"
            )
        count = sum(len(part.taps) for part in passes_of(levels, order, values["reach"]))
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
    """The passes of a predictor: the coarsest lattice, then level by level along the axes in this order."""
    axes = [axis for level in range(max(levels), 0, -1) for axis in order if levels[axis] >= level]
    parts = [Pass(axis=-1, kind=CLASSES - 1, taps=_first_taps())]
    parts += [
        Pass(axis=axis, kind=min(len(axes) - 1 - i, CLASSES - 2), taps=_taps(axis, reach))
        for i, axis in enumerate(axes)
    ]
    return tuple(parts)


def pass_arrays(
    predictor: Predictor,
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32], npt.NDArray[np.int16]]:
    """Passes (n, 4) of (axis, kind, first tap, taps), all taps (m, 5) and their weights (m,)."""
    rows: list[tuple[int, ...]] = []
    taps: list[Tap] = []
    for part in predictor.passes:
        rows.append((part.axis, part.kind, len(taps), len(part.taps)))
        taps += part.taps
    return (
        np.array(rows, dtype=np.int32),
        np.array(taps, dtype=np.int32),
        np.array(predictor.weights, dtype=np.int16),
    )


def _tap(own: int, **offsets: int) -> Tap:
    return (own, *(offsets.get(name, 0) for name in "tzyx"))  # type: ignore[return-value]


def _at(own: int, *pairs: tuple[int, int]) -> Tap:
    return _tap(own, **{"tzyx"[axis]: offset for axis, offset in pairs})


@lru_cache(maxsize=1)
def _first_taps() -> tuple[Tap, ...]:
    """Of the coarsest lattice, all of whose vertices before this one are known."""
    taps = [_at(1, (axis, -1)) for axis in range(4)]
    taps += [_at(1, (one, -1), (two, -1)) for one, two in combinations(range(4), 2)]
    taps += [_at(1, (axis, -2)) for axis in range(4)]
    taps += [_at(1, (one, -1), (two, 1)) for one, two in combinations(range(4), 2)]
    return tuple(taps)


def _taps(axis: int, reach: int) -> tuple[Tap, ...]:
    """Of a pass along an axis: known vertices at 0 and 1 are beside the vertex; those of the pass are known in C order."""
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
        taps += [_at(1, (one, -1), (two, side)) for one, two in pairs for side in (-1, 1)]
    if reach > 1:
        sides = [(near, a, b) for near in (0, 1) for a in (-1, 1) for b in (-1, 1)]
        taps += [
            _at(0, (axis, near), (one, a), (two, b))
            for one, two in combinations(others, 2)
            for near, a, b in sides
        ]
    return tuple(taps)


def _whole(values: Any, count: int, low: int, high: int) -> bool:
    return (
        isinstance(values, tuple)
        and len(values) == count
        and all(type(value) is int and low <= value <= high for value in values)
    )
