"""Streaming and adaptive ray marching: one picture with the packets, and no more work than the plan asks for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fhash_codec
from fhash_codec import Renderer, Scene
from fhash_codec.render.beams import Beams
from fhash_codec.render.bricks import Bricks
from fhash_codec.render.camera import Grid, Rays
from fhash_codec.render.crossings import crossings
from fhash_codec.render.fields import FrameField
from fhash_codec.render.image import Image
from fhash_codec.render.scene import Camera
from fhash_codec.render.stream import stream
from fhash_codec.render.task import Frame, Surface, Table, Task
from fhash_formats import native
from fhash_formats.series import Coordinate

SCENES: dict[str, dict[str, Any]] = {
    "plain": {},
    "shaded": {"effects": {"shading": {"light": [1, 2, 3]}}},
    "surfaces": {"effects": {"isosurfaces": [{"value": 3, "opacity": 0.4}, {"value": 6}], "buffers": ["depth", "normal"]}},
    "surfaces alone": {"transfer_function": {"nothing": True}, "effects": {"isosurfaces": [{"value": 5}]}},
    "maximum": {"effects": {"maximum_intensity": True, "buffers": ["depth"]}},
    "maximum and surface": {"effects": {"maximum_intensity": True, "isosurfaces": [{"value": 5, "opacity": 0.5}]}},
    "jitter": {"effects": {"jitter": True, "antialiasing": 2}},
    "narrow": {"transfer_function": {"opacity": [[4, 0], [4.5, 0.9], [5, 0]]}, "effects": {"buffers": ["depth", "normal"]}},
    "opaque": {"transfer_function": {"opacity": [[2, 0], [4, 1]]}},
    "inside": {"camera": {"position": [9, 10, 9], "focal_point": [20, 14, 12]}},
    "shadows": {"effects": {"shadows": True}},
    "all light": {"effects": {"shadows": True, "ambient_occlusion": True, "shading": True, "isosurfaces": [{"value": 5, "opacity": 0.5}]}},
    "parallel": {"camera": {"view": "xy", "projection": "parallel"}, "effects": {"shading": True}},
    "between": {"step": 0.5},
    "coarse": {"march": {"lod": 1}},
    "zoomed": {"camera": {"zoom": 8}},
    "unskipped": {"march": {"skipping": False}},
    "long steps": {"march": {"step": 20}, "effects": {"isosurfaces": [{"value": 5}]}},
}


def picture(renderer: Renderer, mode: str, scene: dict[str, Any], size: tuple[int, int] = (48, 40)) -> Image:
    return renderer.render(Scene.from_dict({**scene, "size": size, "march": {**scene.get("march", {}), "mode": mode}}))


@pytest.mark.skipif(native.library() is None, reason="compares with the native packets")
@pytest.mark.parametrize("name", SCENES)
def test_three_ways_make_one_picture(renderer: Renderer, name: str) -> None:
    cache, streamed, adaptive = (picture(renderer, mode, SCENES[name]) for mode in ("cache", "stream", "arm"))
    assert cache.rgba[..., 3].max() > 0.05
    np.testing.assert_array_equal(streamed.rgba, adaptive.rgba)
    np.testing.assert_allclose(streamed.rgba, cache.rgba, atol=1e-3)
    if cache.depth is not None and streamed.depth is not None:
        np.testing.assert_allclose(streamed.depth, cache.depth, atol=1e-3)
    if cache.normal is not None and streamed.normal is not None:
        np.testing.assert_allclose(streamed.normal, cache.normal, atol=1e-3)


def test_adaptive_marching_takes_at_most_half_the_passes(renderer: Renderer) -> None:
    streamed, adaptive, large = (
        picture(renderer, mode, {"march": march}) for mode, march in (("stream", {}), ("arm", {}), ("arm", {"samples_per_pass": 10**6}))
    )
    assert adaptive.counters["passes"] <= streamed.counters["passes"] / 2
    assert large.counters["passes"] < adaptive.counters["passes"]
    np.testing.assert_array_equal(large.rgba, streamed.rgba)


def test_a_small_budget_is_plain_streaming(renderer: Renderer) -> None:
    streamed, adaptive = (picture(renderer, mode, {"march": {"samples_per_pass": 1}}) for mode in ("stream", "arm"))
    assert streamed.counters == adaptive.counters


@pytest.mark.parametrize("mode", ["stream", "arm"])
def test_counters_prove_that_nothing_else_is_done(renderer: Renderer, mode: str) -> None:
    plain = picture(renderer, mode, {}).counters
    assert plain["gradients"] == plain["secondary_rays"] == 0
    assert plain["evaluations"] == plain["samples"] > 0
    shaded = picture(renderer, mode, {"effects": {"shading": True}}).counters
    assert 0 < shaded["gradients"] <= shaded["samples"]
    assert {**shaded, "gradients": 0} == plain
    around = picture(renderer, mode, {"effects": {"box": True, "axes": True, "colour_bar": True, "time_label": True}}).counters
    assert around == plain
    depth = picture(renderer, mode, {"effects": {"buffers": ["depth"]}}).counters
    assert depth == plain


def test_bricks_that_cannot_be_seen_cost_nothing(renderer: Renderer) -> None:
    narrow: dict[str, Any] = {"transfer_function": {"opacity": [[6, 0], [7, 0.5], [8, 0]]}}
    skipping, marching = (picture(renderer, "arm", {**narrow, "march": {"skipping": on}}) for on in (True, False))
    np.testing.assert_array_equal(skipping.rgba, marching.rgba)
    assert skipping.counters["skipped_bricks"] > 0
    assert marching.counters["skipped_bricks"] == 0
    assert skipping.counters["samples"] < marching.counters["samples"] / 3


def test_only_samples_in_visible_cells_are_evaluated(renderer: Renderer) -> None:
    narrow = {"transfer_function": {"opacity": [[4, 0], [4.2, 0.1], [4.4, 0]]}}
    found, everything = (picture(renderer, "arm", {**narrow, "march": {"skipping": on, "threshold": 0.0}}) for on in (True, False))
    np.testing.assert_array_equal(found.rgba, everything.rgba)
    frame = renderer.volume.read(0)
    corners = [frame[tuple(slice(up, n - 1 + up) for up, n in zip(corner, frame.shape, strict=True))] for corner in np.ndindex(2, 2, 2)]
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
    ending, going = (picture(renderer, "stream", {**opaque, "march": {"threshold": threshold}}) for threshold in (1 / 1024, 0.0))
    assert ending.counters["samples"] < going.counters["samples"] / 4
    np.testing.assert_allclose(ending.rgba, going.rgba, atol=1 / 1024)


@pytest.mark.parametrize("step", [0.0, 0.7])
def test_a_network_is_evaluated_at_every_sample(files: dict[str, Path], step: float) -> None:
    with fhash_codec.open(files["paper"]) as network:
        renderer = Renderer(network)
        scene: dict[str, Any] = {"step": step, "effects": {"shading": True, "isosurfaces": [{"value": 5, "opacity": 0.5}]}}
        cache, streamed, adaptive = (picture(renderer, mode, scene) for mode in ("cache", "stream", "arm"))
        np.testing.assert_array_equal(streamed.rgba, adaptive.rgba)
        assert cache.counters["evaluations"] == 0
        assert 0 < streamed.counters["evaluations"] <= streamed.counters["samples"]
        # Between vertices the network has values of its own: what is left is no more than that.
        assert np.mean(np.abs(streamed.rgba - cache.rgba)) < 0.02
        assert np.isfinite(streamed.rgba).all()
        place = {"z": np.array([9.3, 12.0]), "y": np.array([10.1, 14.0]), "x": np.array([8.7, 19.0])}
        values, slopes = network.sample(t=step, gradient=True, **place)
        from fhash_codec.render.fields import NetworkField
        from fhash_codec.render.plan import Units

        field = NetworkField(network, step, Units())
        places = np.stack([place["x"], place["y"], place["z"]], axis=-1)
        np.testing.assert_allclose(field.values(places), values, rtol=1e-5)
        np.testing.assert_allclose(field.slopes(places), slopes[:, :0:-1], rtol=1e-4, atol=1e-5)


def frame_task(values: np.ndarray, *, step: float = 0.5, surfaces: tuple[Surface, ...] = (), fog: float = 0.0) -> tuple[FrameField, Task]:
    axes = {
        axis: Coordinate(name=axis, values=np.arange(n, dtype=float), attributes={}) for axis, n in zip("zyx", values.shape, strict=True)
    }
    grid = Grid.of(axes)
    frame = Frame(values=values.astype(np.float32), first=(0, 0, 0))
    rays = Rays.of(Camera(view="xy", projection="parallel", parallel_scale=2.0), grid, (8, 8))
    table = Table(low=0.0, high=1.0, colours=np.ones((2, 3), dtype=np.float32), extinctions=np.full(2, fog)) if fog else None
    return FrameField(frame, grid, Bricks.of(frame)), Task(rays=rays, step=step, threshold=0.0, table=table, surfaces=surfaces)


@pytest.mark.parametrize("fog", [1e-9, 1e-3, 0.3])
@pytest.mark.parametrize("step", [0.02, 0.37, 5.0])
def test_a_slab_of_fog_is_as_opaque_as_its_length(fog: float, step: float) -> None:
    field, task = frame_task(np.full((9, 7, 7), 0.5), step=step, fog=fog)
    rgba = stream(field, task, adaptive=True).rgba
    np.testing.assert_allclose(rgba, -np.expm1(-fog * 8), rtol=1e-6)


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
        (Surface(value=0.0, colour=np.ones(3), opacity=0.5), Surface(value=-1.0, colour=np.ones(3), opacity=0.25)),
    )
    assert found.opacity[0].tolist() == [[0, 0], [0.25, 0], [0.5, 0], [0, 0], [0, 0]]
    np.testing.assert_allclose(found.at[0, 1:3, 0], [1.3, 2.3], atol=1e-4)
    assert found.which[0, 1:3, 0].tolist() == [1, 0]
