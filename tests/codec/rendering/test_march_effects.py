"""Marching: clips, projections and opacity by gradient, against numpy and closed forms."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from frame_field import by_stream

from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.march import march
from fhash_codec.rendering.march_task import Frame, Grading, Lighting, Marched, Surface, Table, Task
from fhash_codec.rendering.scenes import Camera
from fhash_codec.rendering.view import Body

FRONT = Camera(view="xy", projection="parallel", parallel_scale=4.0)
"""Looks along z from the last layer to the first; 8 x 8 pixels see the middles of 8 x 8 cells."""
SHADES = np.linspace(0, 1, 101)
WHITE = np.ones(3)


def task_of(shape: tuple[int, ...], *, fog: float = 0.0, **more: Any) -> Task:
    """A task whose colour is the value itself, 0..1."""
    grid = Grid(counts=tuple(shape[::-1]), origin=np.zeros(3), spacing=np.ones(3))
    settings: dict[str, Any] = {
        "step": 0.5,
        "threshold": 0.0,
        "camera": FRONT,
        "size": (8, 8),
        "extinctions": np.full(101, fog),
        "lighting": Lighting(ambient=1.0, diffuse=0.0, specular=0.0, specular_power=1.0, lamp=None),
        **more,
    }
    table = Table(
        low=0.0,
        high=1.0,
        colours=np.stack([SHADES] * 3, axis=-1).astype(np.float32),
        extinctions=settings.pop("extinctions"),
    )
    rays = Rays.of(settings.pop("camera"), grid, settings.pop("size"))
    return Task(rays=rays, table=table, **settings)


def marched(values: np.ndarray, task: Task) -> Marched:
    return march(Frame(values=values.astype(np.float32), first=(0, 0, 0)), task)


def rough(shape: tuple[int, ...] = (13, 9, 9)) -> np.ndarray:
    return np.random.default_rng(5).uniform(0.05, 0.95, shape).astype(np.float32)


def along_rays(values: np.ndarray) -> np.ndarray:
    """The samples (y, x, k) of the rays of FRONT: at z = last - (k + 0.5) / 2, in cells' middles.

    The first row of the picture is the last row of y.
    """
    cells = values[:, :-1] + values[:, 1:]
    cells = (cells[:, :, :-1] + cells[:, :, 1:]) / 4
    places = len(values) - 1 - (np.arange(2 * (len(values) - 1)) + 0.5) / 2
    low = places.astype(int)
    share = (places - low)[:, None, None]
    return np.moveaxis(cells[low] * (1 - share) + cells[low + 1] * share, 0, -1)[::-1]


def test_projections_are_those_of_numpy_along_an_axis(way: str) -> None:
    values = rough()
    samples = along_rays(values).astype(np.float64)
    left = np.exp(-0.3 * 0.5 * np.cumsum(samples, axis=-1))
    before = np.concatenate([np.ones((8, 8, 1)), left[..., :-1]], axis=-1)
    exact = {
        "maximum": samples.max(axis=-1),
        "minimum": samples.min(axis=-1),
        "average": samples.mean(axis=-1),
        "attenuated": (samples * before).max(axis=-1),
    }
    places = {
        "maximum": samples.argmax(axis=-1),
        "minimum": samples.argmin(axis=-1),
        "average": np.zeros((8, 8)),
        "attenuated": (samples * before).argmax(axis=-1),
    }
    for projection, expected in exact.items():
        task = task_of(values.shape, projection=projection, attenuation=0.3, depth=True)
        for skipping in (True, False):
            found = marched(values, replace(task, skipping=skipping))
            np.testing.assert_allclose(found.rgba[..., 0], expected, atol=2e-6)
            np.testing.assert_array_equal(found.rgba[..., 3], 1.0)
            assert found.depth is not None
            depth = found.depth - found.depth.min()
            np.testing.assert_allclose(
                depth, (places[projection] - places[projection].min()) / 2, atol=1e-4
            )


def test_the_mean_counts_the_last_step_by_its_length_and_leaves_out_what_is_missing(
    way: str,
) -> None:
    ramp = np.broadcast_to(np.linspace(0, 1, 13)[:, None, None], (13, 9, 9)).copy()
    task = task_of(ramp.shape, projection="average", step=5.0)
    # From z = 12 on: samples at 9.5, 4.5 and, clamped, 0, the last of them 2 of 5 long.
    expected = (9.5 + 4.5 + 0.4 * 0) / 2.4 / 12
    np.testing.assert_allclose(marched(ramp, task).rgba[..., 0], expected, atol=1e-6)
    ramp[:4] = np.nan
    task = task_of(ramp.shape, projection="average")
    for skipping in (True, False):
        found = marched(ramp, replace(task, skipping=skipping)).rgba
        np.testing.assert_allclose(found[..., 0], 8 / 12, atol=1e-6)
        np.testing.assert_array_equal(found[..., 3], 1)
    ramp[:] = np.nan
    for projection in ("minimum", "average", "attenuated"):
        empty = marched(ramp, replace(task, projection=projection, attenuation=0.1))
        assert not empty.rgba.any()


def test_an_attenuated_maximum_ends_where_no_later_value_can_be_larger(way: str) -> None:
    values = rough((60, 9, 9))
    task = task_of(values.shape, projection="attenuated")
    short, long = (marched(values, replace(task, attenuation=by)) for by in (2.0, 1e-6))
    assert short.counters["samples"] < 0.2 * long.counters["samples"]
    samples = along_rays(values).astype(np.float64)
    before = np.exp(-2.0 * 0.5 * (np.cumsum(samples, axis=-1) - samples))
    np.testing.assert_allclose(short.rgba[..., 0], (samples * before).max(axis=-1), atol=2e-6)


def test_surfaces_are_drawn_over_a_projection(way: str) -> None:
    ramp = np.broadcast_to(np.linspace(0, 1, 13)[:, None, None], (13, 9, 9))
    surface = Surface(value=0.4, colour=np.array([0.0, 1, 0]), opacity=0.25)
    for projection, value in (("minimum", 0.25 / 12), ("average", 0.5)):
        task = task_of(ramp.shape, projection=projection, surfaces=(surface,))
        expected = [0.75 * value, 0.25 + 0.75 * value, 0.75 * value, 1]
        np.testing.assert_allclose(marched(ramp, task).rgba[4, 4], expected, atol=1e-5)


@pytest.mark.parametrize("step", [0.31, 0.5, 50.0])
def test_a_slab_between_planes_is_as_opaque_as_its_length(way: str, step: float) -> None:
    shape, fog = (21, 9, 9), 0.2
    values = np.full(shape, 0.5)
    cos, sin = np.cos(0.3), np.sin(0.3)
    middle = cos * 10 + sin * 4
    body = Body(
        bounds=np.array([[0.0, 8], [0, 8], [1.25, 18.5]]),
        planes=np.array([[sin, 0, cos, middle - 2], [-sin, 0, -cos, -middle - 3]]),
    )
    found = marched(values, task_of(shape, fog=fog, step=step, body=body)).rgba[4, 4, 3]
    assert found == pytest.approx(-np.expm1(-fog * 5 / cos), rel=1e-5)
    box = replace(body, planes=np.empty((0, 4)))
    found = marched(values, task_of(shape, fog=fog, step=step, body=box)).rgba[4, 4, 3]
    assert found == pytest.approx(-np.expm1(-fog * 17.25), rel=1e-5)


def test_nothing_is_seen_where_a_plane_cuts_all_of_a_ray(way: str) -> None:
    values = np.full((9, 9, 9), 0.5)
    half = Body(
        bounds=np.array([[0.0, 8]] * 3), planes=np.array([[1.0, 0, 0, 4.0], [0, 1.0, 0, 2.0]])
    )
    seen = marched(values, task_of(values.shape, fog=1.0, body=half))
    np.testing.assert_array_equal(
        seen.rgba[..., 3] > 0, np.outer(np.arange(8) < 6, np.arange(8) > 3)
    )
    assert seen.counters["rays"] == 24


@pytest.mark.parametrize("shaded", [False, True])
def test_a_clip_box_has_the_picture_of_its_region(way: str, shaded: bool) -> None:
    z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (20, 17, 24)), indexing="ij")
    values = (0.5 + 0.25 * np.sin(7 * x + 3 * y) + 0.25 * np.cos(5 * y - 6 * z)).astype(np.float32)
    lamp = Lighting(ambient=0.2, diffuse=0.8, specular=0.2, specular_power=9.0, lamp=None)
    surface = Surface(value=0.6, colour=WHITE, opacity=0.5)
    camera = Camera(position=(40.0, -30.0, 35.0), focal_point=(11.0, 8.0, 10.0))
    more = {
        "camera": camera,
        "size": (40, 36),
        "extinctions": np.linspace(0, 0.3, 101),
        "lighting": lamp,
        "shaded": shaded,
        "surfaces": (surface,),
        "depth": True,
    }
    body = Body(bounds=np.array([[4.0, 19], [3, 12], [5, 16]]), planes=np.empty((0, 4)))
    clipped = task_of(values.shape, body=body, **more)
    region = values[5:17, 3:13, 4:20]
    grid = Grid(counts=(16, 10, 12), origin=np.array([4.0, 3, 5]), spacing=np.ones(3))
    alone = replace(
        task_of(region.shape, **more), rays=Rays.of(camera, grid, (40, 36)), step=clipped.step
    )
    expected = marched(region, alone)
    assert expected.rgba[..., 3].max() > 0.5
    part = march(Frame(values=region, first=(5, 3, 4)), clipped)
    for found in (marched(values, clipped), part):
        np.testing.assert_allclose(found.rgba, expected.rgba, atol=2e-4)
        np.testing.assert_allclose(found.depth, expected.depth, atol=1e-3)
        # On faces and edges rounding decides on a sample or two of a ray.
        assert found.counters["rays"] == pytest.approx(expected.counters["rays"], rel=0.01)
    everything = marched(values, task_of(values.shape, **more))
    assert part.counters["samples"] < 0.5 * everything.counters["samples"]


@pytest.mark.parametrize("shaded", [False, True])
@pytest.mark.parametrize("step", [0.4, 7.0])
def test_a_ramp_is_as_opaque_as_the_factor_of_its_gradient_says(
    way: str, shaded: bool, step: float
) -> None:
    grading = Grading(factors=np.interp(np.linspace(0, 0.2, 1025), [0.05, 0.15], [0, 1]), top=0.2)
    for slope, factor in ((0.02, 0.0), (0.1, 0.5), (0.15, 1.0), (0.18, 1.0)):
        z, y, x = np.meshgrid(*(np.arange(9.0),) * 3, indexing="ij")
        values = 0.1 + slope * (0.6 * x + 0.8 * y) * 0.5 + 0 * z
        task = task_of(
            values.shape, fog=0.2, step=step, grading=grading, shaded=shaded, threshold=0.0
        )
        found = marched(2 * values, task)
        expected = -np.expm1(-0.2 * 8 * factor)
        np.testing.assert_allclose(found.rgba[..., 3], expected, rtol=2e-3, atol=1e-6)
        assert found.counters["gradients"] > 0
    assert marched(values, replace(task, grading=None, shaded=False)).counters["gradients"] == 0


def bounded(noise: float) -> tuple[np.ndarray, np.ndarray]:
    """A ball with an even inside (z, y, x), 0..1, and the same with errors up to half the noise."""
    axis = np.linspace(-1, 1, 40)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    ball = 1 / (1 + np.exp((np.sqrt(x * x + y * y + z * z) - 0.6) / 0.08))
    errors = np.random.default_rng(7).uniform(-noise / 2, noise / 2, ball.shape)
    return ball, np.clip(ball + errors, 0, 1)


@pytest.mark.parametrize("surface", [False, True])
def test_a_bounded_file_is_as_bright_as_its_source_and_without_grain(
    way: str, surface: bool
) -> None:
    source, coded = bounded(noise=0.1)
    lighting = Lighting(ambient=0.2, diffuse=0.8, specular=0.0, specular_power=8.0, lamp=None)
    task = task_of(
        source.shape,
        camera=Camera(),
        size=(40, 40),
        extinctions=np.clip(SHADES - 0.5, 0, None) * (not surface),
        lighting=lighting,
        shaded=not surface,
        surfaces=(Surface(value=0.5, colour=WHITE, opacity=1.0),) * surface,
    )
    exact = marched(source, task).rgba[..., 0]
    grained = marched(coded, task).rgba[..., 0]
    drawn = marched(coded, replace(task, noise=0.1)).rgba[..., 0]
    assert drawn.mean() == pytest.approx(exact.mean(), rel=0.04)
    inner = exact > 0.5 * exact.max()
    assert np.abs(drawn - exact)[inner].mean() < 0.5 * np.abs(grained - exact)[inner].mean()


@pytest.mark.parametrize("central", [False, True])
@pytest.mark.parametrize("lit", ["volume", "surface"])
def test_both_marchers_shade_bounded_files_alike(
    central: bool, lit: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, coded = bounded(noise=0.05)
    coded[8:11, 20:24, 17:19] = np.nan
    task = task_of(
        coded.shape,
        camera=Camera(azimuth=20, elevation=30),
        size=(24, 24),
        fog=0.1,
        lighting=Lighting(
            ambient=0.2, diffuse=0.7, specular=0.2, specular_power=8.0, lamp=None, central=central
        ),
        shaded=lit != "surface",
        surfaces=(Surface(value=0.4, colour=WHITE, opacity=0.7),) * (lit == "surface"),
        noise=0.05,
    )
    fast = marched(coded, task)
    monkeypatch.setattr("fhash_codec.rendering.march.march_native", by_stream)
    np.testing.assert_allclose(fast.rgba, marched(coded, task).rgba, atol=2e-3)
