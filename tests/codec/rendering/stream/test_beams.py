"""Rays as lines: where they enter a box, and the shares by which their samples are shifted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from fhash_codec.rendering.stream.beams import Beams, shares, slab
from fhash_codec.rendering.stream.fields import FrameField
from fhash_codec.rendering.task.arrays import NUMPY, Arrays
from fhash_codec.rendering.task.task import Task

FrameTask = Callable[..., tuple[FrameField, Task]]

CUBE = np.array([[0.0, 1.0]] * 3)


@pytest.mark.parametrize(
    ("origin", "direction", "enter", "leave"),
    [
        ((-1.0, 0.5, 0.5), (1.0, 0.0, 0.0), 1.0, 2.0),
        ((2.0, 0.5, 0.5), (-0.5, 0.0, 0.0), 2.0, 4.0),
        ((0.5, 0.5, 0.5), (0.0, 1.0, 0.0), 0.0, 0.5),
        ((-1.0, -1.0, 0.5), (1.0, 1.0, 0.0), 1.0, 2.0),
        ((-1.0, 1.0, 0.5), (1.0, 0.0, 0.0), 1.0, 2.0),
    ],
    ids=["along x", "backwards", "from inside", "through an edge", "along a face"],
)
def test_rays_enter_and_leave_a_box(
    origin: tuple[float, ...], direction: tuple[float, ...], enter: float, leave: float
) -> None:
    first, last = slab(np.array([origin]), np.array([direction]), CUBE, NUMPY)
    assert (first[0], last[0]) == (enter, leave)


@pytest.mark.parametrize("origin", [(-1.0, 2.0, 0.5), (2.0, 0.5, 0.5)])
def test_a_ray_that_misses_leaves_before_it_enters(origin: tuple[float, ...]) -> None:
    first, last = slab(np.array([origin]), np.array([[1.0, 0.0, 0.0]]), CUBE, NUMPY)
    assert last[0] < first[0]


def test_shares_are_spread_evenly_and_alike_in_every_library(tensors: Arrays) -> None:
    numbers = np.arange(4096)
    share = shares(numbers, NUMPY)
    assert 0 < share.min() <= share.max() < 1
    counts, _ = np.histogram(share, bins=16, range=(0, 1))
    # 256 are expected in each bin: five standard deviations are 5 * 15.5.
    assert np.abs(counts - 256).max() < 5 * np.sqrt(256 * 15 / 16)
    np.testing.assert_array_equal(tensors.host(shares(tensors.array(numbers), tensors)), share)


def test_the_steps_of_a_ray_fill_its_path(frame_task: FrameTask) -> None:
    field, task = frame_task(np.zeros((9, 7, 7)), step=0.75, fog=1.0)
    beams = Beams.of(task, field.bounds, range(8))
    assert np.all(beams.begin == 0)
    assert np.all(beams.last == beams.end - 1)
    np.testing.assert_allclose((beams.last + beams.rest) * task.step, 8.0)
    np.testing.assert_allclose(np.linalg.norm(beams.along, axis=1), 1.0)
    # Sample 0 lies half a step behind the face through which the ray enters.
    first = beams.places(np.arange(64), np.zeros(64))
    np.testing.assert_allclose(np.abs(first[:, 2] - 4.0), 4.0 - 0.375)


def test_rows_of_a_picture_are_those_of_the_whole(frame_task: FrameTask) -> None:
    field, task = frame_task(np.zeros((9, 7, 7)), fog=1.0)
    task = replace(task, jitter=True, antialiasing=2)
    whole = Beams.of(task, field.bounds, range(8))
    rows = Beams.of(task, field.bounds, range(3, 5))
    chosen = slice(3 * 32, 5 * 32)
    np.testing.assert_array_equal(rows.origin, whole.origin[chosen])
    np.testing.assert_array_equal(rows.depth, whole.depth[chosen])
