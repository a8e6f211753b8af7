"""Streaming and adaptive ray marching: the picture of the packets, and no needless work."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fhash_codec
from fhash_codec import Renderer, Scene, Volume, native
from fhash_codec.paper.network import Network
from fhash_codec.rendering.camera.camera import Grid, Rays
from fhash_codec.rendering.picture.image import Image
from fhash_codec.rendering.renderer import decoded_frame
from fhash_codec.rendering.scene.scene import Camera
from fhash_codec.rendering.stream import fields
from fhash_codec.rendering.stream.beams import Beams
from fhash_codec.rendering.stream.crossings import crossings
from fhash_codec.rendering.stream.fields import Field, FrameField, NetworkField, central_slopes
from fhash_codec.rendering.stream.inference import PatchInference
from fhash_codec.rendering.stream.stream import stream
from fhash_codec.rendering.task.arrays import NUMPY, Arrays
from fhash_codec.rendering.task.bricks import Bricks
from fhash_codec.rendering.task.devices import arrays_on
from fhash_codec.rendering.task.light import light_grid
from fhash_codec.rendering.task.task import Frame, Lighting, Marched, Surface, Table, Task
from fhash_formats.errors import InputError
from fhash_formats.series import Coordinate

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
    "coarse": {"march": {"lod": 1}},
    "zoomed": {"camera": {"zoom": 8}},
    "unskipped": {"march": {"skipping": False}},
    "long steps": {"march": {"step": 20}, "effects": {"isosurfaces": [{"value": 5}]}},
}

CENTRAL: dict[str, Any] = {
    "effects": {
        "shading": {"light": [1, 2, 3], "gradient": "central"},
        "isosurfaces": [{"value": 5, "opacity": 0.5}],
        "buffers": ["depth", "normal"],
    }
}


def picture(
    renderer: Renderer, mode: str, scene: dict[str, Any], size: tuple[int, int] = (48, 40)
) -> Image:
    return renderer.render(
        Scene.from_dict({**scene, "size": size, "march": {**scene.get("march", {}), "mode": mode}})
    )


@pytest.mark.skipif(native.library() is None, reason="compares with the native packets")
@pytest.mark.parametrize("name", SCENES)
def test_three_ways_make_one_picture(renderer: Renderer, name: str) -> None:
    cache, streamed, adaptive = (
        picture(renderer, mode, SCENES[name]) for mode in ("cache", "stream", "arm")
    )
    assert cache.rgba[..., 3].max() > 0.05
    np.testing.assert_array_equal(streamed.rgba, adaptive.rgba)
    np.testing.assert_allclose(streamed.rgba, cache.rgba, atol=1e-3)
    if cache.depth is not None and streamed.depth is not None:
        np.testing.assert_allclose(streamed.depth, cache.depth, atol=1e-3)
    if cache.normal is not None and streamed.normal is not None:
        np.testing.assert_allclose(streamed.normal, cache.normal, atol=1e-3)


def test_adaptive_marching_takes_at_most_half_the_passes(renderer: Renderer) -> None:
    streamed, adaptive, large = (
        picture(renderer, mode, {"march": march})
        for mode, march in (("stream", {}), ("arm", {}), ("arm", {"samples_per_pass": 10**6}))
    )
    assert adaptive.counters["passes"] <= streamed.counters["passes"] / 2
    assert large.counters["passes"] < adaptive.counters["passes"]
    np.testing.assert_array_equal(large.rgba, streamed.rgba)


def test_a_small_budget_is_plain_streaming(renderer: Renderer) -> None:
    streamed, adaptive = (
        picture(renderer, mode, {"march": {"samples_per_pass": 1}}) for mode in ("stream", "arm")
    )
    assert streamed.counters == adaptive.counters


@pytest.mark.parametrize("mode", ["stream", "arm"])
def test_counters_prove_that_nothing_else_is_done(renderer: Renderer, mode: str) -> None:
    plain = picture(renderer, mode, {}).counters
    assert plain["gradients"] == plain["secondary_rays"] == 0
    assert plain["evaluations"] == plain["samples"] > 0
    shaded = picture(renderer, mode, {"effects": {"shading": True}}).counters
    assert 0 < shaded["gradients"] <= shaded["samples"]
    assert {**shaded, "gradients": 0} == plain
    around = picture(
        renderer,
        mode,
        {"effects": {"box": True, "axes": True, "colour_bar": True, "time_label": True}},
    ).counters
    assert around == plain
    depth = picture(renderer, mode, {"effects": {"buffers": ["depth"]}}).counters
    assert depth == plain


def test_bricks_that_cannot_be_seen_cost_nothing(renderer: Renderer) -> None:
    narrow: dict[str, Any] = {"transfer_function": {"opacity": [[6, 0], [7, 0.5], [8, 0]]}}
    skipping, marching = (
        picture(renderer, "arm", {**narrow, "march": {"skipping": on}}) for on in (True, False)
    )
    np.testing.assert_array_equal(skipping.rgba, marching.rgba)
    assert skipping.counters["skipped_bricks"] > 0
    assert marching.counters["skipped_bricks"] == 0
    assert skipping.counters["samples"] < marching.counters["samples"] / 3


def test_only_samples_in_visible_cells_are_evaluated(renderer: Renderer) -> None:
    narrow = {"transfer_function": {"opacity": [[4, 0], [4.2, 0.1], [4.4, 0]]}}
    found, everything = (
        picture(renderer, "arm", {**narrow, "march": {"skipping": on, "threshold": 0.0}})
        for on in (True, False)
    )
    np.testing.assert_array_equal(found.rgba, everything.rgba)
    frame = renderer.volume.read(0)
    corners = [
        frame[tuple(slice(up, n - 1 + up) for up, n in zip(corner, frame.shape, strict=True))]
        for corner in np.ndindex(2, 2, 2)
    ]
    visible = (np.min(corners, axis=0) < 4.4) & (np.max(corners, axis=0) > 4)
    task = renderer.plan(Scene.from_dict({**narrow, "size": [48, 40]})).task
    beams = Beams.of(task, task.rays.grid.bounds, range(40))
    sample = np.arange(beams.end.max())[None]
    row, column = np.nonzero(sample < beams.end[:, None])
    x, y, z = np.minimum(beams.places(row, column).astype(int), np.array(visible.shape[::-1]) - 1).T
    inside = int(visible[z, y, x].sum())
    assert inside <= found.counters["evaluations"] <= 1.1 * inside


def test_rays_end_where_no_light_is_left(renderer: Renderer) -> None:
    opaque: dict[str, Any] = {"transfer_function": {"opacity": "opaque"}}
    ending, going = (
        picture(renderer, "stream", {**opaque, "march": {"threshold": threshold}})
        for threshold in (1 / 1024, 0.0)
    )
    assert ending.counters["samples"] < going.counters["samples"] / 4
    np.testing.assert_allclose(ending.rgba, going.rgba, atol=1 / 1024)


NETWORK: dict[str, Any] = {
    "effects": {"shading": True, "isosurfaces": [{"value": 5, "opacity": 0.5}]}
}


@pytest.mark.parametrize("step", [0.0, 0.7])
def test_both_ways_make_the_same_picture_of_a_network(files: dict[str, Path], step: float) -> None:
    with fhash_codec.open(files["paper"]) as network:
        streamed, adaptive = (
            picture(Renderer(network), mode, {**NETWORK, "step": step})
            for mode in ("stream", "arm")
        )
    assert streamed.rgba[..., 3].max() > 0.05
    np.testing.assert_array_equal(streamed.rgba, adaptive.rgba)


def test_a_network_is_evaluated_at_every_sample(files: dict[str, Path]) -> None:
    with fhash_codec.open(files["paper"]) as network:
        cache, streamed = (
            picture(Renderer(network), mode, NETWORK).counters for mode in ("cache", "stream")
        )
    assert cache["evaluations"] == 0
    assert 0 < streamed["evaluations"] <= streamed["samples"]


@pytest.mark.parametrize("step", [0.0, 0.7])
def test_the_picture_of_a_network_is_near_that_of_its_vertices(
    files: dict[str, Path], step: float
) -> None:
    with fhash_codec.open(files["paper"]) as network:
        cache, streamed = (
            picture(Renderer(network), mode, {**NETWORK, "step": step}).rgba
            for mode in ("cache", "stream")
        )
    assert np.isfinite(streamed).all()
    # Between vertices the network has values of its own: they make all the difference.
    assert np.mean(np.abs(streamed - cache)) < 0.02


def frame_task(
    values: np.ndarray, *, step: float = 0.5, surfaces: tuple[Surface, ...] = (), fog: float = 0.0
) -> tuple[FrameField, Task]:
    axes = {
        axis: Coordinate(name=axis, values=np.arange(n, dtype=float), attributes={})
        for axis, n in zip("zyx", values.shape, strict=True)
    }
    grid = Grid.of(axes)
    frame = Frame(values=values.astype(np.float32), first=(0, 0, 0))
    rays = Rays.of(Camera(view="xy", projection="parallel", parallel_scale=2.0), grid, (8, 8))
    table = (
        Table(
            low=0.0,
            high=1.0,
            colours=np.ones((2, 3), dtype=np.float32),
            extinctions=np.full(2, fog),
        )
        if fog
        else None
    )
    return FrameField(frame, grid, Bricks.of(frame)), Task(
        rays=rays, step=step, threshold=0.0, table=table, surfaces=surfaces
    )


@pytest.mark.parametrize("fog", [1e-9, 1e-3, 0.3])
@pytest.mark.parametrize("step", [0.02, 0.37, 5.0])
def test_a_slab_of_fog_is_as_opaque_as_its_length(fog: float, step: float) -> None:
    field, task = frame_task(np.full((9, 7, 7), 0.5), step=step, fog=fog)
    rgba = stream(field, task, adaptive=True).rgba
    np.testing.assert_allclose(rgba, -np.expm1(-fog * 8), rtol=1e-6)


@pytest.mark.parametrize("budget", [1, 10**6])
@pytest.mark.parametrize("value", [0.381, 0.395, 0.405, 0.81, 0.795, 0.99])
@pytest.mark.parametrize(("count", "step"), [(11, 0.5), (10, 3.9)])
def test_a_surface_is_seen_between_places_of_which_one_is_in_a_brick_without(
    value: float, count: int, step: float, budget: int
) -> None:
    ramp = np.broadcast_to(np.linspace(0, 1, count)[:, None, None], (count, 7, 7))
    field, task = frame_task(
        ramp, step=step, surfaces=(Surface(value=value, colour=np.ones(3), opacity=0.5),)
    )
    task = replace(
        task,
        lighting=Lighting(ambient=1.0, diffuse=0.0, specular=0.0, specular_power=1.0, lamp=None),
    )
    for skipping in (True, False):
        found = stream(field, replace(task, skipping=skipping), adaptive=True, budget=budget)
        np.testing.assert_allclose(found.rgba, 0.5, atol=1e-6)


@pytest.mark.parametrize("budget", [1, 10**6])
@pytest.mark.parametrize("level", [0.0625, 0.3, 0.6, 0.9375])
def test_every_crossing_of_a_wave_is_seen(level: float, budget: int) -> None:
    wave = np.abs((np.arange(97) + 12) % 24 - 12.0) / 12
    field, task = frame_task(
        np.broadcast_to(wave[:, None, None], (97, 7, 7)),
        step=0.9,
        surfaces=(Surface(value=level, colour=np.ones(3), opacity=0.1),),
    )
    task = replace(
        task,
        lighting=Lighting(ambient=1.0, diffuse=0.0, specular=0.0, specular_power=1.0, lamp=None),
    )
    np.testing.assert_allclose(
        stream(field, task, adaptive=True, budget=budget).rgba, 1 - 0.9**8, atol=1e-6
    )


def test_nothing_is_seen_of_what_has_no_value() -> None:
    field, task = frame_task(np.full((9, 7, 7), np.nan), fog=1.0)
    found = stream(field, task, adaptive=False)
    assert not found.rgba.any()
    assert found.counters["samples"] == 0


def test_roots_are_exact() -> None:
    sample = np.arange(6.0)[None]
    found = crossings(
        lambda row, at: (at - 2.3) ** 3,
        sample,
        (sample - 2.3) ** 3,
        (
            Surface(value=0.0, colour=np.ones(3), opacity=0.5),
            Surface(value=-1.0, colour=np.ones(3), opacity=0.25),
        ),
    )
    assert found.opacity[0].tolist() == [[0, 0], [0.25, 0], [0.5, 0], [0, 0], [0, 0]]
    np.testing.assert_allclose(found.at[0, 1:3, 0], [1.3, 2.3], atol=1e-4)
    assert found.which[0, 1:3, 0].tolist() == [1, 0]


def planned(volume: Volume, scene: dict[str, Any], arrays: Arrays) -> tuple[Field, Task]:
    """A scene's task and the field that it is marched through, in arrays of one kind."""
    plan = Renderer(volume).plan(Scene.from_dict({"size": [40, 34], **scene}))
    task, grid = plan.task, plan.task.rays.grid
    if volume.profile == "paper":
        return NetworkField(volume, plan.step, plan.units, arrays), task
    frame = decoded_frame(volume, plan.step, plan.lod, plan.region, plan.units)
    if plan.lights:
        light = light_grid(
            frame,
            grid,
            task.table,
            shadows=plan.shadows,
            lamp=plan.lamp,
            ambient_occlusion=plan.occlusion,
        )
        task = replace(task, light=light)
    return FrameField(frame, grid, Bricks.of(frame), arrays), task


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


