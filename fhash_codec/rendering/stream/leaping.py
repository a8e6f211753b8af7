"""Leaping over invisible bricks of a field, for rays that are marched together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fhash_codec.rendering.stream.beams import ENDLESS
from fhash_codec.rendering.task.arrays import Array, Arrays
from fhash_codec.rendering.task.bricks import SIDE, Bricks
from fhash_codec.rendering.task.task import Task

__all__ = ["Leaping"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Leaping:
    """The bricks that matter, and how far away they are.

    Attributes:
        distance: int64 (z, y, x), of each brick to the nearest that matters, in bricks, a diagonal
            step counted as one.
        last: (3,), number (x, y, z) of the last brick.
        first: (3,), place (x, y, z) at which the first brick begins.
        side: side of a brick, in vertices of the domain.
    """

    arrays: Arrays
    distance: Array
    last: Array
    first: Array
    side: float

    @classmethod
    def of(cls, bricks: Bricks, task: Task, first: Array, arrays: Arrays) -> Leaping:
        """Leaping for a task: over bricks without a visible value and without a surface.

        task: with the table that samples take.
        """
        distance = bricks.distance(task)
        last = arrays.array(np.array(distance.shape[::-1]) - 1.0)
        return cls(
            arrays=arrays,
            distance=arrays.array(distance, "int64"),
            last=last,
            first=first,
            side=float(SIDE),
        )

    def matters(self, places: Array) -> Array:
        """Whether places (..., 3) lie in bricks that matter."""
        return self.distance[self._bricks(places)[1]] == 0

    def leap(
        self, origin: Array, pace: Array, sample: Array, end: Array, going: Array
    ) -> tuple[Array, Array | int]:
        """The next sample (n,) of each ray, from `sample` on, in a brick that matters, or `end`.

        Also returns the number of leaps that it took.

        origin: places (n, 3) of the samples 0. pace: (n, 3), from one sample to the next.
        going: bool (n,), rays that leap, all of those that the host picked; others stay.
        """
        arrays, xp = self.arrays, self.arrays.xp
        sample = arrays.copy(sample)
        pending = arrays.range(len(sample))
        leaps: Array | int = 0
        while len(pending):
            for _ in range(arrays.leaps):
                brick, index = self._bricks(
                    origin[pending] + sample[pending][:, None] * pace[pending]
                )
                away = self.distance[index]
                leaping = (away > 0) & going
                some = arrays.candidates(leaping)
                pending, brick, away = pending[some], brick[some], away[some][:, None]
                going = leaping[some]
                onward = xp.maximum(
                    self._beyond(origin[pending], pace[pending], brick, away), sample[pending] + 1
                )
                sample[pending] = arrays.kept(
                    going, xp.minimum(onward, end[pending]), sample[pending]
                )
                leaps += xp.count_nonzero(going)
                going = going & (sample[pending] < end[pending])
            (left,) = arrays.nonzero(going)
            pending, going = pending[left], going[left]
        return sample, leaps

    def _beyond(self, start: Array, step: Array, brick: Array, away: Array) -> Array:
        """The first sample (n,) of each ray beyond the cube of bricks in which none matters.

        start: places (n, 3) of the samples 0. step: (n, 3), from one sample to the next.
        brick: numbers (n, 3) of the bricks in the middle of the cubes.
        away: (n, 1), distances of these bricks to the nearest that matters.
        """
        xp = self.arrays.xp
        # The faces of the cube towards which the ray goes.
        face = (
            self.arrays.to_float64(xp.where(step > 0, brick + away, brick - away + 1)) * self.side
            + self.first
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = xp.clip(
                xp.amin(xp.where(step == 0, np.inf, (face - start) / step), axis=1), None, ENDLESS
            )
        return self.arrays.to_int64(xp.floor(reach)) + 1

    def _bricks(self, places: Array) -> tuple[Array, tuple[Array, Array, Array]]:
        """Numbers (..., 3), x, y, z, of the bricks at places, and their index (z, y, x)."""
        at = self.arrays.xp.floor((places - self.first) / self.side)
        brick = self.arrays.to_int64(self.arrays.xp.clip(at, 0 * self.last, self.last))
        return brick, (brick[..., 2], brick[..., 1], brick[..., 0])
