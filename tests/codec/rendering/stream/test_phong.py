"""The light on a sample."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from frame_field import FrameField

from fhash_codec.rendering.stream.phong import LightAt, Phong
from fhash_codec.rendering.task.arrays import NUMPY
from fhash_codec.rendering.task.task import LightGrid, Lighting, Task

FrameTask = Callable[..., tuple[FrameField, Task]]

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