@pytest.mark.parametrize("adaptive", [False, True])
@pytest.mark.parametrize("name", [*SCENES, "central"])
def test_torch_makes_the_picture_of_numpy(
    volume: Volume, tensors: Arrays, name: str, adaptive: bool
) -> None:
    scene = {**SCENES, "central": CENTRAL}[name]
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


@pytest.mark.parametrize("kind", ["compact", "paper"])
def test_nothing_leaves_the_device_before_the_picture(
    files: dict[str, Path], tensors: Arrays, kind: str
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
            assert function.__name__ not in ("cpu", "numpy", "tolist", "__array__", "cuda"), (
                function.__name__
            )
            assert function.__name__ == "from_numpy" or not any(
                isinstance(each, (np.ndarray, np.generic)) for each in args
            ), function
            return function(*args, **(kwargs or {}))

    effects = {
        "shadows": kind == "compact",
        "shading": {"gradient": "central"},
        "isosurfaces": [{"value": 5, "opacity": 0.5}],
    }
    scene = {"effects": {**effects, "buffers": ["depth", "normal"], "jitter": True}}
    with fhash_codec.open(files[kind]) as found:
        field, task = planned(found, scene, Watched(torch.device("cpu")))
        with Watch():
            marched = stream(field, task, adaptive=True, budget=3000)
    assert marched.rgba.any()
    rays = 40 * 34
    assert sorted(taken) == [rays, 3 * rays, 4 * rays]


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
    "central": CENTRAL,
    "unskipped": {"march": {"skipping": False}},
}


