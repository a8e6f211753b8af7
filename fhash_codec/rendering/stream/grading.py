"""Opacity by gradient, for rays that are marched together."""

from __future__ import annotations

import numpy as np

from fhash_codec.rendering.stream.fields import Field, central_slopes
from fhash_codec.rendering.task.arrays import Array
from fhash_codec.rendering.task.task import GRADES, Task

__all__ = ["Factors"]


class Factors:
    """The factors of a `Grading`, as a function of places in a field."""

    def __init__(self, field: Field, task: Task) -> None:
        assert task.grading is not None
        arrays = field.arrays
        self._field, self._arrays = field, arrays
        self._central = task.lighting is not None and task.lighting.central
        self._spacing = arrays.array(task.rays.grid.spacing)
        self._scale = GRADES / task.grading.top
        self._factors = arrays.array(
            np.append(task.grading.factors, task.grading.factors[-1]), "float64"
        )

    @classmethod
    def of(cls, task: Task, field: Field) -> Factors | None:
        """The factors of a task in a field; None where gradients decide on no opacity."""
        return None if task.grading is None else cls(field, task)

    def __call__(self, places: Array) -> Array:
        """Factors (n,) of the extinction at places (n, 3) of the domain."""
        xp = self._arrays.xp
        slopes = (
            central_slopes(self._field, places) if self._central else self._field.slopes(places)
        ) / self._spacing
        entry = xp.clip(xp.sqrt(xp.sum(slopes * slopes, axis=1)) * self._scale, 0.0, float(GRADES))
        before = self._arrays.to_int64(entry)
        low, high = xp.take(self._factors, before), xp.take(self._factors, before + 1)
        return low + (entry - self._arrays.to_float64(before)) * (high - low)
