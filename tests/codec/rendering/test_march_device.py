"""Marching on a device, emulated on the processor: pictures of whole files, networks, memory."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from emulated_cuda import EmulatedDevice, EmulatedMemory
from frame_field import SCENES, blobs, frame_of, table_of, task_of, waves
from rarely import rarely

import fhash_codec
from fhash_codec import EncodeConfig, Renderer, Scene
from fhash_codec.cuda.device import sent
from fhash_codec.cuda.nvrtc import Nvrtc, Unavailable, find_nvrtc
from fhash_codec.native import ffi
from fhash_codec.paper.model import PaperModel, PointSampler, PointTables
from fhash_codec.rendering import march_device, tiled_frame
from fhash_codec.rendering.march import march
from fhash_codec.rendering.march_device import (
    OPTIONAL,
    OPTIONS,
    DeviceMarcher,
    headers,
    kernel_text,
)
from fhash_codec.rendering.network_device import constants_of
from fhash_formats.errors import FhashWarning, InputError

FEW = ("surfaces", "between", "maximum")
"""Scenes that go through most of what a device does with a file; the others rarely."""


@pytest.fixture
def on_device(kernels_folder: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """A function that puts an emulated device in place of CUDA's, of settings of EmulatedDevice."""

    def use(device: EmulatedDevice | None = None, **settings: Any) -> None:
        device = device or EmulatedDevice(kernels_folder, **settings)
        place = "fhash_codec.rendering.renderer"
        monkeypatch.setattr(f"{place}.first_device", lambda: device)
        monkeypatch.setattr(f"{place}.DeviceMarcher", partial(DeviceMarcher, threads=32))
        monkeypatch.setattr("fhash_codec.rendering.plan.has_device", lambda: True)
        monkeypatch.setattr("fhash_codec.devices.has_device", lambda: True)

    return use


