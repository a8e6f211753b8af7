"""The light that the volume takes away: shadows of a lamp, and occlusion of the surroundings.

Both are computed on a grid of points. The extinction is averaged onto the grid. From each point the
extinction is summed up along the way to the lamp, and along ways to all sides as far as the
surroundings reach, in steps of a cell. All points take the same steps, so that a step is a shift of
the whole grid. Surfaces throw no shadow.
"""

from __future__ import annotations

import ctypes
import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from fhash_codec import native
from fhash_codec.rendering.camera.camera import Grid
from fhash_codec.rendering.camera.clip import Body
from fhash_codec.rendering.scene.scene import AmbientOcclusion, Shadows
from fhash_codec.rendering.task.bricks import Bricks
from fhash_codec.rendering.task.slopes import factors_at_vertices
from fhash_codec.rendering.task.task import Frame, Grading, LightGrid, Table, extinctions_in
from fhash_formats.errors import InputError
from fhash_formats.support.threads import in_threads

__all__ = ["light_grid"]

Floats = npt.NDArray[np.float64]
Single = npt.NDArray[np.float32]
Result = TypeVar("Result")

MAX_STEPS = 16
"""Steps from a point to the end of its surroundings, at most."""
SIDES = np.array(
    [
        side
        for side in itertools.product((-1.0, 0.0, 1.0), repeat=3)
        if sum(map(abs, side)) in (1, 3)
    ]
)
"""Unit vectors towards the surroundings: the 6 faces and the 8 corners of a cube."""
SIDES /= np.linalg.norm(SIDES, axis=1, keepdims=True)


def light_grid(
    frame: Frame,
    grid: Grid,
    table: Table | None,
    *,
    shadows: Shadows | None = None,
    lamp: Floats | None = None,
    ambient_occlusion: AmbientOcclusion | None = None,
    body: Body | None = None,
    grading: Grading | None = None,
    bricks: Bricks | None = None,
) -> LightGrid:
    """Shares of the light that reach places of a frame, the strengths of both effects included.

    The light does not depend on the camera, but for a lamp that moves with it.

    The points of the grid lie a whole number of the frame's vertices apart, as near to the
    resolution of the shadows as that allows.

    lamp: unit vector (x, y, z) of the coordinates towards the light, for shadows.
    body: what a clip leaves; nothing outside it takes light away. All if None.
    grading: opacity by gradient; what it leaves of the extinction takes light away.
    bricks: of the frame. They keep what the next picture needs again; None keeps nothing.
    Raises InputError for shadows without a lamp.
    """
    if shadows is not None and lamp is None:
        raise InputError("shadows need the direction towards a lamp")
    resolution = shadows.resolution if shadows is not None else Shadows().resolution
    across = max(1, round(resolution / frame.stride))
    if table is None or not table.extinctions.any():
        first = np.array(frame.first[::-1], dtype=np.float64)
        return LightGrid(shares=np.ones((1, 1, 1, 2), dtype=np.float32), first=first, cell=1.0)
    # In lengths of a vertex: float32 has no room for those of all coordinates.
    unit = grid.vertex_spacing
    table = replace(table, extinctions=extinctions_in(table.extinctions, unit))
    cell = float(across * frame.stride)
    kept = _Kept(
        bricks,
        (
            *(table.low, table.high, table.extinctions.tobytes(), across, grid.spacing.tobytes()),
            None if body is None else (body.bounds.tobytes(), body.planes.tobytes()),
            None if grading is None else (grading.top, grading.factors.tobytes()),
        ),
    )
    extinction, first = kept(
        "extinction", (), lambda: _extinction_of(frame, grid, table, across, body, grading)
    )
    points = _Points(extinction=extinction, spacing=grid.spacing, cell=cell, unit=unit)
    shares = np.ones((*extinction.shape, 2), dtype=np.float32)
    rays = 0
    if shadows is not None and lamp is not None:
        passed = kept("lamp", lamp.tobytes(), lambda: points.from_lamp(lamp))
        shares[..., 0] = 1 - np.float32(shadows.strength) * (1 - passed)
        rays += extinction.size
    if ambient_occlusion is not None:
        radius = ambient_occlusion.radius
        around = kept("around", radius, lambda: points.from_around(radius))
        shares[..., 1] = 1 - np.float32(ambient_occlusion.strength) * (1 - around)
        rays += extinction.size * len(SIDES)
    return LightGrid(shares=np.clip(shares, 0, 1), first=first, cell=cell, secondary_rays=rays)


@dataclass(frozen=True)
class _Kept:
    """The light of one transfer function that bricks keep; without bricks nothing is kept."""

    bricks: Bricks | None
    key: tuple[object, ...]

    def __call__(self, kind: str, key: object, compute: Callable[[], Result]) -> Result:
        """The result of a function, as `Bricks.remembered` has it; the last one of each kind."""
        if self.bricks is None:
            return compute()
        return self.bricks.remembered(f"light: {kind}", (*self.key, key), compute, most=1)


def _extinction_of(
    frame: Frame,
    grid: Grid,
    table: Table,
    across: int,
    body: Body | None,
    grading: Grading | None,
) -> tuple[Single, Floats]:
    """Extinctions on the grid with a point every `across` vertices, and the first point (x, y, z).

    Gradients are those of the whole frame: a clip makes none.
    """
    values = np.ascontiguousarray(frame.values, dtype=np.float32)
    factors = None
    if grading is not None:
        factors = factors_at_vertices(values, grading, grid.spacing * frame.stride)
    if body is not None:
        frame, spans = _clipped(frame, body)
        values = np.ascontiguousarray(frame.values, dtype=np.float32)
        factors = None if factors is None else np.ascontiguousarray(factors[spans])
    first = np.array(frame.first[::-1], dtype=np.float64)
    return _extinction(values, table, across, factors), first


