"""Marching: against closed forms, and both marchers against each other."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from frame_field import by_stream, frame_of, table_of, waves
from frame_field import task_of as plain_task

from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.march import march
from fhash_codec.rendering.march_task import Frame, Grading, Lighting, Marched, Surface, Table, Task
from fhash_codec.rendering.scenes import Camera
from fhash_codec.rendering.view import Body
from fhash_formats.errors import InputError

Shape = tuple[int, ...]

LIGHTING = Lighting(ambient=0.2, diffuse=0.8, specular=0.3, specular_power=16.0, lamp=None)
FRONT = Camera(view="xy", projection="parallel")
WHITE = np.ones(3)


def task_of(shape: Shape, table: Table | None, **more: Any) -> Task:
    return plain_task(shape, table, **{"lighting": LIGHTING, **more})


def sphere(count: int = 33) -> np.ndarray:
    axis = np.linspace(-1, 1, count)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    return np.sqrt(x * x + y * y + z * z).astype(np.float32)


@pytest.mark.parametrize("extinction", [1e-9, 1e-3, 0.3, 5.0, 64.0])
@pytest.mark.parametrize("step", [0.02, 0.3, 0.5, 7.0, 100.0])
def test_a_constant_slab_has_its_closed_form_at_every_step(
    way: str, extinction: float, step: float
) -> None:
    table = table_of([extinction, extinction], colour=(0.8, 0.4, 0.2))
    shape = (21, 8, 8)
    rgba = march(frame_of(np.full(shape, 0.3)), task_of(shape, table, step=step, size=(4, 4))).rgba[
        2, 2
    ]
    exact = -np.expm1(-extinction * 20)
    np.testing.assert_allclose(
        rgba, exact * np.array([0.8, 0.4, 0.2, 1.0]), rtol=1e-3 if exact < 1e-6 else 1e-5
    )


def test_a_linear_ramp_in_front_of_colours_has_its_integral(way: str) -> None:
    ramp = np.broadcast_to(np.linspace(1, 0, 17, dtype=np.float32)[:, None, None], (17, 6, 6))
    n = 257
    table = Table(
        low=0.0,
        high=1.0,
        colours=np.linspace([0, 0, 0], [1, 0, 0], n, dtype=np.float32),
        extinctions=np.linspace(0, 0.4, n),
    )
    red, _, _, opacity = march(
        frame_of(ramp), task_of(ramp.shape, table, step=0.05, size=(1, 1))
    ).rgba[0, 0]
    s = (np.arange(200_000) + 0.5) / 200_000
    left = np.exp(-6.4 * s**2 / 2)  # the ray begins at the last layer, of value 0
    assert opacity == pytest.approx(1 - np.exp(-3.2), rel=1e-4)
    assert red == pytest.approx(np.mean(left * 6.4 * s * s), rel=1e-3)


@pytest.mark.parametrize("position", [(16.0, 16.0, 90.0), (30.0, -40.0, 50.0)])
def test_the_surface_of_a_sphere_lies_where_it_is(
    way: str, position: tuple[float, float, float]
) -> None:
    values = sphere()
    surface = Surface(value=0.5, colour=np.array([1.0, 0.5, 0.25]), opacity=1.0)
    camera = Camera(position=position, view_up=(0, 1, 0))
    task = task_of(
        values.shape,
        None,
        camera=camera,
        size=(33, 33),
        surfaces=(surface,),
        depth=True,
        normal=True,
    )
    marched = march(frame_of(values), task)
    assert marched.depth is not None
    assert marched.normal is not None
    eye, direction = task.rays.pixels()
    direction = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    away = eye - 16.0
    half = (away * direction).sum(-1)
    inside = half**2 - (away**2).sum(-1) + 64.0
    clear, hit = inside < -8, inside > 8
    assert hit.sum() > 50
    assert np.all(np.isinf(marched.depth[clear]))
    assert np.all(marched.rgba[clear] == 0)
    np.testing.assert_allclose(
        marched.depth[hit], (-half - np.sqrt(np.maximum(inside, 0)))[hit], atol=0.08
    )  # the values are linear between vertices, unlike those of the sphere
    exact = away[hit] + marched.depth[hit][:, None] * direction[hit]
    np.testing.assert_allclose(marched.normal[hit], exact / 8, atol=0.12)
    assert np.all(marched.rgba[hit][:, 3] == 1)


def test_roots_of_a_plane_are_exact(way: str) -> None:
    x = np.broadcast_to(np.linspace(0, 1, 11, dtype=np.float32)[:, None, None] ** 2, (11, 5, 5))
    surfaces = tuple(
        Surface(value=value, colour=WHITE, opacity=0.6) for value in (0.005, 0.333, 0.995)
    )
    task = task_of(x.shape, None, surfaces=surfaces, depth=True, size=(4, 4), step=0.7)
    marched = march(frame_of(x), task)
    assert marched.depth is not None
    assert marched.rgba[2, 2, 3] == pytest.approx(1 - 0.4**3, rel=1e-5)
    eye, _ = task.rays.pixels()
    # The surface nearest to the eye takes 0.6 of the light: the value 0.995 lies in the first tenth
    # of a cell, before the first sample.
    place = 9 + (0.995 - 0.81) / 0.19
    assert marched.depth[2, 2] == pytest.approx(eye[2, 2, 2] - place, abs=1e-4)


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (0.3, 0.7, 0.9)])
def test_a_surface_of_the_value_of_a_face_is_that_face(
    way: str, spacing: tuple[float, float, float]
) -> None:
    """All rays that meet the face from outside see it, however rounding moves where they enter.

    The slope of the values may have either sign.
    """
    shape = (9, 8, 7)
    for low, high in ((2.0, 6.0), (6.0, 2.0)):
        ramp = np.broadcast_to(np.linspace(low, high, 9, dtype=np.float32)[:, None, None], shape)
        camera = Camera(azimuth=7, elevation=50)
        task = task_of(
            shape,
            None,
            camera=camera,
            size=(64, 64),
            spacing=spacing,
            surfaces=(Surface(value=6.0, colour=WHITE, opacity=1.0),),
        )
        seen = march(frame_of(ramp), replace(task, depth=True))
        origin, direction = (ends.reshape(-1, 3) for ends in task.rays.pixels())
        face = 8.0 if high == 6.0 else 0.0
        with np.errstate(divide="ignore"):
            place = origin + ((face - origin[:, 2]) / direction[:, 2])[:, None] * direction
        inside = np.all(
            (place[:, :2] > 0.01) & (place[:, :2] < np.array([5.99, 6.99])), axis=1
        ).reshape(64, 64)
        outside = np.any(
            (place[:, :2] < -0.01) | (place[:, :2] > np.array([6.01, 7.01])), axis=1
        ).reshape(64, 64)
        assert inside.sum() > 200
        assert seen.rgba[inside, 3].min() == 1
        assert seen.rgba[outside, 3].max() == 0


def test_surfaces_are_drawn_in_the_order_in_which_a_ray_meets_them(way: str) -> None:
    ramp = np.broadcast_to(np.linspace(0, 1, 11, dtype=np.float32)[:, None, None], (11, 5, 5))
    red, blue = (
        Surface(value=v, colour=np.array(c), opacity=0.5)
        for v, c in ((0.81, (1.0, 0, 0)), (0.83, (0, 0, 1.0)))
    )
    lighting = Lighting(ambient=1.0, diffuse=0.0, specular=0.0, specular_power=1.0, lamp=None)
    task = replace(task_of(ramp.shape, None, surfaces=(red, blue), size=(4, 4)), lighting=lighting)
    np.testing.assert_allclose(
        march(frame_of(ramp), task).rgba[2, 2], [0.25, 0, 0.5, 0.75], atol=1e-5
    )


def test_an_empty_scene_is_empty_and_an_opaque_one_is_opaque(way: str) -> None:
    values = waves()
    assert not march(frame_of(values), task_of(values.shape, table_of([0.0, 0.0]))).rgba.any()
    assert not march(frame_of(values), task_of(values.shape, None)).rgba.any()
    opaque = march(frame_of(values), task_of(values.shape, table_of([64.0, 64.0]), step=1.0)).rgba
    assert np.allclose(opaque[4, 4], 1)


def test_a_camera_may_be_inside_and_rays_may_run_along_faces(way: str) -> None:
    values = np.full((9, 9, 9), 0.5)
    table = table_of([0.1, 0.1])
    camera = Camera(position=(4.0, 4.0, 4.0), focal_point=(4.0, 4.0, -10.0), view_up=(0, 1, 0))
    middle = march(frame_of(values), task_of(values.shape, table, camera=camera, size=(1, 1))).rgba[
        0, 0, 3
    ]
    assert middle == pytest.approx(-np.expm1(-0.4), rel=1e-5)
    task = task_of(values.shape, table, size=(2, 1))
    along = replace(
        task,
        rays=replace(task.rays, eye=np.array([8.0, 0.0, 20.0]), right=np.zeros(3), up=np.zeros(3)),
    )
    assert march(frame_of(values), along).rgba[0, 0, 3] == pytest.approx(-np.expm1(-0.8), rel=1e-5)
    beside = replace(along, rays=replace(along.rays, eye=np.array([8.0 + 1e-9, 0.0, 20.0])))
    assert march(frame_of(values), beside).rgba[0, 0, 3] == 0


def test_what_has_no_value_never_reaches_a_pixel(way: str) -> None:
    values = waves()
    values[5:9, 4:8, 3:20] = np.nan
    values[12, 3, 3], values[13, 5, 5] = np.inf, -np.inf
    table = table_of([0.05, 0.2])
    surface = Surface(value=0.6, colour=WHITE, opacity=0.5)
    for camera in (FRONT, Camera()):
        task = task_of(
            values.shape,
            table,
            camera=camera,
            size=(40, 40),
            shaded=True,
            surfaces=(surface,),
            depth=True,
            normal=True,
        )
        marched = march(frame_of(values), task)
        assert np.all(np.isfinite(marched.rgba))
        assert marched.normal is not None
        assert np.all(np.isfinite(marched.normal))
    assert not march(frame_of(np.full((5, 5, 5), np.nan)), task_of((5, 5, 5), table)).rgba.any()


CASES = {
    "fog": {},
    "shaded": {"shaded": True},
    "buffers": {"shaded": True, "depth": True, "normal": True},
    "antialiased": {"antialiasing": 2, "jitter": True},
    "jitter": {"jitter": True, "step": 1.7},
    "surfaces": {
        "surfaces": (
            Surface(value=0.62, colour=np.array([1, 0, 0.0]), opacity=0.4),
            Surface(value=0.3, colour=WHITE, opacity=0.7),
        ),
        "shaded": True,
    },
    "maximum": {"projection": "maximum"},
    "maximum and surface": {
        "projection": "maximum",
        "surfaces": (Surface(value=0.8, colour=WHITE, opacity=0.5),),
    },
    "minimum": {"projection": "minimum", "depth": True},
    "average": {"projection": "average", "depth": True},
    "attenuated": {"projection": "attenuated", "attenuation": 0.3, "depth": True},
    "all": {"skipping": False, "shaded": True},
}


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (0.5, -2.0, 1.5), (1e-9, 1e-9, 2e-9)])
@pytest.mark.parametrize("case", CASES)
def test_both_ways_make_one_picture(case: str, spacing: tuple[float, float, float]) -> None:
    values = waves()
    unit = float(np.exp(np.mean(np.log(np.abs(spacing)))))
    table = table_of(
        np.concatenate([np.zeros(30), np.linspace(0, 0.4, 71)]) / unit, colour=(0.9, 0.5, 0.3)
    )
    more = {"step": 0.5, **CASES[case]}
    more["step"] *= unit
    task = task_of(
        values.shape, table, camera=Camera(azimuth=20.0), size=(45, 35), spacing=spacing, **more
    )
    here = march(frame_of(values), task)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fhash_codec.rendering.march.march_native", by_stream)
        there = march(frame_of(values), task)
    assert here.rgba[..., 3].max() > 0.2
    np.testing.assert_allclose(here.rgba, there.rgba, atol=2e-4)
    if task.depth:
        both = np.isfinite(here.depth) & np.isfinite(there.depth)
        assert np.mean(np.isfinite(here.depth) == np.isfinite(there.depth)) > 0.99
        assert np.mean(np.abs(here.depth[both] - there.depth[both]) < 1e-3 * unit) > 0.99


def test_values_of_any_magnitude_make_the_same_picture(way: str) -> None:
    values = waves()
    table = table_of(np.linspace(0, 0.3, 100))
    task = task_of(
        values.shape,
        table,
        size=(20, 20),
        shaded=True,
        surfaces=(Surface(value=0.5, colour=WHITE, opacity=0.5),),
    )
    plain = march(frame_of(values), task).rgba
    for unit in (1e-33, 1e12, 2e38):
        scaled = replace(table, high=unit)
        surface = Surface(value=0.5 * unit, colour=WHITE, opacity=0.5)
        scaled_up = march(
            frame_of(values * np.float32(unit)), replace(task, table=scaled, surfaces=(surface,))
        ).rgba
        np.testing.assert_allclose(scaled_up, plain, atol=5e-3)


def test_skipping_and_the_end_of_rays_change_no_picture(way: str) -> None:
    values = waves((40, 33, 50))
    table = table_of(np.where(np.arange(200) > 170, 0.5, 0.0))
    surface = Surface(value=0.9, colour=WHITE, opacity=0.5)
    for surfaces in ((), (surface,)):
        task = task_of(values.shape, table, camera=Camera(), size=(40, 40), surfaces=surfaces)
        with_, without = (
            march(frame_of(values), task),
            march(frame_of(values), replace(task, skipping=False)),
        )
        np.testing.assert_allclose(with_.rgba, without.rgba, atol=1e-5)
        ended = march(frame_of(values), replace(task, threshold=1 / 1024))
        np.testing.assert_allclose(ended.rgba, without.rgba, atol=2 / 1024)
        if not surfaces:
            assert with_.counters["samples"] < without.counters["samples"]


def test_a_part_of_the_domain_is_sampled_where_the_whole_is(way: str) -> None:
    values = waves((24, 24, 24))
    values[:, :, :8], values[:, :9, :], values[20:] = 0, 0, 0
    table = table_of(np.concatenate([np.zeros(1), np.linspace(0, 0.3, 99)]))
    task = task_of(values.shape, table, camera=Camera(), size=(30, 30), shaded=True)
    inner = Frame(values=values[:21, 8:, 7:], first=(0, 8, 7))
    full = march(frame_of(values), task)
    np.testing.assert_allclose(march(inner, task).rgba, full.rgba, atol=1e-4)


def test_a_coarse_frame_covers_the_same_box(way: str) -> None:
    z, y, x = np.meshgrid(*(np.arange(22.0),) * 3, indexing="ij")
    values = ((x + y + z) / 66).astype(np.float32)
    table = table_of(np.linspace(0, 0.2, 100))
    fine = march(
        frame_of(values), task_of(values.shape, table, size=(24, 24), camera=Camera(), shaded=True)
    )
    coarse = Frame(values=values[::2, ::2, ::2], first=(0, 0, 0), stride=2)
    covered = march(
        coarse, task_of(values.shape, table, size=(24, 24), camera=Camera(), shaded=True)
    )
    assert np.array_equal(fine.rgba[..., 3] > 0, covered.rgba[..., 3] > 0)
    np.testing.assert_allclose(covered.rgba, fine.rgba, atol=0.03)


def test_threads_make_the_same_picture() -> None:
    values = waves()
    task = task_of(values.shape, table_of([0.1, 0.3]), size=(100, 70), shaded=True, camera=Camera())
    by_one, by_four = (march(frame_of(values), task, threads=threads) for threads in (1, 4))
    np.testing.assert_array_equal(by_one.rgba, by_four.rgba)
    assert by_one.counters == by_four.counters


def test_too_many_surfaces_are_refused() -> None:
    surfaces = tuple(Surface(value=float(n), colour=WHITE, opacity=0.5) for n in range(65))
    with pytest.raises(InputError, match="64"):
        march(frame_of(np.zeros((3, 3, 3))), task_of((3, 3, 3), None, surfaces=surfaces))


CLOSE = Camera(view="xy", projection="parallel", parallel_scale=4.0)
"""Looks along z from the last layer to the first; 8 x 8 pixels see the middles of 8 x 8 cells."""
SHADES = np.linspace(0, 1, 101)


def grey_task(shape: tuple[int, ...], *, fog: float = 0.0, **more: Any) -> Task:
    """A task whose colour is the value itself, 0..1."""
    extinctions = more.pop("extinctions", np.full(101, fog))
    colours = np.stack([SHADES] * 3, axis=-1).astype(np.float32)
    table = replace(table_of(extinctions), colours=colours)
    ambient = Lighting(ambient=1.0, diffuse=0.0, specular=0.0, specular_power=1.0, lamp=None)
    return plain_task(shape, table, **{"camera": CLOSE, "lighting": ambient, **more})


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
        task = grey_task(values.shape, projection=projection, attenuation=0.3, depth=True)
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
    task = grey_task(ramp.shape, projection="average", step=5.0)
    # From z = 12 on: samples at 9.5, 4.5 and, clamped, 0, the last of them 2 of 5 long.
    expected = (9.5 + 4.5 + 0.4 * 0) / 2.4 / 12
    np.testing.assert_allclose(marched(ramp, task).rgba[..., 0], expected, atol=1e-6)
    ramp[:4] = np.nan
    task = grey_task(ramp.shape, projection="average")
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
    task = grey_task(values.shape, projection="attenuated")
    short, long = (marched(values, replace(task, attenuation=by)) for by in (2.0, 1e-6))
    assert short.counters["samples"] < 0.2 * long.counters["samples"]
    samples = along_rays(values).astype(np.float64)
    before = np.exp(-2.0 * 0.5 * (np.cumsum(samples, axis=-1) - samples))
    np.testing.assert_allclose(short.rgba[..., 0], (samples * before).max(axis=-1), atol=2e-6)


def test_surfaces_are_drawn_over_a_projection(way: str) -> None:
    ramp = np.broadcast_to(np.linspace(0, 1, 13)[:, None, None], (13, 9, 9))
    surface = Surface(value=0.4, colour=np.array([0.0, 1, 0]), opacity=0.25)
    for projection, value in (("minimum", 0.25 / 12), ("average", 0.5)):
        task = grey_task(ramp.shape, projection=projection, surfaces=(surface,))
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
    found = marched(values, grey_task(shape, fog=fog, step=step, body=body)).rgba[4, 4, 3]
    assert found == pytest.approx(-np.expm1(-fog * 5 / cos), rel=1e-5)
    box = replace(body, planes=np.empty((0, 4)))
    found = marched(values, grey_task(shape, fog=fog, step=step, body=box)).rgba[4, 4, 3]
    assert found == pytest.approx(-np.expm1(-fog * 17.25), rel=1e-5)


def test_nothing_is_seen_where_a_plane_cuts_all_of_a_ray(way: str) -> None:
    values = np.full((9, 9, 9), 0.5)
    half = Body(
        bounds=np.array([[0.0, 8]] * 3), planes=np.array([[1.0, 0, 0, 4.0], [0, 1.0, 0, 2.0]])
    )
    seen = marched(values, grey_task(values.shape, fog=1.0, body=half))
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
    clipped = grey_task(values.shape, body=body, **more)
    region = values[5:17, 3:13, 4:20]
    grid = Grid(counts=(16, 10, 12), origin=np.array([4.0, 3, 5]), spacing=np.ones(3))
    alone = replace(
        grey_task(region.shape, **more), rays=Rays.of(camera, grid, (40, 36)), step=clipped.step
    )
    expected = marched(region, alone)
    assert expected.rgba[..., 3].max() > 0.5
    part = march(Frame(values=region, first=(5, 3, 4)), clipped)
    for found in (marched(values, clipped), part):
        np.testing.assert_allclose(found.rgba, expected.rgba, atol=2e-4)
        np.testing.assert_allclose(found.depth, expected.depth, atol=1e-3)
        # On faces and edges rounding decides on a sample or two of a ray.
        assert found.counters["rays"] == pytest.approx(expected.counters["rays"], rel=0.01)
    everything = marched(values, grey_task(values.shape, **more))
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
        task = grey_task(
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
    task = grey_task(
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
    task = grey_task(
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
