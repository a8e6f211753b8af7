"""Streaming on a pretended CUDA device: every operand is on it, and a pass waits a few times."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.torch

from frame_field import NETWORK_SCENES, SCENES
from pretended_cuda import CUDA, MixedDevices, pretended_cuda

import fhash_codec
from fhash_codec import Volume
from fhash_codec.paper.engines.fused import program as driver
from fhash_codec.paper.engines.fused.engine import FusedPoints
from fhash_codec.rendering import stream_march as canvas
from fhash_codec.rendering.march_task import NUMPY, Arrays, Task
from fhash_codec.rendering.plan import arrays_on
from fhash_codec.rendering.stream_fields import Field
from fhash_codec.rendering.stream_march import stream
from fhash_codec.rendering.tiled_frame import FrameField

Planned = Callable[[Volume, dict[str, Any], Arrays], tuple[Field, Task]]

EMULATOR = Path(__file__).parents[2] / "paper" / "engines" / "fused"
"""The folder of the module `emulator`."""
OF_A_PICTURE = 8
"""Waits of a picture besides those of its passes: the rays at the start, counters, and results."""
WAITS = 8
"""Waits that a pass may take."""
WAITS_WITH_SURFACES = 14
"""Waits that a pass may take with surfaces, whose search ends when all of a pass are found."""
FRAMES = ("plain", "surfaces", "maximum", "graded", "all light")
NETWORKS = ("plain", "between", "graded", "surfaces", "attenuated", "unskipped", "central")


def assert_a_pass_waits_little(planned: Planned, path: Path, scene: dict[str, Any]) -> None:
    """March on the pretended device and on the host, and compare the pictures."""
    scene = {**scene, "size": [24, 20]}
    with fhash_codec.open(path) as volume:
        here = stream(*planned(volume, scene, NUMPY), adaptive=True, budget=700)
        with pretended_cuda() as pretended:
            field, task = planned(volume, scene, arrays_on("cuda"))
            pretended.forget()
            there = stream(field, task, adaptive=True, budget=700)
    assert here.rgba[..., 3].max() > 0.05
    np.testing.assert_allclose(there.rgba, here.rgba, atol=1e-4)
    assert there.counters["passes"] == here.counters["passes"] > 0
    most = WAITS_WITH_SURFACES if task.surfaces else WAITS
    waits = pretended.counts["waits"] - OF_A_PICTURE
    assert 0 < waits <= most * here.counters["passes"], pretended.waits


@pytest.mark.parametrize("scene", FRAMES)
def test_a_pass_through_a_frame_waits_little(
    planned: Planned, files: dict[str, Path], scene: str
) -> None:
    assert_a_pass_waits_little(planned, files["compact"], SCENES[scene])


@pytest.fixture(scope="module")
def kernels_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the compiled kernels; the test is skipped without g++."""
    if shutil.which("g++") is None:
        pytest.skip("g++ compiles the emulated kernels, and is not here")
    return tmp_path_factory.mktemp("kernels")


@pytest.mark.parametrize("scene", NETWORKS)
def test_a_pass_through_fused_kernels_waits_little(
    planned: Planned,
    files: dict[str, Path],
    kernels_folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    scene: str,
) -> None:
    """The kernels are emulated on the tensors of the pretended device."""
    monkeypatch.syspath_prepend(str(EMULATOR))
    from emulator import EmulatedDevice

    device, used = EmulatedDevice(kernels_folder), set()
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(driver, "CudaDevice", lambda _: device)
    for name in ("values", "slopes"):
        plain = getattr(FusedPoints, name)

        def watched(self: Any, places: Any, plain: Any = plain, name: str = name) -> Any:
            assert places.device == CUDA
            used.add(name)
            return plain(self, places)

        monkeypatch.setattr(FusedPoints, name, watched)
    assert_a_pass_waits_little(planned, files["paper"], NETWORK_SCENES[scene])
    assert "values" in used


@pytest.mark.parametrize(
    ("cls", "name"),
    [
        (FrameField, "_flat"),
        (FrameField, "_last"),
        (FrameField, "first"),
        (canvas.Canvas, "_spacing"),
        (canvas.Canvas, "colour"),
    ],
)
def test_an_array_of_the_host_in_a_pass_is_seen(
    planned: Planned, files: dict[str, Path], monkeypatch: pytest.MonkeyPatch, cls: Any, name: str
) -> None:
    """Planted faults: one array of a march stays on the host."""
    plain = cls.__init__

    def spoilt(*arguments: Any) -> None:
        plain(*arguments)
        setattr(arguments[0], name, getattr(arguments[0], name).cpu())

    monkeypatch.setattr(cls, "__init__", spoilt)
    with pretended_cuda(), pytest.raises(MixedDevices):
        draw(planned, files)


def draw(planned: Planned, files: dict[str, Path]) -> None:
    """Draw a frame with depth and normal on the device."""
    scene = {"size": [12, 10], "effects": {"buffers": ["depth", "normal"]}}
    with fhash_codec.open(files["compact"]) as volume:
        stream(*planned(volume, scene, arrays_on("cuda")), adaptive=True)
