"""The float64 pictures against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.march_task import Frame, Surface, Table, Task
from fhash_codec.rendering.scenes import Camera
from fhash_codec.selftest.checks.ray_oracle import reference_picture

SHAPE = (5, 4, 4)


def task_of(**more: object) -> Task:
    """Four parallel rays from above, through a volume of `SHAPE`."""
    grid = Grid(counts=SHAPE[::-1], origin=np.zeros(3), spacing=np.ones(3))
    camera = Camera(view="xy", projection="parallel", parallel_scale=1.0)
    return Task(rays=Rays.of(camera, grid, (2, 2)), step=0.3, threshold=0.0, **more)


@pytest.mark.parametrize("extinction", [1e-6, 0.3, 50.0])
def test_a_constant_slab_has_its_closed_form(extinction: float) -> None:
    table = Table(
        low=0.0,
        high=1.0,
        colours=np.tile(np.float32([1.0, 0.5, 0.0]), (3, 1)),
        extinctions=np.full(3, extinction),
    )
    frame = Frame(values=np.full(SHAPE, 0.5, np.float32), first=(0, 0, 0))
    opacity = -np.expm1(-4 * extinction)
    np.testing.assert_allclose(
        reference_picture(frame, task_of(table=table)),
        np.broadcast_to(opacity * np.array([1, 0.5, 0, 1]), (2, 2, 4)),
        rtol=1e-9,
    )


def test_surfaces_are_drawn_over_those_behind_them() -> None:
    ramp = np.broadcast_to(np.arange(5, dtype=np.float32)[:, None, None], SHAPE)
    surfaces = tuple(
        Surface(value=value, colour=np.array(colour), opacity=0.5)
        for value, colour in ((1.0, (0, 1, 0)), (4.0, (1, 0, 0)))
    )
    picture = reference_picture(
        Frame(values=ramp, first=(0, 0, 0)), task_of(table=None, surfaces=surfaces)
    )
    # Seen from above, the surface at 4 lies on the face where the rays enter, and the one at 1
    # behind it, exactly on vertices.
    np.testing.assert_allclose(
        picture, np.broadcast_to([0.5, 0.25, 0.0, 0.75], (2, 2, 4)), rtol=1e-12
    )


def test_nothing_is_seen_where_a_vertex_with_a_weight_has_no_value() -> None:
    values = np.full(SHAPE, 0.5, np.float32)
    values[2] = np.nan
    table = Table(
        low=0.0, high=1.0, colours=np.ones((2, 3), np.float32), extinctions=np.full(2, 0.1)
    )
    picture = reference_picture(Frame(values=values, first=(0, 0, 0)), task_of(table=table))
    # Samples lie at 0.15, 0.45, ..., 3.75; one of length 0.1 lies at 3.95. Those from 1 to 3 lie
    # beside the layer without values.
    lengths = 0.3 * np.count_nonzero(np.abs(np.arange(0.15, 3.9, 0.3) - 2) >= 1) + 0.1
    np.testing.assert_allclose(picture[..., 3], -np.expm1(-0.1 * lengths), rtol=1e-6)