class HostInference:
    """The values and slopes of `PatchInference` in other arrays: the same bits in every march."""

    def __init__(self, network: Network, key: float, arrays: Arrays) -> None:
        self._patches, self._arrays = PatchInference(network, key), arrays

    def values(self, places: Any) -> Any:
        return self._arrays.array(self._patches.values(self._arrays.host(places)))

    def slopes(self, places: Any) -> Any:
        return self._arrays.array(self._patches.slopes(self._arrays.host(places)).copy())


@pytest.mark.parametrize("name", NETWORK_SCENES)
def test_torch_marches_through_a_network_as_numpy_does(
    files: dict[str, Path], tensors: Arrays, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Other values would turn decisions: where a ray ends, and on which side of a kink it is lit.
    monkeypatch.setattr(fields, "DenseInference", HostInference)
    with fhash_codec.open(files["paper"]) as network:
        here, there = (
            stream(*planned(network, NETWORK_SCENES[name], arrays), adaptive=True)
            for arrays in (NUMPY, tensors)
        )
    assert here.rgba[..., 3].max() > 0.05
    np.testing.assert_allclose(there.rgba, here.rgba, atol=1e-4)
    assert there.counters["evaluations"] > 0
    assert_same_work(here, there, NETWORK_SCENES[name])
    if here.normal is not None:
        assert here.normal.any()
        np.testing.assert_allclose(there.depth, here.depth, atol=1e-3)
        np.testing.assert_allclose(there.normal, here.normal, atol=1e-3)


def test_torch_evaluates_a_network_as_numpy_does(files: dict[str, Path], tensors: Arrays) -> None:
    # No ray ends early, so that rounding of the values decides nothing.
    scene = {"march": {"threshold": 0.0}}
    with fhash_codec.open(files["paper"]) as network:
        here, there = (
            stream(*planned(network, scene, arrays), adaptive=True) for arrays in (NUMPY, tensors)
        )
    np.testing.assert_allclose(there.rgba, here.rgba, atol=1e-4)
    assert there.counters == here.counters


@pytest.mark.parametrize("kind", ["compact", "paper"])
def test_cuda_makes_the_picture_of_numpy(files: dict[str, Path], kind: str) -> None:
    import torch

    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    with fhash_codec.open(files[kind]) as found:
        here, there = (
            stream(*planned(found, CENTRAL, arrays_on(device)), adaptive=True)
            for device in ("cpu", "cuda")
        )
    assert here.rgba[..., 3].max() > 0.05
    np.testing.assert_allclose(there.rgba, here.rgba, atol=1e-4)
    np.testing.assert_allclose(there.normal, here.normal, atol=1e-3)
    assert there.counters["rays"] == here.counters["rays"]


def test_only_vertices_of_weight_need_a_value() -> None:
    values = np.arange(27.0).reshape(3, 3, 3)
    values[:, :, 1] = np.nan
    field, _ = frame_task(values)
    places = np.array([[0, 1, 1], [2, 1, 1], [2, 0.5, 1.5], [0.5, 0, 0], [1.5, 1, 1]], dtype=float)
    np.testing.assert_array_equal(field.values(places), [12, 14, 17, np.nan, np.nan])


def test_central_differences_reach_one_vertex_to_both_sides() -> None:
    z, y, x = np.meshgrid(*map(np.arange, (9.0, 7.0, 8.0)), indexing="ij")
    values = 0.3 * x**2 - 2 * y + x * z
    values[4, 3, 7] = np.nan
    field, _ = frame_task(values)
    values = values.astype(np.float32)
    inner = field.arrays.array([[3.0, 2.0, 5.0]])
    np.testing.assert_allclose(central_slopes(field, inner), [[0.3 * 6 + 5, -2, 3]], rtol=1e-6)
    # At an end the place beyond it is the end itself.
    end = central_slopes(field, np.array([[0.0, 6.0, 2.0]]))
    np.testing.assert_allclose(end, [[(0.3 + 2) / 2, -1, 0]], rtol=1e-6, atol=1e-9)
    # Beside a missing vertex, along x, the slope within the cell.
    np.testing.assert_allclose(field.values(np.array([[6.25, 3.0, 4.0]])), np.nan)
    found = central_slopes(field, np.array([[5.25, 3.0, 4.0]]))
    np.testing.assert_allclose(found[0, 0], values[4, 3, 6] - values[4, 3, 5], rtol=1e-6)
    np.testing.assert_allclose(found[0, 1:], [-2, 5.25], rtol=1e-6)


def test_central_differences_are_per_vertex_at_every_stride() -> None:
    x = np.broadcast_to(np.arange(0, 18, 2.0) ** 2, (5, 5, 9))
    grid = Grid(counts=(17, 9, 9), origin=np.zeros(3), spacing=np.ones(3))
    frame = Frame(values=x.astype(np.float32), first=(0, 0, 0), stride=2)
    field = FrameField(frame, grid, Bricks.of(frame))
    np.testing.assert_allclose(
        central_slopes(field, np.array([[6.0, 4.0, 4.0]])), [[12.0, 0, 0]], rtol=1e-6
    )
    # Beyond the last vertex, up to the end of the domain, it is that of the last vertex.
    wider = FrameField(frame, replace(grid, counts=(18, 9, 9)), Bricks.of(frame))
    np.testing.assert_allclose(
        central_slopes(wider, np.array([[16.0, 4.0, 4.0], [16.9, 4.0, 4.0]])),
        [[15.0, 0, 0]] * 2,
        rtol=1e-6,
    )


def test_central_shading_differs_from_that_of_cells_and_keeps_the_normals(volume: Volume) -> None:
    effects = {**CENTRAL["effects"], "shading": {"light": [1, 2, 3]}}
    cells, central = (
        stream(*planned(volume, scene, NUMPY), adaptive=True)
        for scene in ({**CENTRAL, "effects": effects}, CENTRAL)
    )
    assert 1e-3 < np.abs(cells.rgba - central.rgba)[..., :3].max() < 0.3
    np.testing.assert_array_equal(cells.rgba[..., 3], central.rgba[..., 3])
    np.testing.assert_array_equal(cells.normal, central.normal)
    assert cells.counters == central.counters


def test_a_device_is_named_and_never_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert arrays_on("cpu") is arrays_on("auto") is NUMPY
    with pytest.raises(InputError, match="no CUDA device"):
        arrays_on("cuda")
    with pytest.raises(InputError, match="'gpu'; allowed: auto, cpu, cuda"):
        arrays_on("gpu")


def test_marching_on_the_processor_loads_no_torch() -> None:
    code = (
        "import sys; from fhash_codec.rendering.task import devices; "
        "import fhash_codec.rendering.stream.stream; devices._driver_exists = lambda: False; "
        "devices.arrays_on('auto'); devices.arrays_on('cpu'); print('torch' in sys.modules)"
    )
    assert (
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        ).stdout
        == "False\n"
    )


def test_a_device_without_enough_memory_says_so(
    volume: Volume, tensors: Arrays, monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch

    def full(places: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    field, task = planned(volume, {}, tensors)
    monkeypatch.setattr(field, "values", full)
    with pytest.raises(InputError, match="memory of the device"):
        stream(field, task, adaptive=True)


def test_a_field_that_does_not_fit_says_so(
    files: dict[str, Path], volume: Volume, tensors: Arrays, monkeypatch: pytest.MonkeyPatch
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
