"""A task in the vertices of a frame, as the native marcher takes it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.task.bricks import Bricks
from fhash_codec.rendering.task.slopes import flatness, slope_scale, smoothing
from fhash_codec.rendering.task.task import Frame, Table, Task

__all__ = ["MarchInput", "empty_table"]

Floats = npt.NDArray[np.float64]
Single = npt.NDArray[np.float32]

MAX_MAGNITUDE = 1e36
"""Largest magnitude of values that float32 can compute with; larger values are scaled."""
MIN_RANGE = 1e-28
"""Smallest range of a table that float32 can compute with; values of a smaller one are scaled."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MarchInput:
    """The numbers of a task in the units of the native marcher.

    All places and directions are in vertices of the frame, x, y, z.

    Attributes:
        values: float32 (z, y, x), scaled where float32 could not compute with them.
        low, high: values of the table's ends, scaled likewise.
        levels: values of the surfaces, scaled likewise.
        eye, right, up, forward: camera of the rays, each (3,).
        box: (3, 2), the drawn box as it is clipped, in which steps are counted.
        seen: (3, 2), the part of the box in which the frame has values.
        planes: (n, 4), planes that cut the box, as `Body` has them.
        spacing: (3,), length of one vertex spacing in the coordinates.
        gradient: (3,), factors from differences between vertices to the gradients of shading.
        steepness: a gradient of shading of 1, in marched units per unit of the coordinates.
        floor: gradient at which shading has faded by half.
        smoothing: deviation of the Gaussian by which values are smoothed before shading, in
            vertices; 0 for none.
        error: largest error of a value, scaled likewise; smoothed values stay within it.
        light_offset, light_scale: a place is at place * scale + offset (3,) in the light grid.
    """

    values: Single
    low: float
    high: float
    levels: tuple[float, ...]
    eye: Floats
    right: Floats
    up: Floats
    forward: Floats
    box: Floats
    seen: Floats
    planes: Floats
    spacing: Floats
    gradient: Floats
    steepness: float
    floor: float
    smoothing: float
    error: float
    light_offset: Floats
    light_scale: float

    @classmethod
    def of(cls, frame: Frame, task: Task, bricks: Bricks) -> MarchInput:
        """The input for a task and a frame with its bricks."""
        grid, stride = task.rays.grid, float(frame.stride)
        first = np.array(frame.first[::-1], dtype=np.float64)
        least, most = bricks.value_range
        low, high = (task.table.low, task.table.high) if task.table is not None else (least, most)
        scaling = _Scaling.of(low, high, max(abs(least), abs(most)))
        low, high, least, most = map(scaling.number, (low, high, least, most))
        span, floor = flatness(low, high, least, most, scaling.width(task.noise))
        light = task.light
        box, planes = task.bounds, task.planes
        within = frame.bounds(grid)
        seen = np.stack(
            [np.maximum(within[:, 0], box[:, 0]), np.minimum(within[:, 1], box[:, 1])], axis=-1
        )
        seen[:, 1] = np.maximum(seen[:, 1], seen[:, 0])  # nothing, and no box that is turned over
        return cls(
            values=scaling.array(bricks.values),
            low=low,
            high=high if high > low else low + span,
            levels=tuple(scaling.number(surface.value) for surface in task.surfaces),
            eye=(task.rays.eye - first) / stride,
            right=task.rays.right / stride,
            up=task.rays.up / stride,
            forward=task.rays.forward / stride,
            box=(box - first[:, None]) / stride,
            seen=(seen - first[:, None]) / stride,
            planes=np.column_stack(
                [planes[:, :3], (planes[:, 3] - planes[:, :3] @ first) / stride]
            ),
            spacing=grid.spacing * stride,
            gradient=slope_scale(grid, span, least, most),
            steepness=span * scaling.unit / (stride * grid.vertex_spacing),
            floor=floor,
            smoothing=smoothing(span, scaling.width(task.noise)),
            error=scaling.width(task.error),
            light_offset=np.zeros(3) if light is None else (first - light.first) / light.cell,
            light_scale=1.0 if light is None else stride / light.cell,
        )


@dataclass(frozen=True, kw_only=True)
class _Scaling:
    """Values as value / unit - middle / unit, so that float32 can compute with them."""

    middle: float = 0.0
    unit: float = 1.0

    @classmethod
    def of(cls, low: float, high: float, magnitude: float) -> _Scaling:
        """The scaling for a table from `low` to `high` and values of at most a magnitude."""
        largest = max(magnitude, abs(low), abs(high))
        if largest <= MAX_MAGNITUDE and not 0 < high - low < MIN_RANGE:
            return cls()
        return cls(middle=low / 2 + high / 2, unit=max(high / 2 - low / 2, largest * 1e-30, 5e-324))

    def number(self, value: float) -> float:
        """Scale a value."""
        return value / self.unit - self.middle / self.unit

    def width(self, difference: float) -> float:
        """Scale a difference of two values."""
        return difference / self.unit

    def array(self, values: Single) -> Single:
        """Scale values, clipped to MAX_MAGNITUDE; without scaling the result is the same array."""
        if self == _Scaling():
            return values
        with np.errstate(over="ignore"):
            scaled = values.astype(np.float64) / self.unit - self.middle / self.unit
            return scaled.clip(-MAX_MAGNITUDE, MAX_MAGNITUDE).astype(np.float32)


def empty_table(low: float, high: float) -> Table:
    """A table of nothing, for surfaces alone."""
    return Table(
        low=low, high=high, colours=np.zeros((2, 3), dtype=np.float32), extinctions=np.zeros(2)
    )
