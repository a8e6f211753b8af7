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
from fhash_codec.rendering.stream.canvas import Canvas, Events
from fhash_codec.rendering.stream.fields import Field
from fhash_codec.rendering.stream.stream import stream
from fhash_codec.rendering.task.arrays import NUMPY, Arrays
from fhash_codec.rendering.task.palette import Palette
from fhash_codec.rendering.task.task import Task

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
