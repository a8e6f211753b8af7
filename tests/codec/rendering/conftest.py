"""A small series as a file, of all of it, of a feature and of a network, for pictures."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from frame_field import blobs, by_stream

import fhash_codec
from fhash_codec import EncodeConfig, Renderer, Scene, Volume
from fhash_codec.rendering.image import Image
from fhash_codec.rendering.march_task import Arrays


@pytest.fixture(params=["native", "streamed"])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Both marchers through a decoded frame: the native one, and the streamed one of networks."""
    if request.param == "streamed":
        monkeypatch.setattr("fhash_codec.rendering.march.march_native", by_stream)
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
