"""The plan of a picture, and its reasons."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig, Scene, Volume
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.rendering.grid import Grid, Warp
from fhash_codec.rendering.march_task import (
    DENSEST,
    NUMPY,
    Array,
    Arrays,
    Frame,
    Units,
    extinctions_in,
    warped,
)
from fhash_codec.rendering.plan import MAX_RAYS, Plan, arrays_on, plan_picture
from fhash_codec.rendering.renderer import Renderer
from fhash_codec.rendering.transfer_function import Histogram
from fhash_formats.errors import FhashWarning, InputError, RegionError
from fhash_formats.series import ArraySeries, Coordinate


def plan(volume: Volume, **scene: Any) -> Plan:
    return plan_picture(volume, Scene.from_dict(scene))


def test_what_no_effect_asks_for_is_not_in_the_task(volume: Volume) -> None:
    planned = plan(volume)
    task = planned.task
    assert task.lighting is None
    assert task.light is None
    assert not planned.lights
    on = [task.shaded, task.surfaces, task.projection, task.depth, task.normal, task.jitter]
    assert not any(on)
    assert planned.to_dict()["gradient"] == "none: no effect asks for it"
    assert planned.to_dict()["secondary rays"] == "none: no effect asks for them"


def test_each_effect_changes_its_own_part_of_the_task(volume: Volume) -> None:
    shaded = plan(volume, effects={"shading": {"light": [0, 0, 2]}}).task
    assert shaded.shaded
    np.testing.assert_allclose(shaded.lighting.lamp, [0, 0, 1])  # type: ignore[union-attr]
    assert plan(volume, effects={"shading": True}).task.lighting.lamp is None  # type: ignore[union-attr]
    surfaces = plan(
        volume,
        effects={
            "isosurfaces": [{"value": 4, "colour": "red"}, {"value": 5}, {"value": 6, "opacity": 0}]
        },
    )
    assert [surface.value for surface in surfaces.task.surfaces] == [4, 5]
    np.testing.assert_allclose(surfaces.task.surfaces[0].colour, [1, 0, 0])
    np.testing.assert_allclose(surfaces.task.surfaces[1].colour, surfaces.function.colour(5))
    assert not surfaces.task.shaded
    assert plan(volume, effects={"buffers": ["normal"]}).task.normal
    assert plan(volume, effects={"shadows": {"strength": 0}}).shadows is None


def test_a_surface_beyond_the_values_is_told(volume: Volume) -> None:
    low, high = volume.value_range.low, volume.value_range.high
    for beyond in (low - 1, high + 1):
        with pytest.warns(FhashWarning, match=rf"isosurface {beyond:.6g}: .* reaches from") as told:
            plan(volume, effects={"isosurfaces": [{"value": beyond}, {"value": high}]})
        assert len(told) == 1
    plan(volume, effects={"isosurfaces": [{"value": low}, {"value": high}]})  # and no warning


def test_a_network_has_no_levels_of_detail(files: dict[str, Path]) -> None:
    with fhash_codec.open(files["paper"]) as network:
        assert plan(network, size=[4, 4]).lod == 0
        with pytest.raises(InputError, match="no levels of detail"):
            plan(network, march={"lod": 1})


def test_the_histogram_is_asked_for_only_where_it_matters(files: dict[str, Path]) -> None:
    asked = []

    def histogram() -> Histogram:
        asked.append(1)
        return np.linspace(0, 10, 11), np.arange(10)

    for name, scene, expected in (
        ("compact", {}, 1),
        ("compact", {"transfer_function": {"opacity": "linear"}}, 1),
        ("compact", {"transfer_function": {"opacity": "linear", "range": [0, 1]}}, 0),
        ("feature", {}, 0),
    ):
        with fhash_codec.open(files[name]) as opened:
            asked.clear()
            plan_picture(opened, Scene.from_dict(scene), histogram=histogram)
            assert len(asked) == expected


@pytest.mark.parametrize(
    ("scene", "words"),
    [
        ({"step": 2.5}, "outside the series"),
        ({"size": [16384, 16384]}, f"more than {MAX_RAYS:,} rays"),
        ({"size": [4096, 4096], "effects": {"antialiasing": 8}}, "smaller picture"),
        ({"transfer_function": {"nothing": True}}, "shows nothing"),
        (
            {
                "transfer_function": {"nothing": True},
                "effects": {"maximum_intensity": True, "isosurfaces": [{"value": 1}]},
            },
            "take one",
        ),
        (
            {"effects": {"maximum_intensity": True, "minimum_intensity": True}},
            "names maximum and minimum intensity; leave one of them",
        ),
        (
            {
                "transfer_function": {"gradient_opacity": [[0, 1]]},
                "effects": {"average_intensity": True},
            },
            "has no opacity that 'gradient_opacity' could change",
        ),
        ({"transfer_function": {"gradient_opacity": [[1, 0], [0, 1]]}}, "do not ascend"),
        ({"transfer_function": {"gradient_opacity": [[0, 0], [1, 2]]}}, "reach to 2; allowed"),
        ({"transfer_function": {"gradient_opacity": [[0, 0], [1, 0]]}}, "one of them above 0"),
        ({"effects": {"clip": {"x": [99, 100]}}}, "x 99 to 100 leaves nothing of the volume"),
        ({"transfer_function": {"opacity": [[0, 0], [9, 0]]}}, "shows nothing"),
        ({"transfer_function": {"density": 0}}, "shows nothing"),
        ({"background": "wite"}, "did you mean 'white'"),
        ({"effects": {"shading": {"light": [0, 0, 0]}}}, "no length"),
        (
            {"effects": {"shading": {"light": [0, 0, 1]}, "shadows": {"light": [0, 1, 1]}}},
            "one lamp",
        ),
        ({"march": {"mode": "cache", "device": "cuda"}}, "there is no CUDA device here"),
        ({"march": {"device": "gpu"}}, "allowed: auto, cpu, cuda"),
        ({"camera": {"position": [1, 1, 1], "focal_point": [1, 1, 1]}}, "are the same"),
        ({"camera": {"view_up": [0, 0, 0]}}, "no length"),
    ],
)
def test_what_cannot_be_drawn_is_refused(volume: Volume, scene: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        plan(volume, **scene)


def test_a_time_outside_is_refused(volume: Volume) -> None:
    with pytest.raises(RegionError):
        plan(volume, time=1e9)
    assert plan(volume, time=1.5).step == 1.5


def test_a_frame_that_is_too_large_is_refused_before_it_is_decoded(
    volume: Volume, files: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    vertices = int(np.prod(volume.shape[1:]))
    monkeypatch.setattr("fhash_codec.rendering.plan.MAX_VALUES", vertices - 1)
    march = {"lod": 0}
    with pytest.raises(InputError, match=f"{vertices:,} vertices is too large to march; allowed"):
        plan(volume, march=march)
    assert plan(volume, march={"lod": 1}).lod == 1
    monkeypatch.setattr("fhash_codec.rendering.plan.MAX_VALUES", 1)
    with fhash_codec.open(files["paper"]) as network:
        assert plan(network, march={"mode": "arm"}).mode == "arm"
        with pytest.raises(InputError, match="too large to march"):
            plan(network, march={"mode": "arm"}, effects={"shadows": True})


def test_a_picture_that_would_take_ages_is_told(volume: Volume) -> None:
    for scene in ({"scale": [1e6, 1, 1e-6]}, {"march": {"step": 1e-5}}):
        with pytest.warns(FhashWarning, match="a ray takes up to .* samples"):
            plan(volume, **scene)


def test_a_picture_that_would_never_end_is_refused(volume: Volume) -> None:
    with pytest.raises(
        InputError, match=r"a ray takes up to .* samples, .*at most 1e\+08 are taken"
    ):
        plan(volume, scale=[1e5, 1, 1e-5], march={"step": 1e-6})


def test_axes_between_whose_vertices_no_ray_can_be_placed_are_refused(volume: Volume) -> None:
    with pytest.raises(
        InputError,
        match=r"no ray can be placed that finely, at most 1e\+14 times; stretch the axes",
    ):
        plan(volume, scale=[8e29, 2.4e29, 1e-30])


def test_colours_of_a_projection_are_those_of_all_values(volume: Volume) -> None:
    spec = {"range": [1, 6], "opacity": [[3, 0], [4, 1], [5, 0]]}
    for effect, low in ((None, 3.0), ("minimum_intensity", 1.0), ("average_intensity", 1.0)):
        effects = {} if effect is None else {effect: True}
        scene = Scene.from_dict({"transfer_function": spec, "effects": effects})
        table = plan_picture(volume, scene).task.table
        assert table is not None
        assert table.low == pytest.approx(low)


@pytest.mark.parametrize(
    ("march", "gpu", "mode", "device"),
    [
        ({}, True, "arm", "cuda"),
        ({}, False, "cache", "cpu"),
        ({"device": "cpu"}, True, "cache", "cpu"),
        ({"mode": "cache"}, True, "cache", "cuda"),
        ({"mode": "arm"}, False, "arm", "cpu"),
        ({"device": "cuda"}, True, "arm", "cuda"),
    ],
)
def test_auto_is_arm_on_a_gpu_and_cache_on_a_cpu(
    volume: Volume,
    files: dict[str, Path],
    monkeypatch: pytest.MonkeyPatch,
    march: dict[str, str],
    gpu: bool,
    mode: str,
    device: str,
) -> None:
    module = "fhash_codec.rendering.plan"
    for place in (module, "fhash_codec.devices"):
        monkeypatch.setattr(f"{place}.has_device", lambda: gpu)
    monkeypatch.setattr(f"{module}.CUDA_START", 0.0)  # any picture pays
    with fhash_codec.open(files["paper"]) as network:
        planned = plan(network, march=march)
    assert (planned.mode, planned.device) == (mode, device)
    if march.get("mode", "auto") != "arm":
        assert plan(volume, march=march).mode == "cache"
    line = planned.to_dict()["march"]
    assert line.startswith(f"{mode}: ")
    chosen = "mode" not in march
    assert ("chosen for the GPU" in line) == (chosen and mode == "arm")
    assert ("fastest on a CPU" in line) == (chosen and mode == "cache")


def test_a_device_is_taken_where_its_start_pays(
    volume: Volume, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = "fhash_codec.rendering.plan"
    monkeypatch.setattr(f"{module}.usable_threads", lambda: 4)
    scene = Scene.from_dict({"size": [512, 512]})
    assert plan_picture(volume, scene, pictures=1000).why_device == "there is no CUDA device"
    with pytest.raises(InputError, match="no CUDA device here; use --device cpu"):
        plan(volume, march={"device": "cuda"})
    monkeypatch.setattr(f"{module}.has_device", lambda: True)
    one, many = (plan_picture(volume, scene, pictures=count) for count in (1, 1000))
    assert (one.device, many.device) == ("cpu", "cuda")
    grid = one.task.rays.grid
    longest = np.linalg.norm((np.array(grid.counts) - 1) * grid.spacing) / one.task.step
    width, height = one.task.rays.size
    seconds = width * height * longest / 2 / (4 * 4e7)
    assert f"about {seconds:.2g} s, and CUDA takes" in one.why_device
    assert f"about {1000 * seconds:.2g} s for 1000 pictures, and" in many.why_device
    assert one.to_dict()["device"] == f"cpu: {one.why_device}"


@pytest.mark.parametrize("few", [True, False])
def test_auto_is_arm_on_a_cpu_where_all_samples_cost_less_than_the_frame(
    tmp_path: Path, volume: Volume, monkeypatch: pytest.MonkeyPatch, few: bool
) -> None:
    """Both sides of the number; a compact file, and light, need the frame in any case."""
    module = "fhash_codec.rendering.plan"
    monkeypatch.setattr(f"{module}.has_device", lambda: False)
    path = tmp_path / "a.fhz"
    field = np.random.default_rng(0).random((2, 4, 5, 6), dtype=np.float32)
    fhash_codec.encode(
        field, path, EncodeConfig(preset="published", tables="float16", epochs=1, width=4)
    )
    samples = 16 * 16 * np.sqrt(4**2 + 5**2 + 6**2) / 0.5
    limit = 4 * 5 * 6 / samples
    monkeypatch.setattr(f"{module}.VERTICES_A_SAMPLE", limit * (0.999 if few else 1.001))
    scene = {"size": [16, 16], "march": {"step": 0.5}}
    with fhash_codec.open(path) as paper:
        planned = plan(paper, **scene)
        assert planned.mode == ("arm" if few else "cache")
        line = planned.to_dict()["march"]
        assert ("cost less than decoding the frame" in line) == few
        assert ("fastest on a CPU" in line) == (not few)
        smooth = {"effects": {"antialiasing": 2}}
        lit = {"effects": {"shadows": {}}}
        assert {plan(paper, **scene, **more).mode for more in (smooth, lit)} == {"cache"}
        marched = plan(paper, **{**scene, "march": {"step": 0.5, "mode": "cache"}})
        assert marched.mode == "cache"
    assert plan(volume, **scene).mode == "cache"


def lines(volume: Volume, **scene: Any) -> dict[str, str]:
    return plan_picture(volume, Scene.from_dict(scene)).to_dict()


@pytest.mark.parametrize(
    ("scene", "topic", "words"),
    [
        ({"size": [30, 20], "effects": {"antialiasing": 2}}, "picture", "30 x 20, perspective, 4 "),
        ({"scale": [1, 2, 3]}, "proportions", "stretched by 1, 2, 3: as the scene says"),
        ({"step": 0.5}, "time", "step 0.5, between two: both are decoded"),
        ({}, "march", "then march what was decoded, as is fastest on a CPU where rays need most"),
        ({"march": {"mode": "arm"}}, "march", "arm: decode a tile when a ray comes to it"),
        (
            {"march": {"mode": "arm"}, "effects": {"shadows": True}},
            "march",
            "arm: decode all tiles, which light needs",
        ),
        ({"march": {"mode": "stream"}}, "march", "in a pass, through a decoded frame"),
        ({"effects": {"maximum_intensity": True}}, "value", "the largest along each ray"),
        ({"effects": {"minimum_intensity": True}}, "value", "the smallest along each ray"),
        ({"effects": {"average_intensity": True}}, "value", "the mean along each ray"),
        ({"effects": {"average_intensity": True}}, "bricks", "only those that hold values; all"),
        ({"effects": {"average_intensity": True}}, "rays end", "behind the volume"),
        (
            {"effects": {"attenuated_maximum_intensity": True}},
            "rays end",
            "where no later value can be larger",
        ),
        (
            {"transfer_function": {"gradient_opacity": [[0, 0], [1, 1]]}},
            "gradient",
            "where a sample has opacity, for opacity by gradient",
        ),
        (
            {"effects": {"clip": {"z": [2, 5], "planes": [{"normal": [1, 0, 0], "offset": 2}]}}},
            "clip",
            "x 0 to 27, y 0 to 23, z 2 to 5, cut by 1 plane(s): nothing outside is decoded",
        ),
        ({"effects": {"clip": {"z": [2, 5]}}}, "region", "(what the clip leaves, in whole tiles)"),
        ({"effects": {"isosurfaces": [{"value": 5}]}}, "value", "can be seen, and 1 surface(s)"),
        ({"effects": {"isosurfaces": [{"value": 5}]}}, "gradient", "on surfaces, for shading"),
        ({"effects": {"shading": True}}, "gradient", "where a sample has opacity, for shading"),
        ({"effects": {"shadows": True}}, "secondary rays", "shadows on a grid of 2 vertices"),
        ({"effects": {"ambient_occlusion": True}}, "secondary rays", "within 8 vertices"),
        ({"effects": {"shadows": True}}, "region", "(all: light comes from everywhere)"),
        ({"march": {"lod": 1}}, "level of detail", "1: as the scene says"),
        ({"march": {"skipping": False}}, "bricks", "all are marched: skipping is off"),
        ({"march": {"threshold": 0}}, "rays end", "behind the volume"),
    ],
)
def test_a_line_says_what_the_scene_asks_for(
    volume: Volume, scene: dict[str, Any], topic: str, words: str
) -> None:
    assert words in lines(volume, **scene)[topic]
    assert all("\n" not in line for line in lines(volume, **scene).values())


def encoded(path: Path, values: np.ndarray, **config: Any) -> Path:
    fhash_codec.encode(values, path, fhash_codec.EncodeConfig(effort=1, **config))
    return path


@pytest.mark.parametrize("axis", [1, 2, 3])
def test_a_plane_is_planned_opaque_unlit_and_from_above(tmp_path: Path, axis: int) -> None:
    shape = [2, 9, 10, 11]
    shape[axis] = 1
    values = np.random.default_rng(0).random(shape).astype(np.float32)
    with fhash_codec.open(encoded(tmp_path / "a.fhz", values)) as flat:
        lit = plan(flat, effects={"shading": True, "shadows": True, "ambient_occlusion": True})
        assert not lit.task.shaded
        assert not lit.lights
        assert lit.function.opacity(0.5) == 1
        np.testing.assert_allclose(np.abs(lit.task.rays.forward), np.eye(3)[3 - axis], atol=1e-12)
        # What the user says goes before.
        given = plan(
            flat, camera={"view": "iso"}, transfer_function={"opacity": [[0, 0.25], [1, 0.25]]}
        )
        assert given.function.opacity(0.5) == 0.25
        assert np.count_nonzero(np.abs(given.task.rays.forward) > 0.1) == 3


@pytest.mark.torch
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
        "import sys; from fhash_codec.rendering import plan as devices; "
        "import fhash_codec.rendering.stream_march; devices.may_have_cuda = lambda: False; "
        "devices.arrays_on('auto'); devices.arrays_on('cpu'); print('torch' in sys.modules)"
    )
    assert (
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        ).stdout
        == "False\n"
    )


VALUES = np.array([[0.0, -1.75, 2.5], [3.25, 0.0, -0.5]])


def results(arrays: Arrays) -> dict[str, Array]:
    """The result of each operation, on the host."""
    values = arrays.array(VALUES)
    order = arrays.array([[2, 0, 1], [0, 0, 2]], "int64")
    sums = arrays.full((3, 2), 1.0)
    rows = arrays.array([2, 0, 2], "int64")
    arrays.add_rows(sums, rows, arrays.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]))
    copy = arrays.copy(values)
    copy[0] = 9.0
    found = {
        "array": values,
        "float32": arrays.to_float32(values),
        "int64": arrays.to_int64(values),
        "float64": arrays.to_float64(arrays.to_int64(values)),
        "range": arrays.range(4),
        "full": arrays.full((2, 2), 7, "int64"),
        "row": arrays.nonzero(values)[0],
        "column": arrays.nonzero(values)[1],
        "taken": arrays.take_along(values, order, 1),
        "sums": sums,
        "copied from": values,
    }
    return {name: arrays.host(array) for name, array in found.items()}


@pytest.mark.torch
def test_operations_equal_those_of_numpy(tensors: Arrays) -> None:
    expected, result = results(NUMPY), results(tensors)
    for name, array in expected.items():
        assert result[name].dtype == array.dtype, name
        np.testing.assert_array_equal(result[name], array, err_msg=name)


@pytest.mark.torch
def test_a_device_without_memory_is_an_input_error(tensors: Arrays) -> None:
    import torch

    with pytest.raises(InputError, match="smaller"), tensors.guarded():
        raise torch.OutOfMemoryError("too much")


GRID = Grid(counts=(11, 9, 1), origin=np.zeros(3), spacing=np.ones(3))


@pytest.mark.parametrize(
    ("first", "shape", "stride", "bounds"),
    [
        ((0, 0, 0), (1, 9, 11), 1, [[0, 10], [0, 8], [-0.5, 0.5]]),
        ((0, 2, 3), (1, 4, 5), 1, [[3, 7], [2, 5], [-0.5, 0.5]]),
        # No further vertex would fit: the last values stand up to the end.
        ((0, 0, 0), (1, 3, 4), 3, [[0, 10], [0, 8], [-0.5, 0.5]]),
        ((0, 0, 0), (1, 2, 3), 3, [[0, 6], [0, 3], [-0.5, 0.5]]),
    ],
)
def test_the_bounds_of_a_frame_reach_to_where_it_has_values(
    first: tuple[int, int, int], shape: tuple[int, ...], stride: int, bounds: list[list[float]]
) -> None:
    frame = Frame(values=np.zeros(shape, dtype=np.float32), first=first, stride=stride)
    np.testing.assert_array_equal(frame.bounds(GRID), bounds)


def test_extinctions_in_another_length_stay_finite() -> None:
    extinctions = np.array([0.0, 2.0, 1e300])
    np.testing.assert_array_equal(extinctions_in(extinctions, 1e20), [0.0, 2e20, DENSEST])


def volume(low: float, high: float, dtype: str) -> Volume:
    fields = SimpleNamespace(value_range=ValueRange(low, high), float_dtype=np.dtype(dtype))
    return cast(Volume, fields)


@pytest.mark.parametrize(
    ("low", "high"), [(0.0, 1.0), (1e6, 1e6 + 1), (-1e-300, 1e-300), (-1e300, 1e300), (5.0, 5.0)]
)
def test_converted_values_have_a_size_near_one(low: float, high: float) -> None:
    units = Units.of(volume(low, high, "float64"))
    assert math.frexp(units.factor)[0] == 0.5, "a power of two"
    ends = units.to([low, high])
    assert np.isfinite(ends).all()
    assert np.abs(ends).max() <= 1


def test_integers_that_are_one_float_cannot_be_drawn() -> None:
    top = 2**64 - 1
    with pytest.raises(InputError, match=f"cannot tell values from {top - 998} to {top} apart"):
        Units.of(volume(top - 998, top, "float64"))
    assert Units.of(volume(2**60, 2**60 + 998, "float64")).factor == 2.0**-10
    assert Units.of(volume(top, top, "float64")).factor > 0


PLACES = np.array([0, 0.25, 0.5, 1, 1.5, 2, 3, 4.0])
WARP = Warp(counts=(5, 2, 3), places=(PLACES, None, None))


def frame(values: np.ndarray, first: tuple[int, int, int] = (0, 0, 0), stride: int = 1) -> Frame:
    return Frame(values=values.astype(np.float32), first=first, stride=stride)


def test_a_vertex_without_a_value_takes_those_beside_it_along() -> None:
    values = np.arange(5.0)
    values[2] = np.nan
    line = warped(frame(np.broadcast_to(values, (3, 2, 5)).copy()), WARP).values[0, 0]
    np.testing.assert_array_equal(line, [0, 0.25, 0.5, 1, np.nan, np.nan, 3, 4])
    np.testing.assert_array_equal(values, [0, 1, np.nan, 3, 4])


def test_a_region_keeps_its_place() -> None:
    drawn = warped(frame(np.arange(1.0, 4.0)[None, None].repeat(2, axis=1), (1, 0, 1)), WARP)
    assert drawn.first == (1, 0, 3)
    np.testing.assert_allclose(drawn.values[0, 0], [1, 1.5, 2, 3])
    nothing = warped(frame(np.ones((1, 1, 1)), (0, 0, 4)), WARP)
    assert nothing.values.shape == (1, 1, 1)
    assert nothing.first == (0, 0, 7)


def test_a_coarse_frame_reaches_to_the_end() -> None:
    warp = Warp(counts=(6, 1, 1), places=(np.linspace(0, 5, 11), None, None))
    drawn = warped(frame(np.array([0.0, 2, 4])[None, None], stride=2), warp)
    assert drawn.stride == 2
    np.testing.assert_allclose(drawn.values[0, 0], [0, 1, 2, 3, 4, 4])


EVEN = np.linspace(-1, 1, 27)
UNEVEN = np.sign(EVEN) * np.abs(EVEN) ** 1.7
LINEAR = {"opacity": [[0.0, 0.0], [1.0, 0.4]], "unit_distance": 0.05}


def ball(z: np.ndarray, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """A ball of radius 0.6 about the middle, with a soft surface."""
    radius = np.sqrt(z[:, None, None] ** 2 + y[:, None] ** 2 + x**2)
    return np.asarray(1 / (1 + np.exp((radius - 0.6) / 0.08)))


def written(path: Path, values: np.ndarray, config: EncodeConfig, **coords: Any) -> Path:
    """A container of one step or more, with coordinates (values, attributes) or values."""
    axes = {"t": np.arange(len(values)), **coords}
    made = {}
    for axis, given in axes.items():
        at, attributes = given if isinstance(given, tuple) else (given, {})
        made[axis] = Coordinate(
            name=axis, values=np.asarray(at, dtype=np.float64), attributes=attributes
        )
    series = ArraySeries(values.astype(np.float32), name="q", units="K", coords=made)
    fhash_codec.encode(series, path, config)
    return path


def picture(path: Path, **scene: Any) -> np.ndarray:
    with fhash_codec.open(path) as volume:
        return Renderer(volume).render(Scene.from_dict({"size": [48, 48], **scene})).rgba


FINE = EncodeConfig(effort=1, psnr=70)


@pytest.mark.parametrize("descending", [False, True])
def test_a_ball_on_uneven_axes_is_the_ball_on_even_ones(tmp_path: Path, descending: bool) -> None:
    x = UNEVEN[::-1] if descending else UNEVEN
    uneven = written(tmp_path / "u.fhz", ball(UNEVEN, EVEN, x)[None], FINE, z=UNEVEN, y=EVEN, x=x)
    even = written(tmp_path / "e.fhz", ball(EVEN, EVEN, EVEN)[None], FINE, z=EVEN, y=EVEN, x=EVEN)
    wrong = written(tmp_path / "w.fhz", ball(UNEVEN, EVEN, x)[None], FINE, z=EVEN, y=EVEN, x=EVEN)
    for scene in (
        {"transfer_function": LINEAR},
        {"transfer_function": {"nothing": True}, "effects": {"isosurfaces": [{"value": 0.5}]}},
        {"transfer_function": LINEAR, "effects": {"shading": True}, "camera": {"zoom": 3.0}},
    ):
        found, expected, other = (picture(path, **scene) for path in (uneven, even, wrong))
        error = float(np.sqrt(np.mean((found - expected) ** 2)))
        assert error < 0.02
        assert error < 0.2 * float(np.sqrt(np.mean((other - expected) ** 2)))


def test_every_level_draws_uneven_axes_alike(tmp_path: Path) -> None:
    axis, even = UNEVEN[::2], EVEN[::2]
    values = ball(axis, even, even)[None]
    path = written(tmp_path / "u.fhz", values, FINE, z=axis, y=even, x=even)
    scene = {"size": [16, 16], "transfer_function": LINEAR}
    fine, coarse = (picture(path, **scene, march={"lod": lod}) for lod in (0, 1))
    assert np.abs(coarse - fine).mean() < 0.03


def test_a_network_is_sampled_where_uneven_axes_say(tmp_path: Path) -> None:
    axis, even = UNEVEN[::3], EVEN[::3]
    values = np.repeat(ball(even, even, axis)[None], 2, axis=0)
    config = EncodeConfig(
        preset="published", tables="float16", features=("interval:0.3:2",), epochs=8, width=8
    )
    path = written(tmp_path / "p.fhz", values, config, z=even, y=even, x=axis)
    scene = {"size": [12, 12], "transfer_function": LINEAR, "effects": {"shading": True}}
    cache, arm, stream = (
        picture(path, **scene, march={"mode": mode}) for mode in ("cache", "arm", "stream")
    )
    assert cache[..., 3].max() > 0.2
    np.testing.assert_allclose(arm, stream, atol=0.01)
    assert np.abs(arm - cache).mean() < 0.03


def test_depths_are_drawn_downwards(tmp_path: Path) -> None:
    depth = np.array([5.0, 10, 50, 200, 500, 1000, 2000, 3000, 4000, 5000])
    values = np.zeros((1, 10, 12, 12))
    values[:, 0] = 1
    shown = {"opacity": [[0.0, 0.0], [0.5, 0.0], [1.0, 1.0]]}
    units = {"units": "km"}
    rest = {"y": (np.arange(12.0), units), "x": (np.arange(12.0), units)}
    rows = {}
    for positive in ("down", "up"):
        z = depth / 500, {"units": "km", "positive": positive}
        path = written(tmp_path / f"{positive}.fhz", values, FINE, z=z, **rest)
        seen = picture(path, transfer_function=shown, camera={"view": "xz"})[..., 3]
        rows[positive] = np.average(np.arange(48), weights=seen.sum(axis=1))
    assert rows["down"] < 24 < rows["up"]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_plane_is_an_opaque_picture_of_its_values(tmp_path: Path, axis: int) -> None:
    across, up = np.meshgrid(np.linspace(0, 1, 24), np.linspace(0, 1, 18))
    plane = across * up
    plane[9:, 12:] = np.nan
    values = np.expand_dims(plane, axis)[None].repeat(2, axis=0)
    values[1] *= 0.5
    coords = {
        name: np.arange(n, dtype=float) for name, n in zip("zyx", values.shape[1:], strict=True)
    }
    path = written(tmp_path / "f.fhz", values, FINE, **coords)
    shown = {"size": [96, 72], "transfer_function": {"colours": "grey"}}
    cache = picture(path, **shown)
    assert cache[40:68, 4:90, 3].min() > 0.99
    # Right and up in the picture are right and up of the axes; there the values are missing.
    assert cache[4:30, 56:92, 3].max() == 0
    brightness = cache[60, 4:90, 0]
    assert np.all(np.diff(brightness[::8]) > 0)
    assert picture(path, **shown, step=1)[60, 80, 0] < 0.7 * brightness[76]


@pytest.mark.parametrize("shape", [(1, 1, 9), (1, 9, 1), (9, 1, 1), (1, 1, 1)])
def test_lines_and_points_are_seen(tmp_path: Path, shape: tuple[int, int, int]) -> None:
    values = np.linspace(1, 2, int(np.prod(shape))).reshape((1, *shape))
    coords = {name: np.arange(n, dtype=float) for name, n in zip("zyx", shape, strict=True)}
    seen = picture(written(tmp_path / "l.fhz", values, FINE, **coords))[..., 3]
    assert seen.max() > 0.99
    assert (seen > 0.99).sum() >= 45
