"""Streamed rays and marches, with numpy and torch."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from frame_field import CENTRAL, NETWORK_SCENES, SCENES, field_of
from rarely import rarely

import fhash_codec
from fhash_codec import Renderer, Scene, Volume
from fhash_codec.paper.network import ArrayTable, Network
from fhash_codec.rendering.bricks import Palette
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.image import Image
from fhash_codec.rendering.march import march, march_native
from fhash_codec.rendering.march_device import DeviceMarcher
from fhash_codec.rendering.march_task import (
    NUMPY,
    Arrays,
    Frame,
    Marched,
    Surface,
    Table,
    Task,
    Units,
)
from fhash_codec.rendering.network_frame import network_frame
from fhash_codec.rendering.plan import arrays_on
from fhash_codec.rendering.stream_fields import (
    Beams,
    Field,
    HostInference,
    Leaping,
    NetworkField,
    WarpedField,
    central_slopes,
    shares,
)
from fhash_codec.rendering.stream_march import Canvas, Events, stream
from fhash_codec.rendering.tiled_frame import FrameField
from fhash_formats.errors import InputError
from fhash_formats.series import ArraySeries, Coordinate

FrameTask = Callable[..., tuple[FrameField, Task]]


def test_shares_are_spread_evenly_and_belong_to_the_number() -> None:
    found = shares(np.arange(10_000), NUMPY)
    assert 0 < found.min() < found.max() < 1
    counts = np.histogram(found, bins=10, range=(0, 1))[0]
    assert np.abs(counts - 1000).max() < 150
    np.testing.assert_array_equal(shares(np.array([7, 3]), NUMPY), found[[7, 3]])


def test_rows_of_a_picture_are_those_of_the_whole(frame_task: FrameTask) -> None:
    field, task = frame_task(np.zeros((9, 7, 7)), fog=1.0)
    task = replace(task, jitter=True, antialiasing=2)
    whole = Beams.of(task, field.bounds, range(8))
    part = Beams.of(task, field.bounds, range(3, 5))
    chosen = slice(3 * 32, 5 * 32)
    np.testing.assert_array_equal(part.origin, whole.origin[chosen])
    np.testing.assert_array_equal(part.depth, whole.depth[chosen])


def test_a_leap_ends_at_the_first_sample_in_a_brick_that_matters(frame_task: FrameTask) -> None:
    values = np.zeros((60, 9, 9))
    values[37:41] = 1.0
    surface = Surface(value=0.5, colour=np.ones(3), opacity=1.0)
    field, task = frame_task(values, step=0.4, surfaces=(surface,))
    beams = Beams.of(task, field.bounds, range(8))
    leaping = Leaping.of(field, task)
    rays, every_ray = np.arange(64), np.ones(64, dtype=bool)
    reached, leaps = leaping.leap(beams.origin, beams.pace, beams.begin, beams.end, every_ray)
    every = np.arange(beams.end.max())[None]
    matters = leaping.matters(beams.places(rays, np.broadcast_to(every, (64, every.size))))
    assert 0 < leaps < 20 * 64
    np.testing.assert_array_equal(reached, matters.argmax(axis=1))
    # From a sample in a brick that matters there is no leap.
    again, none = leaping.leap(beams.origin, beams.pace, reached, beams.end, every_ray)
    np.testing.assert_array_equal(again, reached)
    assert none == 0


Planned = Callable[[Volume, dict[str, Any], Arrays], tuple[Field, Task]]


@pytest.mark.parametrize("cuts", [(), (1,), (1, 2), (2,)])
def test_events_are_joined_front_to_back_however_they_are_split(
    frame_task: FrameTask, cuts: tuple[int, ...]
) -> None:
    field, task = frame_task(np.full((9, 7, 7), 0.5), fog=0.1)
    task = replace(task, depth=True)
    beams = Beams.of(task, field.bounds, range(8))
    assert task.table is not None
    canvas = Canvas(field, task, beams, Palette.of(task.table))
    rays = np.array([3, 9])
    opacity = np.array([[0.25, 0.5, 0.5], [0.0, 0.125, 0.0]])
    at = np.broadcast_to(np.arange(3.0), (2, 3))
    for part in np.split(np.arange(3), cuts):
        canvas.add(
            rays,
            Events(
                opacity=opacity[:, part],
                at=at[:, part],
                which=np.zeros((2, len(part)), dtype=np.int64),
                values=np.full((2, len(part)), 0.5),
            ),
        )
    np.testing.assert_array_equal(canvas.clear[rays], [0.1875, 0.875])
    np.testing.assert_allclose(canvas.colour[rays], np.array([[0.8125], [0.125]]) * np.ones(3))
    # Less than half of the light is left after the second event of the first ray alone.
    assert canvas.depth[3] == beams.depth[3] + task.step
    assert np.isinf(canvas.depth[9])


FramePicture = Callable[[str, dict[str, Any]], Marched]


def picture(
    renderer: Renderer, mode: str, scene: dict[str, Any], size: tuple[int, int] = (48, 40)
) -> Image:
    return renderer.render(
        Scene.from_dict({**scene, "size": size, "march": {**scene.get("march", {}), "mode": mode}})
    )


@pytest.fixture
def frame_picture(planned: Planned, volume: Volume) -> Callable[[str, dict[str, Any]], Marched]:
    """A function that draws a decoded frame of the compact file in a mode of marching."""

    def of(mode: str, scene: dict[str, Any]) -> Marched:
        field, task = planned(volume, {"size": [48, 40], **scene}, NUMPY)
        if mode == "cache":
            return march(field.frame, task)
        return stream(
            field,
            task,
            adaptive=mode == "arm",
            budget=scene.get("march", {}).get("samples_per_pass"),
        )

    return of


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_three_ways_make_one_picture(frame_picture: FramePicture, scene: dict[str, Any]) -> None:
    cache, streamed, adaptive = (frame_picture(mode, scene) for mode in ("cache", "stream", "arm"))
    assert cache.rgba[..., 3].max() > 0.05
    np.testing.assert_array_equal(streamed.rgba, adaptive.rgba)
    np.testing.assert_allclose(streamed.rgba, cache.rgba, atol=1e-3)
    if cache.depth is not None and streamed.depth is not None:
        np.testing.assert_allclose(streamed.depth, cache.depth, atol=1e-3)
    if cache.normal is not None and streamed.normal is not None:
        np.testing.assert_allclose(streamed.normal, cache.normal, atol=1e-3)


def test_adaptive_marching_takes_at_most_half_the_passes(frame_picture: FramePicture) -> None:
    streamed, adaptive, large = (
        frame_picture(mode, {"march": march})
        for mode, march in (("stream", {}), ("arm", {}), ("arm", {"samples_per_pass": 10**6}))
    )
    assert adaptive.counters["passes"] <= streamed.counters["passes"] / 2
    assert large.counters["passes"] < adaptive.counters["passes"]
    np.testing.assert_array_equal(large.rgba, streamed.rgba)


@pytest.mark.parametrize("mode", ["stream", "arm"])
def test_counters_prove_that_nothing_else_is_done(frame_picture: FramePicture, mode: str) -> None:
    plain = frame_picture(mode, {}).counters
    assert plain["gradients"] == plain["secondary_rays"] == 0
    assert plain["evaluations"] == plain["samples"] > 0
    shaded = frame_picture(mode, {"effects": {"shading": True}}).counters
    assert 0 < shaded["gradients"] <= shaded["samples"]
    assert {**shaded, "gradients": 0} == plain
    around = frame_picture(mode, {"effects": {"box": True}}).counters
    assert around == plain
    strips = {"effects": {"axes": True, "colour_bar": True, "time_label": True}}
    assert frame_picture(mode, strips).counters["gradients"] == 0
    depth = frame_picture(mode, {"effects": {"buffers": ["depth"]}}).counters
    assert depth == plain


def test_only_samples_in_visible_cells_are_evaluated(
    frame_picture: FramePicture, planned: Planned, volume: Volume
) -> None:
    narrow = {"step": 0, "transfer_function": {"opacity": [[4, 0], [4.2, 0.1], [4.4, 0]]}}
    found, everything = (
        frame_picture("arm", {**narrow, "march": {"skipping": on, "threshold": 0.0}})
        for on in (True, False)
    )
    np.testing.assert_array_equal(found.rgba, everything.rgba)
    frame = volume.read(0)
    corners = [
        frame[tuple(slice(up, n - 1 + up) for up, n in zip(corner, frame.shape, strict=True))]
        for corner in np.ndindex(2, 2, 2)
    ]
    visible = (np.min(corners, axis=0) < 4.4) & (np.max(corners, axis=0) > 4)
    _, task = planned(volume, {**narrow, "size": [48, 40]}, NUMPY)
    beams = Beams.of(task, task.rays.grid.bounds, range(40))
    sample = np.arange(beams.end.max())[None]
    row, column = np.nonzero(sample < beams.end[:, None])
    x, y, z = np.minimum(beams.places(row, column).astype(int), np.array(visible.shape[::-1]) - 1).T
    inside = int(visible[z, y, x].sum())
    assert inside <= found.counters["evaluations"] <= 1.1 * inside


NETWORK: dict[str, Any] = {
    "effects": {"shading": True, "isosurfaces": [{"value": 5, "opacity": 0.5}]}
}


@pytest.mark.parametrize("step", [0.0, 0.7])
def test_both_ways_make_one_picture_of_a_network_near_that_of_its_vertices(
    files: dict[str, Path], step: float
) -> None:
    with fhash_codec.open(files["paper"]) as network:
        cache, streamed, adaptive = (
            picture(Renderer(network), mode, {**NETWORK, "step": step}).rgba
            for mode in ("cache", "stream", "arm")
        )
    assert streamed[..., 3].max() > 0.05
    np.testing.assert_allclose(streamed, adaptive, atol=2e-5)
    assert np.isfinite(streamed).all()
    # Between vertices the network has values of its own: they make all the difference.
    assert np.mean(np.abs(streamed - cache)) < 0.02


ON_DEVICE = ("between", "surfaces")
"""Scenes of a network that are always drawn by kernels; the others rarely."""


def by_packets(
    volume: Volume, scene: dict[str, Any], task: Task, marcher: DeviceMarcher | None, path: int = 0
) -> Marched:
    """The march of a network's frame on the processor, or on a device."""
    plan = Renderer(volume).plan(Scene.from_dict({"size": [40, 34], **scene}))
    warp = task.rays.grid.warp
    frame, bricks = network_frame(volume, plan.step, plan.units, warp, marcher)
    return march_native(frame, task, bricks, path=path, device=marcher)


