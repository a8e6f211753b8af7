"""Streamed rays and their pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from frame_field import FrameField

from fhash_codec import Volume
from fhash_codec.rendering.bricks import Palette
from fhash_codec.rendering.march_task import (
    GRADES,
    NUMPY,
    Arrays,
    Grading,
    LightGrid,
    Lighting,
    Surface,
    Task,
)
from fhash_codec.rendering.stream_fields import Field
from fhash_codec.rendering.stream_march import stream
from fhash_codec.rendering.stream_rays import (
    Beams,
    Canvas,
    Events,
    Factors,
    Leaping,
    LightAt,
    Phong,
    shares,
    slab,
)

FrameTask = Callable[..., tuple[FrameField, Task]]


def test_rays_enter_and_leave_a_box_where_its_faces_are() -> None:
    bounds = np.array([[0.0, 4.0], [0.0, 2.0], [1.0, 3.0]])
    origin = np.array([[-1.0, 1, 2], [5, 1, 2], [2, 1, 2], [2, 0, 0], [2, 2.5, 0], [-1, 3, 2]])
    direction = np.array([[1.0, 0, 0], [-2, 0, 0], [0, 0, 1], [0, 0, 1], [0, 0, 1], [1, -1, 0]])
    enter, leave = slab(origin, direction, bounds, NUMPY)
    hit = leave > enter
    # Along a face is inside; beside it is not; the last ray touches an edge.
    assert hit.tolist() == [True, True, True, True, False, True]
    np.testing.assert_array_equal(enter[hit], [1, 0.5, 0, 1, 1])
    np.testing.assert_array_equal(leave[hit], [5, 2.5, 1, 3, 3])


def test_shares_are_spread_evenly_and_belong_to_the_number() -> None:
    found = shares(np.arange(10_000), NUMPY)
    assert 0 < found.min() < found.max() < 1
    counts = np.histogram(found, bins=10, range=(0, 1))[0]
    assert np.abs(counts - 1000).max() < 150
    np.testing.assert_array_equal(shares(np.array([7, 3]), NUMPY), found[[7, 3]])


def test_the_steps_of_a_ray_fill_its_path(frame_task: FrameTask) -> None:
    field, task = frame_task(np.zeros((9, 7, 7)), step=0.75, fog=1.0)
    beams = Beams.of(task, field.bounds, range(8))
    assert np.all(beams.begin == 0)
    assert np.all(beams.last == beams.end - 1)
    np.testing.assert_allclose((beams.last + beams.rest) * task.step, 8.0)
    np.testing.assert_allclose(np.linalg.norm(beams.along, axis=1), 1.0)
    # Sample 0 lies half a step behind the face, where the camera stands above it.
    first = beams.places(np.arange(64), np.zeros(64))
    np.testing.assert_allclose(np.abs(first[:, 2] - 4.0), 4.0 - 0.375)


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
    leaping = Leaping.of(field.bricks, task, field.first, NUMPY)
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


def test_rays_through_nothing_leap_to_their_ends(frame_task: FrameTask) -> None:
    surface = Surface(value=0.5, colour=np.ones(3), opacity=1.0)
    field, task = frame_task(np.zeros((60, 9, 9)), surfaces=(surface,))
    beams = Beams.of(task, field.bounds, range(8))
    leaping = Leaping.of(field.bricks, task, field.first, NUMPY)
    every_ray = np.ones(64, dtype=bool)
    reached, leaps = leaping.leap(beams.origin, beams.pace, beams.begin, beams.end, every_ray)
    np.testing.assert_array_equal(reached, beams.end)
    assert leaps == 64


def test_rays_of_a_device_that_do_not_leap_stay(frame_task: FrameTask, tensors: Arrays) -> None:
    field, task = frame_task(np.zeros((60, 9, 9)), fog=0.0)
    beams = Beams.of(task, tensors.array(field.bounds), range(8), tensors)
    leaping = Leaping.of(field.bricks, task, tensors.array(field.first), tensors)
    going = beams.begin % 2 != tensors.range(64) % 2
    reached, leaps = leaping.leap(beams.origin, beams.pace, beams.begin, beams.end, going)
    expected = np.where(tensors.host(going), tensors.host(beams.end), tensors.host(beams.begin))
    np.testing.assert_array_equal(tensors.host(reached), expected)
    assert int(leaps) == 32


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


def test_central_shading_differs_from_that_of_cells_and_keeps_the_normals(
    volume: Volume, planned: Planned, central_scene: dict[str, Any]
) -> None:
    effects = {**central_scene["effects"], "shading": {"light": [1, 2, 3]}}
    cells, central = (
        stream(*planned(volume, scene, NUMPY), adaptive=True)
        for scene in ({**central_scene, "effects": effects}, central_scene)
    )
    assert 1e-3 < np.abs(cells.rgba - central.rgba)[..., :3].max() < 0.3
    np.testing.assert_array_equal(cells.rgba[..., 3], central.rgba[..., 3])
    np.testing.assert_array_equal(cells.normal, central.normal)
    assert cells.counters == central.counters


COLOUR = np.array([[0.5, 0.25, 1.0]])
ALONG = np.array([[0.0, 0.0, -1.0]])
FULL = np.ones(1)


@pytest.fixture
def phong(frame_task: FrameTask) -> Phong:
    """Phong's model with a lamp above, for values 0..1."""
    values = np.broadcast_to(np.linspace(0, 1, 9)[:, None, None], (9, 7, 7))
    field, task = frame_task(values, fog=1.0)
    lighting = Lighting(
        ambient=0.25, diffuse=0.5, specular=0.125, specular_power=3.0, lamp=np.array([0, 0, 1.0])
    )
    found = Phong.of(replace(task, lighting=lighting), field)
    assert found is not None
    return found


