"""Levels that say how likely each vertex of a tile is occupied, from its decoded values.

A feature is the set of vertices whose values lie in a range, grown by some vertices. So a mask says
little more than the decoded values do, up to their error. Each vertex adds a score to all vertices
within `reach`: minus the logarithm of the probability that it is not a reason for them to be
occupied. The sums of scores are compared with BOUNDS. Values are only compared, and scores are
whole numbers, so the levels are the same on every machine.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError

__all__ = ["MAX_EDGES", "MAX_REACH", "MAX_SCORE", "UNIT", "MaskLevels"]

MAX_EDGES = 15
"""Most edges between classes of values."""
MAX_REACH = 64
"""Largest reach, in vertices."""
MAX_SCORE = 4095
"""Largest score, and largest sum of scores."""
MAX_FLOAT = float(np.finfo(np.float64).max)
"""Largest magnitude of an edge."""
UNIT = 128
"""Scores per bit."""
BOUNDS = (
    *(1, 2, 3, 4, 6, 8, 11, 15, 20, 27, 36, 48, 64, 85, 110, 128, 155, 190, 230, 275, 325),
    *(385, 455, 540, 640, 760, 900, 1100, 1350, 1700, 2200),
)
"""Sums of scores at which level 1, 2, ... begins; level 16 begins at one bit, at even odds."""

Levels = npt.NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class MaskLevels:
    """Scores of the decoded values; raises InputError for values that are not allowed.

    Attributes:
        edges: at most MAX_EDGES ascending numbers; class i holds the values from edge i - 1 on and
            below edge i.
        scores: score of each class, 0 to MAX_SCORE, in 1/UNIT bit.
        others: scores for the second level; without them it is the level of the vertex alone by
            `scores`.
        reach: vertices along z, y and x by which a feature was grown, 0 to MAX_REACH.
    """

    edges: tuple[float, ...] = ()
    scores: tuple[int, ...] = (0,)
    others: tuple[int, ...] = ()
    reach: int = 0

    def __post_init__(self) -> None:
        numbers = all(type(edge) in (int, float) and abs(edge) <= MAX_FLOAT for edge in self.edges)
        if (
            len(self.edges) > MAX_EDGES
            or not numbers
            or any(low >= high for low, high in pairwise(self.edges))
        ):
            raise InputError(
                f"edges of a mask are {self.edges!r:.80}; "
                f"at most {MAX_EDGES} ascending numbers are needed"
            )
        for scores in (self.scores, *([self.others] if self.others else [])):
            if len(scores) != len(self.edges) + 1 or not all(
                type(n) is int and 0 <= n <= MAX_SCORE for n in scores
            ):
                raise InputError(
                    f"scores of a mask are {scores!r:.80}; "
                    f"{len(self.edges) + 1} whole numbers to {MAX_SCORE} are needed"
                )
        if type(self.reach) is not int or not 0 <= self.reach <= MAX_REACH:
            raise InputError(
                f"reach of a mask is {self.reach!r:.40}; a whole number to {MAX_REACH} is needed"
            )

    def levels(self, values: npt.NDArray[Any]) -> tuple[Levels, Levels]:
        """The level, 0 to 31, and the second level, 0 to 15, of each vertex (t, z, y, x), uint8.

        values: the decoded values, finite, in the type in which the tile is transformed.
        """
        if not any(self.scores) and not any(self.others):
            return np.zeros(values.shape, np.uint8), np.zeros(values.shape, np.uint8)
        classes = np.zeros(values.shape, np.uint8)
        with np.errstate(over="ignore"):
            edges = np.array(self.edges, dtype=values.dtype)
        for edge in edges:
            classes += values >= edge
        alone = np.array(self.scores, dtype=np.int32)
        first = _LEVELS[_summed(alone[classes], self.reach)]
        if not self.others:
            return first, _HALVES[alone][classes]
        return first, _HALVES[_summed(np.array(self.others, dtype=np.int32)[classes], self.reach)]

    def to_dict(self) -> dict[str, Any]:
        """JSON values, without those that have their default."""
        named: dict[str, Any] = {"edges": list(self.edges)} if self.edges else {}
        if self.scores != (0,):
            named["scores"] = list(self.scores)
        if self.others:
            named["others"] = list(self.others)
        if self.reach:
            named["reach"] = self.reach
        return named

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> MaskLevels:
        """The inverse of `to_dict`; raises InputError for anything else."""
        keys = {"edges", "scores", "others", "reach"}
        if not isinstance(values, Mapping) or not set(values) <= keys:
            raise InputError(
                f"mask is {values!r:.80}; an object of edges, scores, others and reach is needed"
            )
        lists = {
            name: values.get(name, default)
            for name, default in (("edges", []), ("scores", [0]), ("others", []))
        }
        if not all(isinstance(numbers, list | tuple) for numbers in lists.values()):
            raise InputError("edges, scores and others of a mask are lists")
        return cls(
            **{name: tuple(numbers) for name, numbers in lists.items()},
            reach=values.get("reach", 0),
        )


def _summed(scores: npt.NDArray[np.int32], reach: int) -> npt.NDArray[np.int32]:
    """Sums over the cubes of that reach along z, y and x, cut at the ends of the tile.

    The sums stop at MAX_SCORE after each axis, so that they stay within int32.
    """
    for axis in (1, 2, 3) if reach else ():
        lines, total = np.moveaxis(scores, axis, 0), scores.copy()
        out = np.moveaxis(total, axis, 0)
        for shift in range(1, min(reach, scores.shape[axis] - 1) + 1):
            out[shift:] += lines[:-shift]
            out[:-shift] += lines[shift:]
        scores = np.minimum(total, MAX_SCORE, out=total)
    return scores


_LEVELS: Levels = np.searchsorted(BOUNDS, np.arange(MAX_SCORE + 1), side="right").astype(np.uint8)
"""First level of each sum of scores."""
_HALVES: Levels = np.floor_divide(_LEVELS, 2, dtype=np.uint8)
"""Second level of each sum of scores."""
