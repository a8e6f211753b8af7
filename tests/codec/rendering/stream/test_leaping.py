"""Leaping over invisible bricks, for rays that are marched together."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from frame_field import FrameField

from fhash_codec.rendering.stream.beams import Beams
from fhash_codec.rendering.stream.leaping import Leaping
from fhash_codec.rendering.task.arrays import NUMPY, Arrays
from fhash_codec.rendering.task.task import Surface, Task

FrameTask = Callable[..., tuple[FrameField, Task]]


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