def assert_one_picture(here: Marched, there: Marched) -> None:
    """Compare colours, depths and normals of two marches through a network."""
    np.testing.assert_allclose(here.rgba, there.rgba, atol=5e-4)
    assert np.mean(np.abs(here.rgba - there.rgba)) < 2e-5
    assert here.rgba[..., 3].max() > 0.05
    for mine, other in ((here.depth, there.depth), (here.normal, there.normal)):
        if mine is not None and other is not None:
            np.testing.assert_allclose(mine, other, atol=2e-3)


@pytest.mark.parametrize(
    ("scene", "path"),
    [
        pytest.param(
            NETWORK_SCENES[name],
            path,
            id=f"{name}-{path}",
            marks=[pytest.mark.every]
            * (path in (0, 1) or (path, name in ON_DEVICE) == ("k", False)),
        )
        for name in NETWORK_SCENES
        for path in (2, "k", 0, 1)
    ],
)
def test_native_and_streamed_samples_of_a_network_make_one_picture(
    files: dict[str, Path],
    planned: Planned,
    scene: dict[str, Any],
    path: int | str,
    request: pytest.FixtureRequest,
) -> None:
    marcher = request.getfixturevalue("emulated_marcher") if path == "k" else None
    with fhash_codec.open(files["paper"]) as volume:
        field, task = planned(volume, scene, NUMPY)
        assert isinstance(field, NetworkField)
        whole = not np.isnan(field.bricks.values).any()
        here = by_packets(volume, scene, task, marcher, path if isinstance(path, int) else 0)
        there, plainly = (stream(field, task, adaptive=adaptive) for adaptive in (True, False))
    np.testing.assert_array_equal(there.rgba, plainly.rgba)
    assert_one_picture(here, there)
    if not task.skipping and not task.surfaces:
        assert here.counters["samples"] == there.counters["samples"]
        assert here.counters["evaluations"] >= there.counters["evaluations"]
    assert not whole  # samples beside vertices without a value are among them


