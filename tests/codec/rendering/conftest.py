"""A small series as a file, of all of it, of a feature and of a network; frames and their tasks."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from emulated_cuda import EmulatedDevice
from frame_field import blobs, by_stream, field_of, frame_of, table_of, task_of
from rarely import rarely

import fhash_codec
from fhash_codec import EncodeConfig, Renderer, Scene, Volume
from fhash_codec.rendering.image import Image
from fhash_codec.rendering.light import light_grid
from fhash_codec.rendering.march import march_native
from fhash_codec.rendering.march_device import DeviceMarcher
from fhash_codec.rendering.march_task import Arrays, Lighting, Marched, Surface, Task
from fhash_codec.rendering.scenes import Camera
from fhash_codec.rendering.stream_fields import Field, NetworkField
from fhash_codec.rendering.tiled_frame import FrameField, decoded_frame


@pytest.fixture(scope="session")
def kernels_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the emulated kernels, each compiled once for all processes of the tests."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "kernels"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture
def emulated_marcher(kernels_folder: Path) -> DeviceMarcher:
    """A device that draws, emulated on the processor; skipped without g++."""
    return DeviceMarcher(EmulatedDevice(kernels_folder), threads=32)


@pytest.fixture(params=["native", "streamed", *rarely("kernels")])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The marchers through a decoded frame: on the processor, streamed, and on a device."""
    place = "fhash_codec.rendering.march.march_native"
    if request.param == "streamed":
        monkeypatch.setattr(place, by_stream)
    if request.param == "kernels":
        marcher = request.getfixturevalue("emulated_marcher")

        def on_device(*arguments: Any, **settings: Any) -> Marched:
            return march_native(*arguments, **{**settings, "device": marcher})

        monkeypatch.setattr(place, on_device)
    return str(request.param)


CONFIGS = {
    "compact": EncodeConfig(effort=1),
    "feature": EncodeConfig(effort=1, features=("interval:3:99",), dilation=0),
    "paper": EncodeConfig(
        preset="published", tables="float16", features=("interval:3:99",), epochs=15, width=16
    ),
}


class Files(dict[str, Path]):
    """Paths by kind of CONFIGS; a file is encoded when it is first asked for."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = folder

    def __missing__(self, kind: str) -> Path:
        path = self.folder / f"{kind}.fhz"
        fhash_codec.encode(blobs(), path, CONFIGS[kind])
        self[kind] = path
        return path


@pytest.fixture(scope="session")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Paths by kind: compact, feature, paper."""
    return Files(tmp_path_factory.mktemp("pictures"))


@pytest.fixture
def volume(files: dict[str, Path]) -> Iterator[Volume]:
    """The compact file, opened."""
    with fhash_codec.open(files["compact"]) as opened:
        yield opened


@pytest.fixture
def renderer(volume: Volume) -> Renderer:
    """A renderer of the compact file."""
    return Renderer(volume)


@pytest.fixture
def tensors() -> Arrays:
    """torch's arrays on the processor: what marches on CUDA marches here too."""
    import torch

    from fhash_codec.rendering.torch_arrays import TorchArrays

    return TorchArrays(torch.device("cpu"))


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


class Drawing:
    """Draws flat pictures that tell step, camera and size, and notes what it was asked for."""

    def __init__(self) -> None:
        self.scenes: list[Scene] = []
        self.upcoming: list[Scene | None] = []

    def __call__(self, scene: Scene, *, upcoming: Scene | None = None) -> Image:
        self.scenes.append(scene)
        self.upcoming.append(upcoming)
        width, height = scene.size
        rgba = np.ones((height, width, 4), dtype=np.float32)
        rgba[..., 0] = (scene.step or 0) / 10
        rgba[..., 1] = scene.camera.azimuth % 360 / 360
        return Image(
            rgba=rgba, counters={"rays": width * height}, scene=scene.to_dict(), seconds=0.5
        )


@pytest.fixture
def drawing() -> type[Drawing]:
    """The class that stands for a renderer."""
    return Drawing
