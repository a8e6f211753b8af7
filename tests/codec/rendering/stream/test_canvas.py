"""The picture of streamed rays: events joined front to back and lit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from frame_field import FrameField

from fhash_codec import Volume
from fhash_codec.rendering.stream.beams import Beams
from fhash_codec.rendering.stream.canvas import Canvas, Events, Factors, LightAt, Phong
from fhash_codec.rendering.stream.fields import Field
from fhash_codec.rendering.stream.stream import stream
from fhash_codec.rendering.task.arrays import NUMPY, Arrays
from fhash_codec.rendering.task.palette import Palette
from fhash_codec.rendering.task.task import GRADES, Grading, LightGrid, Lighting, Task

FrameTask = Callable[..., tuple[FrameField, Task]]
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
