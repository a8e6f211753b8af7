"""Levels that say how likely each vertex of a tile is occupied, from its decoded values.

A feature is the set of vertices whose values lie in a range, grown by some vertices. So a mask says
little more than the decoded values do, up to their error. Each vertex adds a score to all vertices
within `reach`: minus the logarithm of the probability that it is not a reason for them to be
occupied. The sums of scores are compared with bounds (native/mask_levels.cpp). Values are only
compared, and scores are whole numbers, so the levels are the same on every machine.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats import native
from fhash_formats.errors import InputError
from fhash_formats.transform.entropy.coder import array_arguments, checked

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
        first, second = np.zeros(values.shape, np.uint8), np.zeros(values.shape, np.uint8)
        if not values.size or not (any(self.scores) or any(self.others)):
            return first, second
        with np.errstate(over="ignore"):
            edges = np.array(self.edges, dtype=values.dtype)
        source = np.ascontiguousarray(values)
        scores = (ctypes.c_int32 * len(self.scores))(*self.scores)
        others = (ctypes.c_int32 * len(self.others))(*self.others) if self.others else None
        function = getattr(native.library(), f"fhash_mask_levels_f{8 * values.dtype.itemsize}")
        code = function(
            source.ctypes.data,
            (ctypes.c_int64 * 4)(*values.shape),
            *array_arguments(edges),
            scores,
            others,
            self.reach,
            first.ctypes.data,
            second.ctypes.data,
        )
        checked(code)
        return first, second
