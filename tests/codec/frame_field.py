"""A field of a decoded frame, for the streamed marcher: the reference of the native one.

The streamed marcher is for networks. Through a frame it must make the picture of the native one,
and frames of a few values by hand show what it does.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.bricks import Bricks, Palette
from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.light import flatness, smoothing
from fhash_codec.rendering.march_task import NUMPY, Array, Arrays, Frame, Marched, Table, Task
from fhash_codec.rendering.scenes import Camera
from fhash_codec.rendering.stream_fields import CORNERS, _of_cells, central_slopes
from fhash_codec.rendering.stream_march import stream


class FrameField:
    """A decoded frame, trilinear between its vertices.

    A place has no value where a vertex of weight around it has none.
    """

    def __init__(self, frame: Frame, grid: Grid, arrays: Arrays = NUMPY) -> None:
        bricks = Bricks.of(frame)
        self.arrays, self.bricks, self.frame = arrays, bricks, frame
        self._stride, first = float(frame.stride), np.array(frame.first[::-1], dtype=np.float64)
        counts = np.array(frame.values.shape[::-1])
        self.bounds, self.first = arrays.array(frame.bounds(grid)), arrays.array(first)
        self.vertices = arrays.array(
            np.stack([first, first + (counts - 1) * frame.stride], axis=-1)
        )
        self._last = arrays.array(counts - 1.0)
        self._last_cell = arrays.array(np.maximum(counts - 2.0, 0.0))
        self._jumps = (1, int(counts[0]), int(counts[0] * counts[1]))
        self._wide = [bool(count > 1) for count in counts]
        with arrays.guarded():
            self._values = arrays.array(bricks.values)
        self._flat = self._values.reshape(-1)

    def visible(self, palette: Palette) -> Array:
        arrays, xp = self.arrays, self.arrays.xp
        layers = max(1, arrays.batch // self._jumps[2])
        visible = []
        for start in range(0, max(len(self._values) - 1, 1), layers):
            values = self._values[start : start + layers + 1]
            low, high = (
                arrays.to_float64(_of_cells(values, extreme)) for extreme in (xp.fmin, xp.fmax)
            )
            visible.append(palette.visible(low, high))
        return xp.concatenate(visible)

    def values(self, places: Array, wanted: Array | None = None) -> Array:
        result = self.arrays.empty((len(places),))
        for start in range(0, len(places), self.arrays.batch):
            part = slice(start, start + self.arrays.batch)
            inside, low, share = self._located(places[part], self._last)
            if wanted is not None:
                inside &= wanted[part]
            # The corner after a place counts only where it has weight: a missing vertex beyond a
            # place on a vertex does not matter.
            jumps = [
                self.arrays.to_int64(share[:, axis] > 0) * jump
                for axis, jump in enumerate(self._jumps)
            ]
            corners = self._corners(low, jumps)
            along = corners[:, :, 0] + share[:, 0] * (corners[:, :, 1] - corners[:, :, 0])
            across = along[:, 0] + share[:, 1] * (along[:, 1] - along[:, 0])
            values = across[0] + share[:, 2] * (across[1] - across[0])
            result[start : start + len(values)] = self.arrays.xp.where(inside, values, np.nan)
        return result

    def slopes(self, places: Array) -> Array:
        """Derivatives as `Field` has them; between two cells those of the cell after the border."""
        xp = self.arrays.xp
        result = self.arrays.empty((len(places), 3))
        for start in range(0, len(places), self.arrays.batch):
            _, low, share = self._located(
                places[start : start + self.arrays.batch], self._last_cell
            )
            corners = self._corners(
                low,
                [jump if wide else 0 for jump, wide in zip(self._jumps, self._wide, strict=True)],
            )
            x, y, z = share.T
            by_x = corners[:, :, 1] - corners[:, :, 0]
            along = corners[:, :, 0] + x * by_x
            by_y = along[:, 1] - along[:, 0]
            across = along[:, 0] + y * by_y
            by_x = by_x[:, 0] + y * (by_x[:, 1] - by_x[:, 0])
            slopes = xp.stack(
                [
                    by_x[0] + z * (by_x[1] - by_x[0]),
                    by_y[0] + z * (by_y[1] - by_y[0]),
                    across[1] - across[0],
                ],
                axis=-1,
            )
            slopes = xp.nan_to_num(slopes, nan=0.0, posinf=0.0, neginf=0.0)
            result[start : start + len(slopes)] = slopes / self._stride
        return result

    def _located(self, places: Array, last_before: Array) -> tuple[Array, Array, Array]:
        """Whether places lie within the bounds, and the vertices around them.

        last_before: (3,), the last vertex (x, y, z) that may be the one before a place.
        Returns a mask (n,), the numbers (n,) of the vertices before the places, and the weights
        (n, 3) of the vertices after them.
        """
        arrays, xp, last = self.arrays, self.arrays.xp, self._last
        inside = xp.all((places >= self.bounds[:, 0]) & (places <= self.bounds[:, 1]), axis=1)
        at = xp.clip((places - self.first) / self._stride, 0 * last, last)
        before = xp.minimum(xp.floor(at), last_before)
        x, y, z = arrays.to_int64(before).T
        return inside, x + y * self._jumps[1] + z * self._jumps[2], at - before

    def _corners(self, low: Array, jumps: list[Array] | list[int]) -> Array:
        """Values (z 2, y 2, x 2, n) around places.

        low: numbers (n,) of the vertices before the places.
        jumps: steps along x, y and z to the vertices after them, (n,) or one number for all.
        """
        corners = self.arrays.empty((2, 2, 2, len(low)))
        for corner in CORNERS:
            corners[corner] = self.arrays.xp.take(self._flat, low + _jump(corner, jumps))
        return corners


def _jump(corner: tuple[int, ...], jumps: list[Array] | list[int]) -> Array | int:
    """The step in a flat array to a corner (z, y, x); jumps: steps along x, y and z."""
    return sum(jump for up, jump in zip(corner[::-1], jumps, strict=True) if up)


class Smoothed(FrameField):
    """A frame that is shaded by central differences of smoothed values, as `task.noise` asks."""

    def __init__(self, frame: Frame, grid: Grid, deviation: float, error: float) -> None:
        super().__init__(frame, grid)
        values = self.bricks.smoothed(deviation, error)
        self._smooth = FrameField(replace(frame, values=values), grid)

    def slopes(self, places: Array) -> Array:
        return central_slopes(self._smooth, places)


def streamed(frame: Frame, task: Task) -> Marched:
    """The picture of the streamed marcher, which knows no bricks of coarse frames."""
    grid, task = task.rays.grid, replace(task, skipping=task.skipping and frame.stride == 1)
    field = FrameField(frame, grid)
    if task.lighting is not None:
        least, most = field.bricks.value_range
        low, high = (least, most) if task.table is None else (task.table.low, task.table.high)
        deviation = smoothing(flatness(low, high, least, most, task.noise)[0], task.noise)
        if deviation > 0:
            assert task.grading is None, "the gradients of grading are not smoothed"
            field = Smoothed(frame, grid, deviation, task.error)
            task = replace(task, lighting=replace(task.lighting, central=False))
    marched = stream(field, task, adaptive=True)
    # Looking up a decoded frame is not an evaluation of a model.
    return replace(marched, counters={**marched.counters, "evaluations": 0})


def by_stream(
    library: object, frame: Frame, task: Task, *_: object, progress: object = None
) -> Marched:
    """A stand-in for `march_native`."""
    return streamed(frame, task)


def frame_of(values: npt.ArrayLike, **place: Any) -> Frame:
    """A frame of all vertices, or of those at a place."""
    return Frame(values=np.asarray(values, dtype=np.float32), **{"first": (0, 0, 0), **place})


def grid_of(shape: tuple[int, ...], spacing: tuple[float, ...] = (1.0, 1.0, 1.0)) -> Grid:
    """The grid of a domain (z, y, x) with a spacing (x, y, z)."""
    return Grid(counts=tuple(shape[::-1]), origin=np.zeros(3), spacing=np.array(spacing))


def table_of(
    extinctions: npt.ArrayLike,
    low: float = 0.0,
    high: float = 1.0,
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> Table:
    """A table of extinctions from one value to another, all of one colour."""
    extinctions = np.asarray(extinctions, dtype=np.float64)
    colours = np.tile(np.float32(colour), (len(extinctions), 1))
    return Table(low=low, high=high, colours=colours, extinctions=extinctions)


def task_of(
    shape: tuple[int, ...],
    table: Table | None,
    spacing: tuple[float, ...] = (1.0, 1.0, 1.0),
    *,
    camera: Camera | None = None,
    size: tuple[int, int] = (8, 8),
    **more: Any,
) -> Task:
    """A task for a domain (z, y, x), seen along z."""
    front = Camera(view="xy", projection="parallel")
    rays = Rays.of(front if camera is None else camera, grid_of(shape, spacing), size)
    return Task(rays=rays, table=table, **{"step": 0.5, "threshold": 0.0, **more})


def waves(shape: tuple[int, ...] = (20, 17, 30), pace: float = 1.0) -> np.ndarray:
    """Waves across all axes, (z, y, x) float32, 0..1."""
    z, y, x = np.meshgrid(*(np.linspace(0, pace, size) for size in shape), indexing="ij")
    values = 0.5 + 0.25 * np.sin(7 * x + 3 * y) + 0.25 * np.cos(5 * y - 6 * z + 2 * x)
    return values.astype(np.float32)


CENTRAL: dict[str, Any] = {
    "effects": {
        "shading": {"light": [1, 2, 3], "gradient": "central"},
        "isosurfaces": [{"value": 5, "opacity": 0.5}],
        "buffers": ["depth", "normal"],
    }
}
"""A scene with gradients by central differences."""

SCENES: dict[str, dict[str, Any]] = {
    "plain": {},
    "shaded": {"effects": {"shading": {"light": [1, 2, 3]}}},
    "surfaces": {
        "effects": {
            "isosurfaces": [{"value": 3, "opacity": 0.4}, {"value": 6}],
            "buffers": ["depth", "normal"],
        }
    },
    "surfaces alone": {
        "transfer_function": {"nothing": True},
        "effects": {"isosurfaces": [{"value": 5}]},
    },
    "maximum": {"effects": {"maximum_intensity": True, "buffers": ["depth"]}},
    "maximum and surface": {
        "effects": {"maximum_intensity": True, "isosurfaces": [{"value": 5, "opacity": 0.5}]}
    },
    "minimum": {"effects": {"minimum_intensity": True, "buffers": ["depth"]}},
    "average": {"effects": {"average_intensity": True, "buffers": ["depth"]}},
    "attenuated": {"effects": {"attenuated_maximum_intensity": {"attenuation": 0.3}}},
    "average and surface": {
        "effects": {"average_intensity": True, "isosurfaces": [{"value": 5, "opacity": 0.5}]}
    },
    "graded": {"transfer_function": {"gradient_opacity": [[0.02, 0], [0.15, 1]]}},
    "graded and lit": {
        "transfer_function": {"gradient_opacity": [[0, 1], [0.1, 0.2]]},
        "effects": {
            "shadows": True,
            "ambient_occlusion": True,
            "isosurfaces": [{"value": 5, "opacity": 0.5}],
        },
    },
    "graded by central differences": {
        "transfer_function": {"gradient_opacity": [[0, 0.1], [0.05, 1], [0.1, 0]]},
        "effects": {"shading": {"gradient": "central"}},
    },
    "clipped": {
        "effects": {
            "clip": {"x": [4.3, 20], "z": [None, 11]},
            "shading": True,
            "buffers": ["depth", "normal"],
        }
    },
    "clipped by planes": {
        "effects": {
            "clip": {
                "planes": [
                    {"normal": [1, 1, 0.5], "point": [12, 10, 9]},
                    {"normal": [0, -1, 0], "offset": -17.5},
                ]
            },
            "shadows": True,
            "isosurfaces": [{"value": 5, "opacity": 0.5}],
        }
    },
    "jitter": {"effects": {"jitter": True, "antialiasing": 2}},
    "narrow": {
        "transfer_function": {"opacity": [[4, 0], [4.5, 0.9], [5, 0]]},
        "effects": {"buffers": ["depth", "normal"]},
    },
    "opaque": {"transfer_function": {"opacity": [[2, 0], [4, 1]]}},
    "inside": {"camera": {"position": [9, 10, 9], "focal_point": [20, 14, 12]}},
    "shadows": {"effects": {"shadows": True}},
    "all light": {
        "effects": {
            "shadows": True,
            "ambient_occlusion": True,
            "shading": True,
            "isosurfaces": [{"value": 5, "opacity": 0.5}],
        }
    },
    "parallel": {"camera": {"view": "xy", "projection": "parallel"}, "effects": {"shading": True}},
    "between": {"step": 0.5},
    "zoomed": {"camera": {"zoom": 8}},
    "unskipped": {"march": {"skipping": False}},
    "long steps": {"march": {"step": 20}, "effects": {"isosurfaces": [{"value": 5}]}},
    "central": CENTRAL,
}
"""Scenes by name: one for each thing that a march may do differently."""

NETWORK_SCENES: dict[str, dict[str, Any]] = {
    **{name: SCENES[name] for name in ("plain", "maximum", "minimum", "average", "unskipped")},
    "between": {"step": 0.7, "effects": {"shading": True, "buffers": ["depth", "normal"]}},
    "surfaces": {
        "effects": {
            "isosurfaces": [{"value": 5, "opacity": 0.5}, {"value": 7}],
            "antialiasing": 2,
            "jitter": True,
        }
    },
    "attenuated": {"effects": {"attenuated_maximum_intensity": True}},
    "graded": {"transfer_function": {"gradient_opacity": [[0, 0], [0.2, 1]]}},
    "clipped": {
        "effects": {"clip": {"x": [4.3, 20], "planes": [{"normal": [0, 1, 1], "offset": 20}]}}
    },
    "central": CENTRAL,
}
"""Scenes of a network."""