def test_native_samples_of_a_network_of_all_vertices(tmp_path: Path, planned: Planned) -> None:
    z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (9, 10, 11)), indexing="ij")
    values = np.sin(5 * x * y) * np.cos(3 * z)
    config = fhash_codec.EncodeConfig(preset="published", tables="float16", epochs=200, width=8)
    fhash_codec.encode(values.astype(np.float32)[None], tmp_path / "run.fhz", config)
    with fhash_codec.open(tmp_path / "run.fhz") as volume:
        scene = {
            "transfer_function": {"opacity": [[-1, 0.1], [1, 0.4]]},
            "effects": {"shading": True},
        }
        field, task = planned(volume, scene, NUMPY)
        assert isinstance(field, NetworkField)
        assert not np.isnan(field.bricks.values).any()
        here = by_packets(volume, scene, task, None)
        there = stream(field, task, adaptive=True)
    assert here.rgba[..., 3].max() > 0.05
    np.testing.assert_allclose(here.rgba, there.rgba, atol=5e-4)


def test_native_march_tells_of_a_network_that_has_no_memory(
    files: dict[str, Path], planned: Planned
) -> None:
    with fhash_codec.open(files["paper"]) as volume:
        _, task = planned(volume, {}, NUMPY)
        plan = Renderer(volume).plan(Scene(size=(40, 34)))
        frame, bricks = network_frame(volume, plan.step, plan.units, None, None)
        assert frame.network is not None
        broken = {**frame.network.fields, "network_path": 3}  # a path that no machine has
        frame = replace(frame, network=replace(frame.network, fields=broken))
        with pytest.raises(MemoryError):
            march(frame, task, bricks=bricks)


