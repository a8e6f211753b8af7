"""Leaping over bricks of a field in which nothing can be seen, for rays that are marched together."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from fhash_codec.render.bricks import SIDE, Bricks
from fhash_codec.render.task import Task

__all__ = ["Leaping"]

Floats = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Leaping:
    """Which bricks matter: `distance` (z, y, x) is that in bricks to the nearest that does, diagonals counted as one.

    first: place (x, y, z) where the first brick begins. side: of a brick, in vertices of the domain.
    """

    distance: npt.NDArray[np.int32]
    first: Floats
    side: float

    @classmethod
    def of(cls, bricks: Bricks, task: Task, first: Floats, stride: float) -> Leaping:
        """Of the bricks that can hold a visible value or a surface; of those with any value, for the largest along a ray."""
        table = task.table
        if task.maximum and table is not None:
            task = replace(task, table=replace(table, extinctions=np.ones_like(table.extinctions)))
        return cls(distance=bricks.distance(task), first=first, side=SIDE * stride)

    def matters(self, places: Floats) -> npt.NDArray[np.bool_]:
        """Whether places (..., 3) lie in bricks that matter."""
        return np.asarray(self.distance[self._bricks(places)[1]] == 0)

    def leap(self, origin: Floats, pace: Floats, sample: Numbers, end: Numbers) -> tuple[Numbers, int]:
        """The first sample (n,) of each ray, not before `sample`, in a brick that matters, or `end`; and how many leaps that took.

        origin: places (n, 3) of the samples 0. pace: from one sample to the next.
        """
        sample = sample.copy()
        pending = np.arange(len(sample))
        leaps = 0
        while pending.size:
            brick, index = self._bricks(origin[pending] + sample[pending, None] * pace[pending])
            away = self.distance[index].astype(np.int64)
            inside = away > 0
            pending, brick, away = pending[inside], brick[inside], away[inside, None]
            start, step = origin[pending], pace[pending]
            # The cube of bricks around this one in which none matters, on the side that the ray goes to.
            face = np.where(step > 0, brick + away, brick - away + 1) * self.side + self.first
            with np.errstate(divide="ignore", invalid="ignore"):
                reach = np.where(step == 0, np.inf, (face - start) / step).min(axis=1, initial=2.0**62)
            onward = np.maximum(np.floor(reach).astype(np.int64) + 1, sample[pending] + 1)
            sample[pending] = np.minimum(onward, end[pending])
            leaps += len(pending)
            pending = pending[sample[pending] < end[pending]]
        return sample, leaps

    def _bricks(self, places: Floats) -> tuple[Numbers, tuple[Numbers, Numbers, Numbers]]:
        """Numbers (..., 3), x, y, z, of the bricks that places lie in, and the same as an index."""
        last = np.array(self.distance.shape[::-1]) - 1
        brick = np.clip(np.floor((places - self.first) / self.side), 0, last).astype(np.int64)
        return brick, (brick[..., 2], brick[..., 1], brick[..., 0])