@pytest.fixture(scope="module")
def tiles(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The blobs in tiles of 8^3, bounded: shaded by smoothed values."""
    path = tmp_path_factory.mktemp("device") / "tiles.fhz"
    fhash_codec.encode(blobs(), path, EncodeConfig(effort=1, tile="1x8x8x8", max_error=0.3))
    return path


def pictures(path: Path, scene: dict[str, Any], **march: Any) -> tuple[Any, Any]:
    """A scene's picture by the CPU and by CUDA, each drawn twice by its renderer; the second."""
    found = []
    for device in ("cpu", "cuda"):
        asked = {"lod": 0, **scene.get("march", {}), **march, "device": device}
        with fhash_codec.open(path) as volume:
            renderer = Renderer(volume)
            given = Scene.from_dict({"size": [40, 34], **scene, "march": asked})
            first, second = renderer.render(given), renderer.render(given)
        np.testing.assert_allclose(first.rgba, second.rgba, atol=1e-6)
        found.append(second)
    return found[0], found[1]


@pytest.mark.parametrize("mode", ["arm", "cache"])
@pytest.mark.parametrize("name", [*FEW, *rarely(*(name for name in SCENES if name not in FEW))])
def test_a_device_draws_the_picture_of_the_processor(
    tiles: Path,
    on_device: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    mode: str,
) -> None:
    monkeypatch.setattr(tiled_frame, "BLOCK", 8)
    on_device()
    here, there = pictures(tiles, SCENES[name], mode=mode)
    np.testing.assert_allclose(there.rgba, here.rgba, atol=5e-4)
    assert here.rgba[..., 3].max() > 0.02
    for ours, theirs in ((there.depth, here.depth), (there.normal, here.normal)):
        if ours is not None:
            np.testing.assert_allclose(ours, theirs, atol=2e-3)
    assert there.counters["rays"] == here.counters["rays"]


def test_only_what_rays_come_to_is_decoded_for_a_device(
    tiles: Path, on_device: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tiled_frame, "BLOCK", 8)
    on_device()
    scene = {
        "step": 0,
        "camera": {"view": "xy", "projection": "parallel"},
        "transfer_function": {"opacity": [[-1, 1], [99, 1]]},
    }
    here, there = pictures(tiles, scene, mode="arm")
    np.testing.assert_allclose(there.rgba, here.rgba, atol=5e-4)
    assert there.counters["decoded_vertices"] <= 8 * 24 * 28
    assert there.counters["decoded_vertices"] == here.counters["decoded_vertices"]


@pytest.mark.parametrize("profile", ["compact", "paper"])
def test_a_picture_is_drawn_in_parts(
    files: dict[str, Path],
    on_device: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
    kernels_folder: Path,
    profile: str,
) -> None:
    """A launch ends before a display's device ends it, and progress is told between launches."""
    monkeypatch.setattr(march_device, "SAMPLES", 40_000)
    device = EmulatedDevice(kernels_folder)
    told: list[tuple[int, int]] = []
    on_device(device)
    with fhash_codec.open(files[profile]) as volume:
        march = {"lod": 0, "device": "cuda", "mode": "arm"}
        given = Scene.from_dict({"size": [40, 34], "march": march})
        renderer = Renderer(volume)
        parts = renderer.render(
            given, progress=lambda stage, done, total, _: told.append((done, total))
        )
        one = Renderer(volume).render(replace(given, march=replace(given.march, device="cpu")))
    np.testing.assert_allclose(parts.rgba, one.rgba, atol=5e-4)
    (kernels,) = device._loaded.values()
    count = max(total for _, total in told)
    assert count >= 3
    assert kernels.launched.count("march_pixels") % count == 0
    assert (count - 1, count) in told


def test_a_file_that_is_damaged_is_told_of(
    tiles: Path, on_device: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tiled_frame, "BLOCK", 8)
    on_device()

    def fail(*_: Any) -> None:
        raise OSError("no such disk")

    monkeypatch.setattr(tiled_frame.TiledFrame, "_decode", fail)
    with pytest.raises(OSError, match="no such disk"):
        pictures(tiles, {}, mode="arm")


def test_other_pictures_of_new_kernels_are_refused(
    files: dict[str, Path], on_device: Callable[..., None], kernels_folder: Path
) -> None:
    """An error if the device was named; else the processor draws, with a warning."""

    def wrong(text: str) -> str:
        return text.replace("march.out[4 * pixel + c] = 0", "march.out[4 * pixel + c] = 0.01f")

    device = EmulatedDevice(kernels_folder, new=True)
    on_device(device)
    here, _ = pictures(files["compact"], {})
    assert all(kernels.kept for kernels in device._loaded.values())
    on_device(EmulatedDevice(kernels_folder, new=True, change=wrong))
    with pytest.raises(
        InputError, match=r"drew another picture than the CPU, 0\.01 apart; use --de"
    ):
        pictures(files["compact"], {})
    with fhash_codec.open(files["compact"]) as volume:
        renderer = Renderer(volume, pictures=10**9)
        scene = Scene.from_dict({"size": [40, 34], "march": {"lod": 0}})
        with pytest.warns(FhashWarning, match="another picture than the CPU.*; the CPU draws"):
            there = renderer.render(scene)
        np.testing.assert_array_equal(renderer.render(scene).rgba, there.rgba)
    np.testing.assert_array_equal(there.rgba, here.rgba)


class SmallDevice(EmulatedDevice):
    """A device of little memory that counts what is sent to it."""

    size = 1 << 22

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.held = self.sent = 0

    def free(self) -> int:
        return self.size

    def memory(self, size: int) -> EmulatedMemory:
        device = self

        class Counted(EmulatedMemory):
            def send(self, array: np.ndarray, offset: int = 0) -> None:
                device.sent += array.nbytes
                super().send(array, offset)

            def __del__(self) -> None:
                device.held -= size

        if self.held + size > self.size:
            raise MemoryError("no memory")
        self.held += size
        return Counted(size)


def test_frames_stay_on_the_device_and_leave_it_for_others(kernels_folder: Path) -> None:
    device = SmallDevice(kernels_folder)
    marcher = DeviceMarcher(device, threads=32)
    task = task_of((40, 34, 60), table_of([0, 0.3]))
    frames = [frame_of(waves((40, 34, 60), pace)) for pace in (1.0, 0.5, 0.2)]
    size = frames[0].values.nbytes
    bricks = [tiled_frame.Bricks.of(frame) for frame in frames]

    def draw(number: int) -> tuple[np.ndarray, int]:
        before = device.sent
        marched = march(frames[number], task, bricks=bricks[number], device=marcher)
        return marched.rgba, device.sent - before

    first, cold = draw(0)
    again, warm = draw(0)
    np.testing.assert_array_equal(again, first)
    np.testing.assert_allclose(first, march(frames[0], task).rgba, atol=5e-4)
    assert cold > size > warm
    marcher._limit = 2 * size + warm
    draw(1)
    draw(2)
    assert draw(2)[1] < size  # kept
    assert draw(0)[1] > size  # gone, and here again
    assert draw(2)[1] < size
    del frames[2], bricks[2]
    assert len(marcher._kept) == 1  # what nobody has any more leaves the device at once
    device.size = size // 2
    marcher._kept.clear()
    with pytest.raises(MemoryError):
        draw(0)


PROBE = """
extern "C" __global__ void probe(
    const __grid_constant__ FhashInput march, const double* places, long long count, float* values,
    float* slopes) {
    const long long i = blockIdx.x * 32ll + threadIdx.x;
    if (i >= count) return;
    const double *at = places + 3 * i;
    float four[4] = {};
    values[2 * i] = network_at(march, at[0], at[1], at[2], nullptr);
    values[2 * i + 1] = network_at(march, at[0], at[1], at[2], four);
    for (int a = 0; a < 3; a++) slopes[3 * i + a] = four[3 - a];
}
"""
"""A kernel that evaluates the network at places."""


@pytest.mark.parametrize(
    "shape",
    [(0, 8, 2, -9.0), (1, 7, 1, -9.0), (2, 16, 2, 3.0), *rarely((1, 64, 3, 3.0), (2, 5, 4, -9.0))],
)
def test_a_thread_evaluates_a_network_as_the_processor_does(
    tmp_path: Path, kernels_folder: Path, shape: tuple[int, int, int, float]
) -> None:
    layers, width, size, low = shape
    config = EncodeConfig(
        preset="published",
        tables="float16",
        features=(f"interval:{low}:99",),
        epochs=3,
        hidden_layers=layers,
        width=width,
        embedding_size=size,
    )
    fhash_codec.encode(blobs(), tmp_path / "run.fhz", config)
    marcher = DeviceMarcher(EmulatedDevice(kernels_folder, change=lambda text: text + PROBE), 32)
    with fhash_codec.open(tmp_path / "run.fhz") as volume:
        model = volume._model
        assert isinstance(model, PaperModel)
        network, key = model.network, 0.6
        last = np.array(network.box_size[::-1]) - 1.0
        random = np.random.default_rng(1)
        places = np.concatenate([random.uniform(0, last, (200, 3)), [0 * last, last], [last // 2]])
        values, slopes = np.empty(len(places), np.float32), np.empty((len(places), 4), np.float32)
        sampler = PointSampler(PointTables.of_box(network, key), key)
        sampler.sample((np.zeros(1), *places.T[::-1].copy()), values, slopes, 1)
        fields = {"network": 1}
        held = marcher.network(network, key)
        kernels = marcher.kernels(0, fields, constants_of(network))
        addresses = held.fields(kernels)
        found, by = np.empty((len(places), 2), np.float32), np.empty((len(places), 3), np.float32)
        memory = [sent(marcher.device, array) for array in (places, found, by)]
        given = {name: march_device._addressed(name, at) for name, at in addresses.items()}
        at, of_values, of_slopes = (ffi.new("uintptr_t *", each.address) for each in memory)
        arguments = [
            ffi.new("FhashMarch *", given),
            at,
            ffi.new("int64_t *", len(places)),
            of_values,
            of_slopes,
        ]
        kernels.launch("probe", -(-len(places) // 32), 32, 0, arguments)
        memory[1].receive(found)
        memory[2].receive(by)
    np.testing.assert_array_equal(found[:, 0], found[:, 1])
    np.testing.assert_allclose(found[:, 0], values, atol=3e-6 * np.abs(values).max())
    near = np.abs(by - slopes[:, :0:-1]) <= 3e-5 * np.abs(slopes).max()
    assert near.mean() > 0.97  # on a kink rounding decides which side is taken
    assert network.sparse == (low > 0)


def test_a_network_that_a_device_cannot_do_is_refused() -> None:
    class Layers:
        layers = [(np.zeros((4, 4)), np.zeros(4))] * 4

    with pytest.raises(Unavailable, match="3 hidden layers of 4; a GPU draws 2 of 128 at most"):
        constants_of(Layers())  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def nvrtc() -> Nvrtc:
    try:
        return find_nvrtc()
    except Unavailable as error:
        pytest.skip(str(error))


CONSTANTS = {"LEVELS": 7, "SIZE": 2, "WIDTH": 64, "LAYERS": 2, "SPARSE": 0}
MAX_STACK = {"plain": 64, "shaded": 64, "surfaces": 2048, "network": 2560, "network surfaces": 4608}
"""Bytes of the stack of a thread: little where every sample goes through it."""


@pytest.mark.parametrize("architecture", [90, *rarely(80, 100)])
@pytest.mark.parametrize(
    ("name", "flags", "parts"),
    [
        ("plain", 0, ()),
        ("shaded", 1, ("central", "normal")),
        ("surfaces", 1 | 2, OPTIONAL[:1] + OPTIONAL[2:]),
        ("network", 1, ("network", "central")),
        pytest.param(
            "network surfaces", 1, ("network", "central", "surfaces"), marks=pytest.mark.every
        ),
    ],
)
def test_the_kernels_compile_for_gpus(
    nvrtc: Nvrtc, architecture: int, name: str, flags: int, parts: tuple[str, ...]
) -> None:
    constants = CONSTANTS if "network" in parts else None
    text = kernel_text(flags, dict.fromkeys(parts, 1), constants)
    cubin, log = nvrtc.compile(text, architecture, headers(), OPTIONS)
    assert cubin.startswith(b"\x7fELF")
    assert "warning" not in log, log
    stacks = [int(number) for number in re.findall(r"(\d+) bytes stack frame", log)]
    assert stacks
    assert max(stacks) <= MAX_STACK[name]