@pytest.mark.parametrize("way", ["native", *rarely("kernels")])
@pytest.mark.parametrize("axis", ["z", "x"])
@pytest.mark.parametrize(
    "effects",
    [
        {"shading": True, "buffers": ["depth", "normal"]},
        {"isosurfaces": [{"value": 0.5, "opacity": 0.7}, {"value": 0.8}]},
        {"minimum_intensity": True},
    ],
    ids=["shaded", "surfaces", "minimum"],
)
def test_a_network_on_uneven_axes_is_marched_as_it_is_streamed(
    tmp_path: Path,
    effects: dict[str, Any],
    axis: str,
    way: str,
    request: pytest.FixtureRequest,
) -> None:
    marcher = request.getfixturevalue("emulated_marcher") if way == "kernels" else None
    places = {name: np.arange(count) / 1.0 for name, count in zip("zyx", (10, 9, 11), strict=True)}
    places[axis] = np.cumsum(1 + 0.7 * np.sin(np.arange(len(places[axis]))))
    z, y, x = np.meshgrid(*(at / at[-1] - 0.5 for at in places.values()), indexing="ij")
    values = np.exp(-6 * (z * z + y * y + x * x)).astype(np.float32)[None].repeat(2, axis=0)
    coords = {name: Coordinate(name=name, values=at) for name, at in places.items()}
    config = fhash_codec.EncodeConfig(
        preset="published", tables="float16", features=("interval:0.3:2",), epochs=30, width=8
    )
    fhash_codec.encode(ArraySeries(values, coords=coords), tmp_path / "u.fhz", config)
    linear = {"range": [0, 1], "opacity": [[0, 0], [1, 0.8]]}
    scene = {"size": [24, 20], "step": 1, "transfer_function": linear, "effects": effects}
    with fhash_codec.open(tmp_path / "u.fhz") as volume:
        plan = Renderer(volume).plan(Scene.from_dict(scene))
        warp = plan.task.rays.grid.warp
        assert warp is not None
        network = NetworkField(volume, plan.step, plan.units)
        here = by_packets(volume, scene, plan.task, marcher)
        there = stream(WarpedField(network, warp), plan.task, adaptive=True)
    assert_one_picture(here, there)


def assert_same_work(here: Marched, there: Marched, scene: dict[str, Any]) -> None:
    """Equal counters, but for the turns of the search for surfaces, which rounding decides."""
    searched = here.counters["evaluations"] - there.counters["evaluations"]
    assert abs(searched) <= (
        0.05 * here.counters["evaluations"] if "isosurfaces" in scene.get("effects", {}) else 0
    )
    alike = {
        **there.counters,
        **{count: there.counters[count] + searched for count in ("samples", "evaluations")},
    }
    assert alike == here.counters


