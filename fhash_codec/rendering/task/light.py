"""Light that the volume itself takes away: shadows of a lamp, and of the surroundings, on a grid of points.

The extinction is averaged onto the grid; from each of its points the way to the lamp, and ways to all sides as far as the surroundings
reach, are summed up in steps of a cell. All points take the same steps, so that a step is a shift of the whole grid. Surfaces throw no
shadow.
"""

from __future__ import annotations

import ctypes
import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from fhash_codec import native
from fhash_codec.rendering.camera.camera import Grid
from fhash_codec.rendering.scene.scene import AmbientOcclusion, Shadows
from fhash_codec.rendering.task.task import Frame, LightGrid, Table, extinctions_in
from fhash_formats.errors import InputError
from fhash_formats.support.threads import in_threads

__all__ = ["light_grid"]

Floats = npt.NDArray[np.float64]
Single = npt.NDArray[np.float32]

MAX_STEPS = 16
"""From a point to the end of its surroundings."""
SIDES = np.array(
    [
        side
        for side in itertools.product((-1.0, 0.0, 1.0), repeat=3)
        if sum(map(abs, side)) in (1, 3)
    ]
)
"""Directions of the surroundings: the 6 faces and the 8 corners of a cube."""
SIDES /= np.linalg.norm(SIDES, axis=1, keepdims=True)


def light_grid(
    frame: Frame,
    grid: Grid,
    table: Table | None,
    *,
    shadows: Shadows | None = None,
    lamp: Floats | None = None,
    ambient_occlusion: AmbientOcclusion | None = None,
) -> LightGrid:
    """Shares of the light that reach places of a frame, the strengths of both effects included.

    lamp: unit vector (x, y, z) of the coordinates towards the light, for shadows. Points lie a whole number of the frame's vertices apart,
    that nearest to the resolution. Raises InputError for shadows without a lamp.
    """
    if shadows is not None and lamp is None:
        raise InputError("shadows need the direction towards a lamp")
    resolution = shadows.resolution if shadows is not None else Shadows().resolution
    across = max(1, round(resolution / frame.stride))
    first = np.array(frame.first[::-1], dtype=np.float64)
    if table is None or not table.extinctions.any():
        return LightGrid(shares=np.ones((1, 1, 1, 2), dtype=np.float32), first=first, cell=1.0)
    # In lengths of a vertex: float32 has no room for those of all coordinates.
    unit = grid.vertex_spacing
    table = replace(table, extinctions=extinctions_in(table.extinctions, unit))
    extinction = _extinction(np.ascontiguousarray(frame.values, dtype=np.float32), table, across)
    cell = float(across * frame.stride)
    shares = np.ones((*extinction.shape, 2), dtype=np.float32)
    rays = 0
    if shadows is not None and lamp is not None:
        step = np.asarray(lamp, dtype=np.float64) / (grid.spacing * cell)
        step /= np.abs(step).max()
        passed = _passed(
            extinction,
            step,
            _steps_out(step, extinction.shape),
            float(np.linalg.norm(step * grid.spacing * cell)) / unit,
        )
        shares[..., 0] = 1 - np.float32(shadows.strength) * (1 - passed)
        rays += extinction.size
    if ambient_occlusion is not None:
        count = min(max(2, round(ambient_occlusion.radius / cell)), MAX_STEPS)
        around = np.zeros(extinction.shape, dtype=np.float32)
        for side in SIDES:
            step = side * ambient_occlusion.radius / (count * cell)
            around += _passed(
                extinction, step, count, float(np.linalg.norm(step * grid.spacing * cell)) / unit
            )
        shares[..., 1] = 1 - np.float32(ambient_occlusion.strength) * (
            1 - around / np.float32(len(SIDES))
        )
        rays += extinction.size * len(SIDES)
    return LightGrid(shares=np.clip(shares, 0, 1), first=first, cell=cell, secondary_rays=rays)


def _steps_out(step: Floats, shape: tuple[int, ...]) -> int:
    """Steps after which the last point is out of the grid; step x, y, z in its cells."""
    with np.errstate(divide="ignore", over="ignore"):
        return int(np.min(np.ceil(np.array(shape[::-1]) / np.abs(step)))) + 1


