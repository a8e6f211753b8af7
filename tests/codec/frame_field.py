"""Frames of a few values by hand, tasks and scenes, and the streamed march of decoded frames.

Through a frame the streamed marcher must make the picture of the native one.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.bricks import Bricks
from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.march_task import NUMPY, Arrays, Frame, Marched, Table, Task
from fhash_codec.rendering.scenes import Camera
from fhash_codec.rendering.stream_march import stream
from fhash_codec.rendering.tiled_frame import FrameField


def field_of(frame: Frame, grid: Grid, arrays: Arrays = NUMPY) -> FrameField:
    """The field of a frame."""
    return FrameField(frame, Bricks.of(frame), grid, arrays)


def by_stream(frame: Frame, task: Task, bricks: Bricks, *_: object, **__: object) -> Marched:
    """A stand-in for `march_native`."""
    marched = stream(FrameField(frame, bricks, task.rays.grid), task, adaptive=True)
    # Looking up a decoded frame is not an evaluation of a model.
    return replace(marched, counters={**marched.counters, "evaluations": 0})


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


def blobs() -> np.ndarray:
    """Two blobs that move apart, (t, z, y, x) float32, about 0 .. 10."""
    t, z, y, x = np.meshgrid(*map(np.arange, (3, 20, 24, 28)), indexing="ij", sparse=True)
    first = 9 * np.exp(-((z - 9) ** 2 + (y - 10) ** 2 + (x - 9 + 2 * t) ** 2) / 14)
    second = 7 * np.exp(-((z - 12) ** 2 + (y - 14) ** 2 + (x - 19 - 2 * t) ** 2) / 10)
    return (first + second + 0.05 * np.sin(x / 3)).astype(np.float32)


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