@pytest.mark.torch
@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
@pytest.mark.parametrize("adaptive", [False, True])
def test_torch_makes_the_picture_of_numpy(
    planned: Planned, volume: Volume, tensors: Arrays, scene: dict[str, Any], adaptive: bool
) -> None:
    here, there = (
        stream(*planned(volume, scene, arrays), adaptive=adaptive, budget=3000)
        for arrays in (NUMPY, tensors)
    )
    assert here.rgba[..., 3].max() > 0.05
    np.testing.assert_allclose(there.rgba, here.rgba, atol=1e-5)
    assert_same_work(here, there, scene)
    for mine, other in ((here.depth, there.depth), (here.normal, there.normal)):
        assert (mine is None) == (other is None)
        if mine is not None and other is not None:
            np.testing.assert_allclose(other, mine, atol=1e-5)


@pytest.mark.torch
def test_nothing_leaves_the_device_before_the_picture(
    planned: Planned, volume: Volume, tensors: Arrays
) -> None:
    import torch
    from torch.overrides import TorchFunctionMode

    taken = []

    class Watched(type(tensors)):  # type: ignore[misc]
        def host(self, array: Any) -> np.ndarray:
            taken.append(array.numel())
            with torch._C.DisableTorchFunction():
                return super().host(array)

    class Watch(TorchFunctionMode):
        def __torch_function__(
            self, function: Any, types: Any, args: Any = (), kwargs: Any = None
        ) -> Any:
            name = function.__name__
            assert name not in ("cpu", "numpy", "__array__", "cuda"), name
            assert name != "tolist" or args[0].numel() <= 2  # the counts of a pass
            assert function.__name__ == "from_numpy" or not any(
                isinstance(each, (np.ndarray, np.generic)) for each in args
            ), function
            return function(*args, **(kwargs or {}))

    effects = {
        "shadows": True,
        "shading": {"gradient": "central"},
        "isosurfaces": [{"value": 5, "opacity": 0.5}],
    }
    scene = {"effects": {**effects, "buffers": ["depth", "normal"], "jitter": True}}
    field, task = planned(volume, scene, Watched(torch.device("cpu")))
    with Watch():
        marched = stream(field, task, adaptive=True, budget=3000)
    assert marched.rgba.any()
    rays = 40 * 34
    assert sorted(taken) == [rays, 3 * rays, 4 * rays]


@pytest.mark.torch
@pytest.mark.parametrize("scene", NETWORK_SCENES.values(), ids=NETWORK_SCENES)
def test_torch_marches_through_a_network_as_numpy_does(
    planned: Planned, files: dict[str, Path], tensors: Arrays, scene: dict[str, Any]
) -> None:
    with fhash_codec.open(files["paper"]) as network:
        here, there = (
            stream(*planned(network, scene, arrays), adaptive=True) for arrays in (NUMPY, tensors)
        )
    assert here.rgba[..., 3].max() > 0.05
    np.testing.assert_allclose(there.rgba, here.rgba, atol=1e-4)
    assert there.counters["evaluations"] > 0
    assert_same_work(here, there, scene)
    if here.normal is not None:
        assert here.normal.any()
        np.testing.assert_allclose(there.depth, here.depth, atol=1e-3)
        np.testing.assert_allclose(there.normal, here.normal, atol=1e-3)


@pytest.mark.torch
@pytest.mark.parametrize("kind", ["compact", "paper"])
def test_cuda_makes_the_picture_of_numpy(
    files: dict[str, Path], planned: Planned, kind: str
) -> None:
    import torch

    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    with fhash_codec.open(files[kind]) as opened:
        here, there = (
            stream(*planned(opened, CENTRAL, arrays_on(device)), adaptive=True)
            for device in ("cpu", "cuda")
        )
    assert here.rgba[..., 3].max() > 0.05
    np.testing.assert_allclose(there.rgba, here.rgba, atol=1e-4)
    np.testing.assert_allclose(there.normal, here.normal, atol=1e-3)
    assert there.counters["rays"] == here.counters["rays"]


