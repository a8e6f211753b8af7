"""The rays of a picture as lines through the volume."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from frame_field import FrameField

from fhash_codec.rendering.stream.beams import Beams, Leaping, shares, slab
from fhash_codec.rendering.task.arrays import NUMPY, Arrays
from fhash_codec.rendering.task.task import Surface, Task

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
