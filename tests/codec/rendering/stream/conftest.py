"""Arrays of torch, and small frames with a task to march through them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy.typing as npt
import pytest
from frame_field import field_of, frame_of, table_of, task_of

from fhash_codec import Renderer, Scene, Volume
from fhash_codec.rendering.frame_field import FrameField
from fhash_codec.rendering.light import light_grid
from fhash_codec.rendering.march_task import Arrays, Lighting, Surface, Task
from fhash_codec.rendering.scenes import Camera
from fhash_codec.rendering.stream_fields import Field, NetworkField
from fhash_codec.rendering.tiled_frame import decoded_frame


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
        return field_of(frame_of(values), task.rays.grid), task

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
        if volume.profile == "paper":
            return NetworkField(volume, plan.step, plan.units, arrays), task
        frame = decoded_frame(volume, plan.step, plan.lod, plan.region, plan.units)
        if plan.lights:
            light = light_grid(
                frame, task, shadows=plan.shadows, lamp=plan.lamp, ambient_occlusion=plan.occlusion
            )
            task = replace(task, light=light)
        return field_of(frame, grid, arrays), task

    return of