def test_a_task_without_lighting_has_no_model(frame_task: FrameTask) -> None:
    field, task = frame_task(np.zeros((5, 5, 5)), fog=1.0)
    assert Phong.of(task, field) is None


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("angle", [0.0, 0.5, 1.2])
def test_light_follows_the_angle_to_the_gradient_on_both_sides(
    phong: Phong, side: float, angle: float
) -> None:
    slope = side * np.array([[np.sin(angle), 0.0, np.cos(angle)]])
    cosine = np.cos(angle)
    exact = COLOUR * (0.25 + 0.5 * cosine) + 0.125 * cosine**3
    np.testing.assert_allclose(phong(COLOUR, slope, ALONG, FULL, FULL), exact, rtol=1e-6)


def test_without_a_gradient_only_the_ambient_light_is_left(phong: Phong) -> None:
    none = np.zeros((1, 3))
    np.testing.assert_allclose(phong(COLOUR, none, ALONG, FULL, FULL), 0.25 * COLOUR)


def test_shadows_take_the_light_of_the_lamp_and_surroundings_the_ambient_one(phong: Phong) -> None:
    slope = np.array([[0.0, 0.0, 1.0]])
    np.testing.assert_allclose(phong(COLOUR, slope, ALONG, 0 * FULL, FULL), 0.25 * COLOUR)
    np.testing.assert_allclose(
        phong(COLOUR, slope, ALONG, FULL, 0 * FULL), 0.5 * COLOUR + 0.125, rtol=1e-6
    )


def test_a_grid_of_light_is_trilinear_and_clamped() -> None:
    z, y, x = np.meshgrid(*map(np.arange, (3.0, 4.0, 5.0)), indexing="ij")
    values = np.stack([x / 8 + y / 16, z / 4], axis=-1).astype(np.float32)
    light = LightAt(LightGrid(shares=values, first=np.array([10.0, 20.0, 30.0]), cell=2.0), NUMPY)
    places = np.array([[13.0, 21.0, 33.0], [0.0, 0.0, 0.0], [99.0, 99.0, 99.0]])
    lamp, around = light(places)
    np.testing.assert_allclose(lamp, [1.5 / 8 + 0.5 / 16, 0.0, 4 / 8 + 3 / 16])
    np.testing.assert_allclose(around, [1.5 / 4, 0.0, 0.5])


@pytest.mark.parametrize(("slope", "factor"), [(0.0, 0.1), (0.5, 0.35), (1.0, 0.6), (9.0, 0.6)])
def test_a_ramp_has_the_factor_of_its_gradient(
    frame_task: FrameTask, slope: float, factor: float
) -> None:
    z, y, x = np.meshgrid(*(np.arange(6.0),) * 3, indexing="ij")
    field, task = frame_task(slope * (0.6 * y + 0.8 * z) + 0 * x)
    assert Factors.of(task, field) is None
    grading = Grading(factors=np.linspace(0.1, 0.6, GRADES + 1), top=1.0)
    factors = Factors.of(replace(task, grading=grading), field)
    assert factors is not None
    places = np.random.default_rng(3).uniform(0, 5, (20, 3))
    np.testing.assert_allclose(factors(places), factor, atol=1e-6)
