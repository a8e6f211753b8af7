"""A task in the vertices of a frame: places, and values that float32 can compute with."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fhash_codec.rendering.camera.camera import Grid, Rays
from fhash_codec.rendering.native.frame_task import MAX_MAGNITUDE, MarchInput, empty_table
from fhash_codec.rendering.scene.scene import Camera
from fhash_codec.rendering.task.bricks import Bricks
from fhash_codec.rendering.task.task import Frame, Surface, Table, Task

COUNTS = (21, 17, 13)


def input_of(values: Any, low: float, high: float, level: float, **place: Any) -> MarchInput:
    """The input for a frame of values, a table and a surface."""
    grid = Grid(counts=COUNTS, origin=np.zeros(3), spacing=np.array([1.0, 2.0, -3.0]))
    frame = Frame(values=np.asarray(values, dtype=np.float32), **place)
    task = Task(
        rays=Rays.of(Camera(), grid, (4, 4)),
        step=0.5,
        threshold=0.0,
        table=Table(
            low=low, high=high, colours=np.ones((2, 3), np.float32), extinctions=np.ones(2)
        ),
        surfaces=(Surface(value=level, colour=np.ones(3), opacity=1.0),),
    )
    return MarchInput.of(frame, task, Bricks.of(frame))


def test_places_of_the_domain_are_those_of_the_frame() -> None:
    values = np.zeros((3, 4, 5))
    whole = input_of(np.zeros(COUNTS[::-1]), 0.0, 1.0, 0.5, first=(0, 0, 0))
    part = input_of(values, 0.0, 1.0, 0.5, first=(2, 4, 6), stride=2)
    shift = np.array([6.0, 4.0, 2.0])
    np.testing.assert_array_equal(part.eye, (whole.eye - shift) / 2)
    np.testing.assert_array_equal(part.forward, whole.forward / 2)
    np.testing.assert_array_equal(part.box, (whole.box - shift[:, None]) / 2)
    np.testing.assert_array_equal(part.spacing, 2 * whole.spacing)
    np.testing.assert_array_equal(part.seen, [[0, 4], [0, 3], [0, 2]])


@pytest.mark.parametrize(
    ("low", "high"), [(0.0, 1e38), (-3e38, 3e38), (0.0, 1e-30), (2.0**-130, 2.0**-129)]
)
def test_values_are_scaled_to_what_float32_can_compute_with(low: float, high: float) -> None:
    shares = np.linspace(0, 1, 27).reshape(3, 3, 3)
    given = input_of(low + shares * (high - low), low, high, (low + high) / 2, first=(0, 0, 0))
    assert 1e-28 < given.high - given.low < MAX_MAGNITUDE
    scaled = (given.values - given.low) / (given.high - given.low)
    np.testing.assert_allclose(scaled, shares, atol=1e-5)
    assert given.levels[0] == pytest.approx((given.low + given.high) / 2)


def test_ordinary_values_are_not_copied() -> None:
    values = np.linspace(0, 1, 27, dtype=np.float32).reshape(3, 3, 3)
    assert input_of(values, 0.0, 1.0, 0.5, first=(0, 0, 0)).values is not None
    assert np.shares_memory(input_of(values, 0.0, 1.0, 0.5, first=(0, 0, 0)).values, values)


def test_an_empty_table_shows_nothing() -> None:
    table = empty_table(1.0, 2.0)
    assert not table.extinctions.any()
    assert (table.low, table.high) == (1.0, 2.0)