def _passed(extinction: Single, step: Floats, count: int, length: float) -> Single:
    """The share of the light that passes `count` steps from each point: float32 of the grid's shape."""
    library = native.library()
    sums = np.zeros(extinction.shape, dtype=np.float32)
    if library is None:
        for number in range(count):
            _add_shifted(extinction, step * (number + 0.5), sums)
        return _left(sums, length)
    shape, along = (ctypes.c_int64 * 3)(*extinction.shape), (ctypes.c_double * 3)(*step)
    _in_layers(
        extinction.shape[0],
        lambda z: library.fhash_march_sum(
            _address(extinction),
            shape,
            along,
            ctypes.c_int64(count),
            ctypes.c_int64(z),
            ctypes.c_int64(z + 1),
            _address(sums),
        ),
    )
    return _left(sums, length)


def _left(sums: Single, length: float) -> Single:
    """exp(-length * sums), float32; in float64 where the length is beyond float32, in which infinity times 0 would be no number."""
    factor = length if length < 1e30 else np.float64(length)
    with np.errstate(over="ignore"):  # then nothing is left, as it should be
        return np.asarray(np.exp(-factor * sums), dtype=np.float32)


def _add_shifted(extinction: Single, offset: Floats, sums: Single) -> None:
    """Add what lies `offset` (x, y, z, in cells) from each point, trilinear, 0 beyond the grid."""
    whole = np.floor(offset).astype(int)[::-1]
    part = (offset - np.floor(offset))[::-1]
    shape = np.array(extinction.shape)
    begin, end = np.maximum(0, -whole), np.minimum(shape, shape - whole - (part > 0))
    if np.any(begin >= end):
        return
    to = tuple(slice(low, high) for low, high in zip(begin, end, strict=True))
    for corner in itertools.product((0, 1), repeat=3):
        weight = np.prod(np.where(corner, part, 1 - part))
        if weight > 0:
            moved = zip(begin + whole + corner, end + whole + corner, strict=True)
            sums[to] += (
                np.float32(weight) * extinction[tuple(slice(low, high) for low, high in moved)]
            )


def _extinction(values: Single, table: Table, across: int) -> Single:
    """Extinctions on a grid with a point every `across` vertices, the mean of those around it weighed by a tent."""
    points = tuple(-(-(size - 1) // across) + 1 for size in values.shape)
    library = native.library()
    last = len(table.extinctions) - 1
    if library is None:
        found = np.interp(
            np.nan_to_num(values), np.linspace(table.low, table.high, last + 1), table.extinctions
        )
        extinction = np.where(np.isnan(values), 0, found)
        for axis, count in enumerate(points):
            places = np.arange(count)[:, None] * across + np.arange(1 - across, across)
            weights = (across - np.abs(np.arange(1 - across, across))) / across**2
            parts = np.take(extinction, np.clip(places, 0, values.shape[axis] - 1), axis=axis)
            extinction = np.tensordot(parts, weights, axes=([axis + 1], [0]))
        return extinction.astype(np.float32)
    out = np.empty(points, dtype=np.float32)
    entries = np.append(table.extinctions, table.extinctions[-1]).astype(np.float32)
    shape, sizes = (ctypes.c_int64 * 3)(*values.shape), (ctypes.c_int64 * 3)(*points)

    def layer(z: int) -> None:
        scratch = np.empty(values.shape[2], dtype=np.float32)
        library.fhash_march_extinction(
            _address(values),
            shape,
            _address(entries),
            ctypes.c_int64(last + 1),
            ctypes.c_double(table.low),
            ctypes.c_double(last / (table.high - table.low)),
            ctypes.c_int64(across),
            sizes,
            ctypes.c_int64(z),
            ctypes.c_int64(z + 1),
            _address(out),
            _address(scratch),
        )

    _in_layers(points[0], layer)
    return out


def _in_layers(count: int, function: Callable[[int], object]) -> None:
    list(in_threads(function, range(count)))


def _address(array: Single) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)
