"""Projections of streamed rays: one value along each ray, instead of the volume."""

from __future__ import annotations

import numpy as np

from fhash_codec.rendering.task.arrays import Array, Arrays
from fhash_codec.rendering.task.task import Task

__all__ = ["Projection"]


class Projection:
    """The projected values of rays as far as they are marched.

    Attributes:
        at: (n,), places of the values, in samples; of the first value for the mean.
    """

    def __init__(self, kind: str, ends: tuple[float, float], count: int, arrays: Arrays) -> None:
        self._kind, self._ends, self._arrays = kind, ends, arrays
        self.at = arrays.full(count, 0.0)
        # The best rank so far: of a maximum the value, of a minimum the value times -1, of an
        # attenuated maximum the share of the colours that is left; for the mean minus the place.
        self._best = arrays.full(count, 0.0 if kind == "attenuated" else -np.inf)
        # The light that is left, for the attenuated maximum; sum and length for the mean.
        self._light = arrays.full(count, 1.0)
        self._sum, self._length = arrays.full(count, 0.0), arrays.full(count, 0.0)

    @classmethod
    def of(cls, task: Task, count: int, arrays: Arrays) -> Projection | None:
        """The projection of a task for `count` rays; None where it draws the volume."""
        if not task.projection or task.table is None:
            return None
        return cls(task.projection, (task.table.low, task.table.high), count, arrays)

    @property
    def values(self) -> Array:
        """Values (n,) that the rays show; not finite where a ray met none."""
        xp, nothing = self._arrays.xp, self._arrays.full((), np.nan)
        if self._kind == "minimum":
            return -self._best
        if self._kind == "average":
            seen = self._length > 0
            return xp.where(seen, self._sum / xp.where(seen, self._length, 1.0), nothing)
        if self._kind == "attenuated":
            low, high = self._ends
            return xp.where(self._best > 0, low + self._best * (high - low), nothing)
        return self._best

    def finished(self, alive: Array) -> Array:
        """Whether rays (n,) cannot meet a value any more that they would show."""
        if self._kind == "attenuated":
            return self._light[alive] <= self._best[alive]
        return self._best[alive] == np.inf  # never

    def add(
        self, alive: Array, sample: Array, values: Array, length: Array, opacity: Array
    ) -> None:
        """Add the samples of a pass.

        Args:
            alive: numbers (rays,) of the rays.
            sample: int64 (rays, samples), numbers of the samples.
            values: (rays, samples), NaN where there is none.
            length: (rays, samples), of the steps, in steps.
            opacity: (rays, samples), 0 where there is no value.
        """
        arrays, xp = self._arrays, self._arrays.xp
        known, place = ~xp.isnan(values), arrays.to_float64(sample)
        if self._kind == "average":
            weight = xp.where(known, length, 0.0)
            for column in range(sample.shape[1]):  # so the sum does not depend on the passes
                self._sum[alive] += weight[:, column] * xp.nan_to_num(values[:, column])
                self._length[alive] += weight[:, column]
            rank = xp.where(known, -place, -np.inf)
        elif self._kind == "attenuated":
            low, high = self._ends
            share = xp.clip((xp.nan_to_num(values) - low) / (high - low), 0.0, 1.0)
            left = xp.cumprod(
                xp.concatenate([self._light[alive][:, None], 1 - opacity], axis=1), axis=1
            )
            self._light[alive] = left[:, -1]
            rank = xp.where(known, share * left[:, :-1], 0.0)
        else:
            sign = -1.0 if self._kind == "minimum" else 1.0
            rank = xp.where(known, sign * values, -np.inf)
        best = xp.argmax(rank, axis=1)[:, None]
        rank, place = (arrays.take_along(array, best, 1)[:, 0] for array in (rank, place))
        best_before, at_before = self._best[alive], self.at[alive]
        better = rank > best_before
        self._best[alive] = xp.where(better, rank, best_before)
        self.at[alive] = xp.where(better, place, at_before)
