"""Arrays of torch, and small frames with a task to march through them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy.typing as npt
import pytest
from frame_field import FrameField, frame_of, table_of, task_of

from fhash_codec import Renderer, Scene, Volume
from fhash_codec.rendering.light import light_grid
from fhash_codec.rendering.march_task import Arrays, Lighting, Surface, Task
from fhash_codec.rendering.renderer import decoded_frame
from fhash_codec.rendering.scenes import Camera
from fhash_codec.rendering.stream_fields import Field, NetworkField


@pytest.fixture
def frame_task() -> Callable[..., tuple[FrameField, Task]]:
    """A function that gives a field of values and a task of 8 x 8 parallel rays along z.

    fog: extinction everywhere. surfaces: lit by ambient light alone.
    """

    def of(
        values: npt.NDArray[Any],
        *,
        step: float = 0.5,
        surfaces: tuple[Surface, ...] = (),
        fog: float = 0.0,
    ) -> tuple[FrameField, Task]:
        ambient = Lighting(ambient=1.0, diffuse=0.0, specular=0.0, specular_power=1.0, lamp=None)
        task = task_of(
            values.shape,
            table_of([fog, fog]) if fog else None,
            camera=Camera(view="xy", projection="parallel", parallel_scale=2.0),
            step=step,
            surfaces=surfaces,
            lighting=ambient if surfaces else None,
        )
        return FrameField(frame_of(values), task.rays.grid), task

    return of


@pytest.fixture
def planned() -> Callable[[Volume, dict[str, Any], Arrays], tuple[Field, Task]]:
    """A function that gives a scene's task and the field for it, in arrays of one kind."""

    def of(volume: Volume, scene: dict[str, Any], arrays: Arrays) -> tuple[Field, Task]:
        plan = Renderer(volume).plan(
            Scene.from_dict(
                {"size": [40, 34], **scene, "march": {"lod": 0, **scene.get("march", {})}}
            )
        )
        task, grid = plan.task, plan.task.rays.grid
        # The noise of coding smooths what the native marcher alone shades.
        task = replace(task, noise=0.0, error=0.0)
        if volume.profile == "paper":
            return NetworkField(volume, plan.step, plan.units, arrays), task
        frame = decoded_frame(volume, plan.step, plan.lod, plan.region, plan.units)
        if plan.lights:
            light = light_grid(
                frame, task, shadows=plan.shadows, lamp=plan.lamp, ambient_occlusion=plan.occlusion
            )
            task = replace(task, light=light)
        return FrameField(frame, grid, arrays), task

    return of


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
    "plain": {},
    "between": {"step": 0.7, "effects": {"shading": True, "buffers": ["depth", "normal"]}},
    "surfaces": {
        "effects": {
            "isosurfaces": [{"value": 5, "opacity": 0.5}, {"value": 7}],
            "antialiasing": 2,
            "jitter": True,
        }
    },
    "maximum": {"effects": {"maximum_intensity": True}},
    "minimum": {"effects": {"minimum_intensity": True}},
    "average": {"effects": {"average_intensity": True}},
    "attenuated": {"effects": {"attenuated_maximum_intensity": True}},
    "graded": {"transfer_function": {"gradient_opacity": [[0, 0], [0.2, 1]]}},
    "clipped": {
        "effects": {"clip": {"x": [4.3, 20], "planes": [{"normal": [0, 1, 1], "offset": 20}]}}
    },
    "central": CENTRAL,
    "unskipped": {"march": {"skipping": False}},
}
"""Scenes of a network."""


@pytest.fixture(params=SCENES)
def scene(request: pytest.FixtureRequest) -> dict[str, Any]:
    """A scene of each kind."""
    return SCENES[request.param]


@pytest.fixture(params=NETWORK_SCENES)
def network_scene(request: pytest.FixtureRequest) -> dict[str, Any]:
    """A scene of each kind, of a network."""
    return NETWORK_SCENES[request.param]


@pytest.fixture
def central_scene() -> dict[str, Any]:
    """A scene with gradients by central differences."""
    return CENTRAL
