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
    NUMPY,
    Arrays,
    Surface,
    Task,
)
from fhash_codec.rendering.stream_fields import Field
from fhash_codec.rendering.stream_march import stream
from fhash_codec.rendering.stream_rays import (
    Beams,
    Canvas,
    Events,
    Leaping,
    shares,
)

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
