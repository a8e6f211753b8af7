"""Leaping over bricks of a field in which nothing can be seen, for rays that are marched together."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fhash_codec.rendering.stream.beams import ENDLESS
from fhash_codec.rendering.task.arrays import Array, Arrays
from fhash_codec.rendering.task.bricks import SIDE, Bricks
from fhash_codec.rendering.task.task import Task

__all__ = ["Leaping"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Leaping:
    """Which bricks matter: `distance` (z, y, x) is that in bricks to the nearest that does, diagonals counted as one.

    last: number (x, y, z) of the last brick. first: place where the first one begins. side: of a brick, in vertices of the domain.
    """

    arrays: Arrays
    distance: Array
    last: Array
    first: Array
    side: float

    @classmethod
    def of(cls, bricks: Bricks, task: Task, first: Array, stride: float, arrays: Arrays) -> Leaping:
        """Of the bricks that can hold a visible value or a surface; of those with any value, for the largest along a ray."""
        table = task.table
        if task.maximum and table is not None:
            task = replace(task, table=replace(table, extinctions=np.ones_like(table.extinctions)))
        distance = bricks.distance(task)
        last = arrays.array(np.array(distance.shape[::-1]) - 1.0)
        return cls(
            arrays=arrays,
            distance=arrays.array(distance, "int64"),
            last=last,
            first=first,
            side=SIDE * stride,
        )

    def matters(self, places: Array) -> Array:
        """Whether places (..., 3) lie in bricks that matter."""
        return self.distance[self._bricks(places)[1]] == 0

    def leap(self, origin: Array, pace: Array, sample: Array, end: Array) -> tuple[Array, int]:
        """The first sample (n,) of each ray, not before `sample`, in a brick that matters, or `end`; and how many leaps that took.

        origin: places (n, 3) of the samples 0. pace: from one sample to the next.
        """
        xp = self.arrays.xp
        sample = self.arrays.copy(sample)
        pending = self.arrays.range(len(sample))
        leaps = 0
        while len(pending):
            brick, index = self._bricks(origin[pending] + sample[pending][:, None] * pace[pending])
            away = self.distance[index]
            inside = away > 0
            pending, brick, away = pending[inside], brick[inside], away[inside][:, None]
            start, step = origin[pending], pace[pending]
            # The cube of bricks around this one in which none matters, on the side that the ray goes to.
            face = (
                self.arrays.real(xp.where(step > 0, brick + away, brick - away + 1)) * self.side
                + self.first
            )
            with np.errstate(divide="ignore", invalid="ignore"):
                reach = xp.clip(
                    xp.amin(xp.where(step == 0, np.inf, (face - start) / step), axis=1),
                    None,
                    ENDLESS,
                )
            onward = xp.maximum(self.arrays.whole(xp.floor(reach)) + 1, sample[pending] + 1)
            sample[pending] = xp.minimum(onward, end[pending])
            leaps += len(pending)
            pending = pending[sample[pending] < end[pending]]
        return sample, leaps

    def _bricks(self, places: Array) -> tuple[Array, tuple[Array, Array, Array]]:
        """Numbers (..., 3), x, y, z, of the bricks that places lie in, and the same as an index."""
        at = self.arrays.xp.floor((places - self.first) / self.side)
        brick = self.arrays.whole(self.arrays.xp.clip(at, 0 * self.last, self.last))
        return brick, (brick[..., 2], brick[..., 1], brick[..., 0])
