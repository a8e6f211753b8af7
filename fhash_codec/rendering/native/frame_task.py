"""A task in the vertices of a frame, as the native library takes it, and what a gradient counts as."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.task.bricks import Bricks
from fhash_codec.rendering.task.slopes import flatness, slope_scale
from fhash_codec.rendering.task.task import Frame, Table, Task

__all__ = ["MarchInput", "empty_table"]

Floats = npt.NDArray[np.float64]

LARGEST, SMALLEST = 1e36, 1e-28
"""Magnitude and range of values that float32 can compute with; others are scaled."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MarchInput:
    """All places and directions are in vertices of the frame, x, y, z.

    Attributes:
        values: float32 (z, y, x), scaled if float32 could not compute with them. low, high: ends of the table, scaled likewise.
        levels: values of the surfaces, scaled likewise.
        eye, right, up, forward: of the rays. box: (3, 2), in which steps are counted. seen: what of it the frame has values of.
        spacing: length of one vertex spacing. gradient: factors (3,) from differences between vertices to what is shaded by.
        floor: magnitude of that at which light from a direction is half gone. light_offset, light_scale: from places to light grid.
    """

    values: npt.NDArray[np.float32]
    low: float
    high: float
    levels: tuple[float, ...]
    eye: Floats
    right: Floats
    up: Floats
    forward: Floats
    box: Floats
    seen: Floats
    spacing: Floats
    gradient: Floats
    floor: float
    light_offset: Floats
    light_scale: float

    @classmethod
    def of(cls, frame: Frame, task: Task, bricks: Bricks) -> MarchInput:
        """From a frame, its bricks and a task."""
        grid, stride = task.rays.grid, float(frame.stride)
        first = np.array(frame.first[::-1], dtype=np.float64)
        spacing = grid.spacing * stride
        least, most = bricks.value_range
        low, high = (task.table.low, task.table.high) if task.table is not None else (least, most)
        values, middle, unit = bricks.values, 0.0, 1.0
        largest = max(abs(least), abs(most), abs(low), abs(high))
        if largest > LARGEST or 0 < high - low < SMALLEST:
            middle, unit = low / 2 + high / 2, max(high / 2 - low / 2, largest * 1e-30, 5e-324)
            with np.errstate(over="ignore"):
                values = (
                    (bricks.values.astype(np.float64) / unit - middle / unit)
                    .clip(-LARGEST, LARGEST)
                    .astype(np.float32)
                )
        low, high, least, most = (
            number / unit - middle / unit for number in (low, high, least, most)
        )
        span, floor = flatness(low, high, least, most)
        light = task.light
        return cls(
            values=values,
            low=low,
            high=high if high > low else low + span,
            levels=tuple(surface.value / unit - middle / unit for surface in task.surfaces),
            eye=(task.rays.eye - first) / stride,
            right=task.rays.right / stride,
            up=task.rays.up / stride,
            forward=task.rays.forward / stride,
            box=(grid.bounds - first[:, None]) / stride,
            seen=(frame.bounds(grid) - first[:, None]) / stride,
            spacing=spacing,
            gradient=slope_scale(grid, span, least, most),
            floor=floor,
            light_offset=np.zeros(3) if light is None else (first - light.first) / light.cell,
            light_scale=1.0 if light is None else stride / light.cell,
        )


def empty_table(low: float, high: float) -> Table:
    """A table of nothing, for surfaces alone."""
    return Table(
        low=low, high=high, colours=np.zeros((2, 3), dtype=np.float32), extinctions=np.zeros(2)
    )