def _clipped(frame: Frame, body: Body) -> tuple[Frame, tuple[slice, ...]]:
    """The vertices around a body alone, without values at those outside it, and their spans."""
    first, stride = np.array(frame.first), frame.stride
    low, high = body.extent[::-1].T
    start = np.clip(np.floor((low - first) / stride), 0, np.array(frame.values.shape) - 1)
    stop = np.clip(np.ceil((high - first) / stride) + 1, start + 1, frame.values.shape)
    spans = tuple(slice(int(begin), int(end)) for begin, end in zip(start, stop, strict=True))
    places = np.meshgrid(
        *(
            begin + np.arange(span.start, span.stop) * stride
            for begin, span in zip(first, spans, strict=True)
        ),
        indexing="ij",
    )
    inside = body.holds(np.stack(places[::-1], axis=-1).astype(np.float64))
    z, y, x = (int(begin + span.start * stride) for begin, span in zip(first, spans, strict=True))
    values = np.where(inside, frame.values[spans], np.float32(np.nan))
    return Frame(values=values, first=(z, y, x), stride=stride), spans


@dataclass(frozen=True, kw_only=True, eq=False)
class _Points:
    """The points of a light grid.

    Attributes:
        extinction: float32 (z, y, x), per `unit`.
        spacing: (3,), x, y, z, distance of two vertices of the domain, in the coordinates.
        cell: vertices of the domain from one point to the next.
        unit: length in the coordinates.
    """

    extinction: Single
    spacing: Floats
    cell: float
    unit: float

    def from_lamp(self, lamp: Floats) -> Single:
        """Shares of a lamp's light that reach the points; lamp: unit vector towards it."""
        step = np.asarray(lamp, dtype=np.float64) / (self.spacing * self.cell)
        step /= np.abs(step).max()
        return self._passed(step, _steps_out(step, self.extinction.shape))

    def from_around(self, radius: float) -> Single:
        """Shares of the light that reaches the points from as far as `radius`, in vertices."""
        count = min(max(2, round(radius / self.cell)), MAX_STEPS)
        around = np.zeros(self.extinction.shape, dtype=np.float32)
        for side in SIDES:
            around += self._passed(side * radius / (count * self.cell), count)
        return around / np.float32(len(SIDES))

    def _passed(self, step: Floats, count: int) -> Single:
        """Share of the light that passes `count` steps (x, y, z, in cells) from each point."""
        sums = _sums(self.extinction, step, count)
        return _left(sums, float(np.linalg.norm(step * self.spacing * self.cell)) / self.unit)


def _steps_out(step: Floats, shape: tuple[int, ...]) -> int:
    """Steps after which every point has left the grid; step: x, y, z in its cells."""
    with np.errstate(divide="ignore", over="ignore"):
        return int(np.min(np.ceil(np.array(shape[::-1]) / np.abs(step)))) + 1


def _sums(extinction: Single, step: Floats, count: int) -> Single:
    """Sums of the extinction in the middle of `count` steps from each point."""
    library = native.library()
    sums = np.zeros(extinction.shape, dtype=np.float32)
    shape, along = (ctypes.c_int64 * 3)(*extinction.shape), (ctypes.c_double * 3)(*step)
    _in_layers(
        extinction.shape[0],
        lambda z: library.fhash_march_sum(
            extinction.ctypes.data, shape, along, count, z, z + 1, sums.ctypes.data
        ),
    )
    return sums


def _left(sums: Single, length: float) -> Single:
    """Shares of the light that are left, exp(-length * sums), float32.

    A length beyond float32 is multiplied in float64, since infinity times 0 would be NaN.
    """
    factor = length if length < 1e30 else np.float64(length)
    with np.errstate(over="ignore"):  # then nothing is left, as it should be
        return np.asarray(np.exp(-factor * sums), dtype=np.float32)


def _extinction(values: Single, table: Table, across: int, factors: Single | None = None) -> Single:
    """Extinctions on a grid with a point every `across` vertices.

    Each is the mean of the vertices around the point, weighed by a tent, and times its factor.
    """
    points = tuple(-(-(size - 1) // across) + 1 for size in values.shape)
    library = native.library()
    last = len(table.extinctions) - 1
    out = np.empty(points, dtype=np.float32)
    entries = np.append(table.extinctions, table.extinctions[-1]).astype(np.float32)
    shape, sizes = (ctypes.c_int64 * 3)(*values.shape), (ctypes.c_int64 * 3)(*points)

    def layer(z: int) -> None:
        scratch = np.empty(values.shape[2], dtype=np.float32)
        library.fhash_march_extinction(
            values.ctypes.data,
            shape,
            entries.ctypes.data,
            last + 1,
            table.low,
            last / (table.high - table.low),
            across,
            sizes,
            z,
            z + 1,
            None if factors is None else factors.ctypes.data,
            out.ctypes.data,
            scratch.ctypes.data,
        )

    _in_layers(points[0], layer)
    return out


def _in_layers(count: int, function: Callable[[int], object]) -> None:
    """Call a function of the layers 0 .. count - 1 in several threads."""
    list(in_threads(function, range(count)))