@pytest.mark.torch
def test_a_device_without_enough_memory_says_so(
    planned: Planned, volume: Volume, tensors: Arrays, monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch

    def full(places: object, wanted: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    field, task = planned(volume, {}, tensors)
    monkeypatch.setattr(field, "values", full)
    with pytest.raises(InputError, match="memory of the device"):
        stream(field, task, adaptive=True)


@pytest.mark.parametrize("step", [0.0, 0.7])
def test_a_field_of_a_network_has_the_values_and_slopes_of_its_volume(
    files: dict[str, Path], step: float
) -> None:
    x, y, z = np.array([8.7, 19.0]), np.array([10.1, 14.0]), np.array([9.3, 12.0])
    places = np.stack([x, y, z], axis=-1)
    with fhash_codec.open(files["paper"]) as network:
        values, slopes = network.sample(t=step, z=z, y=y, x=x, gradient=True)
        field = NetworkField(network, step, Units())
        np.testing.assert_allclose(field.values(places), values, rtol=1e-5)
        np.testing.assert_allclose(field.slopes(places), slopes[:, :0:-1], rtol=1e-4, atol=1e-5)


def test_central_differences_reach_one_vertex_to_both_sides(frame_task: FrameTask) -> None:
    z, y, x = np.meshgrid(*map(np.arange, (9.0, 7.0, 8.0)), indexing="ij")
    values = 0.3 * x**2 - 2 * y + x * z
    values[4, 3, 7] = np.nan
    field, _ = frame_task(values)
    values = values.astype(np.float32)
    inner = field.arrays.array([[3.0, 2.0, 5.0]])
    np.testing.assert_allclose(
        central_slopes(field, inner, field), [[0.3 * 6 + 5, -2, 3]], rtol=1e-6
    )
    # At an end the place beyond it is the end itself.
    end = central_slopes(field, np.array([[0.0, 6.0, 2.0]]), field)
    np.testing.assert_allclose(end, [[(0.3 + 2) / 2, -1, 0]], rtol=1e-6, atol=1e-9)
    # Beside a missing vertex, along x, the slope within the cell.
    np.testing.assert_allclose(field.values(np.array([[6.25, 3.0, 4.0]])), np.nan)
    found = central_slopes(field, np.array([[5.25, 3.0, 4.0]]), field)
    np.testing.assert_allclose(found[0, 0], values[4, 3, 6] - values[4, 3, 5], rtol=1e-6)
    np.testing.assert_allclose(found[0, 1:], [-2, 5.25], rtol=1e-6)


@pytest.mark.torch
def test_a_field_that_does_not_fit_says_so(
    files: dict[str, Path],
    volume: Volume,
    planned: Planned,
    tensors: Arrays,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import torch

    array = tensors.array

    def full(values: Any, kind: str | None = None) -> Any:
        if np.size(values) > 100:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return array(values, kind)

    monkeypatch.setattr(tensors, "array", full)
    with pytest.raises(InputError, match="memory of the device"):
        planned(volume, {}, tensors)
    with (
        fhash_codec.open(files["paper"]) as network,
        pytest.raises(InputError, match="memory of the device"),
    ):
        planned(network, {}, tensors)


Floats = npt.NDArray[np.float64]

SIZE = (17, 9, 5)
LEVELS = ((3, 17, 9, 5), (2, 9, 5, 3), (1, 5, 3, 2))
"""Resolutions whose vertices lie 1, 2 and 4 vertices of the box apart."""


def network_of(
    draw: Callable[[tuple[int, ...]], Floats], box: tuple[int, int, int] = SIZE
) -> Network:
    """A network over three key frames with two hidden layers, its numbers drawn by shape."""
    levels = tuple(
        (time, *(min(length, size) for length, size in zip(space, box, strict=True)))
        for time, *space in LEVELS
    )
    widths = (2 * len(levels), 16, 16, 1)
    return Network(
        levels=levels,
        embedding_size=2,
        tables=[ArrayTable(draw((*level, 2)).astype(np.float32)) for level in levels],
        layers=tuple(
            (draw((outputs, inputs)).astype(np.float32), draw((outputs,)).astype(np.float32))
            for inputs, outputs in itertools.pairwise(widths)
        ),
        box_size=box,
        key_frames=3,
    )


@pytest.fixture(scope="module")
def network() -> Network:
    """A network of numbers that no sum is exact for."""
    random = np.random.default_rng(2)
    return network_of(lambda shape: random.normal(0, 0.3, shape))


def places_in(box: tuple[int, int, int], *, parts: int = 2**20) -> Floats:
    """Places (n, 3), x, y, z, in a box: 500 at random and the two ends, in parts of a vertex."""
    last = np.array(box[::-1]) - 1
    random = np.random.default_rng(3).integers(0, last * parts + 1, (500, 3)) / parts
    return np.concatenate([random, [0 * last, last]])


def test_on_the_host_a_sample_has_the_same_bits_in_any_pass(network: Network) -> None:
    inference, places = HostInference(network, 0.6, NUMPY), places_in(SIZE)
    values, slopes = inference.values(places), inference.slopes(places)
    random = np.random.default_rng(4)
    for count in (1, 2, 17, 64, 300):
        chosen = random.permutation(len(places))[:count]
        np.testing.assert_array_equal(inference.values(places[chosen]), values[chosen])
        np.testing.assert_array_equal(inference.slopes(places[chosen]), slopes[chosen])


X = np.array([0, 1, 2, 4, 8, 16, 17, 18, 19, 20.0])
COORDS = {
    axis: Coordinate(name=axis, values=values)
    for axis, values in (("x", X), ("y", np.arange(9.0)), ("z", np.arange(7.0)))
}


def fields(arrays: Arrays = NUMPY) -> tuple[FrameField, WarpedField, Grid]:
    grid = Grid.of(COORDS)
    assert grid.warp is not None
    values = np.random.default_rng(0).random((7, 9, 10)).astype(np.float32)
    values[:, :, 5] = np.nan
    own = Grid(counts=(10, 9, 7), origin=np.zeros(3), spacing=np.ones(3))
    frame = Frame(values=values, first=(0, 0, 0))
    inner = field_of(frame, own, arrays)
    return inner, WarpedField(inner, grid.warp), grid


def test_values_and_slopes_are_those_of_the_series() -> None:
    inner, field, grid = fields()
    random = np.random.default_rng(1)
    physical = random.uniform([0, 0, 0], [20, 8, 6], (200, 3))
    drawn = physical / grid.spacing
    own = physical.copy()
    own[:, 0] = np.interp(physical[:, 0], X, np.arange(10))
    found, expected = field.values(drawn), inner.values(own)
    assert np.isnan(expected).any()
    np.testing.assert_allclose(found, expected, atol=1e-9)
    ahead = drawn + np.array([1e-5, 0, 0])
    slopes = field.slopes(drawn)
    rising = (field.values(ahead) - found) / 1e-5
    inside = np.isfinite(rising) & (np.floor(drawn[:, 0]) == np.floor(ahead[:, 0]))
    np.testing.assert_allclose(slopes[inside, 0], rising[inside], atol=1e-4)
    np.testing.assert_allclose(np.asarray(field.bounds), grid.bounds)


def test_cells_and_bricks_hide_nothing() -> None:
    _, field, grid = fields()
    table = Table(
        low=0.0,
        high=1.0,
        colours=np.ones((101, 3), dtype=np.float32),
        extinctions=(np.arange(101) > 88) * 1.0,
    )
    cells = np.asarray(field.visible(Palette.of(table)))
    assert cells.shape == tuple(count - 1 for count in grid.counts[::-1])
    assert not cells.all()
    places = np.random.default_rng(2).uniform(0, np.array(grid.counts) - 1.001, (4000, 3))
    values = field.values(places)
    assert np.nanmax(values) > 0.88
    x, y, z = places.astype(int).T
    assert cells[z, y, x][np.nan_to_num(values) > 0.88].all()
    low, high = (part[z // 4, y // 4, x // 4] for part in (field.bricks.low, field.bricks.high))
    known = np.isfinite(values)
    assert np.all((low[known] <= values[known] + 1e-6) & (values[known] <= high[known] + 1e-6))


@pytest.mark.torch
def test_tensors_give_the_same(tensors: Arrays) -> None:
    places = np.random.default_rng(3).uniform(0, 6, (50, 3))
    _, numpy_field, _ = fields()
    _, torch_field, _ = fields(tensors)
    moved = tensors.array(places)
    np.testing.assert_allclose(
        tensors.host(torch_field.values(moved)), numpy_field.values(places), atol=1e-12
    )
    np.testing.assert_allclose(
        tensors.host(torch_field.slopes(moved)), numpy_field.slopes(places), atol=1e-12
    )
