"""The visible cells of a frame."""

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

from fhash_codec import native
from fhash_codec.rendering.camera.camera import Grid, Rays
from fhash_codec.rendering.native.cells import cells_of, limits_of
from fhash_codec.rendering.scene.scene import Camera
from fhash_codec.rendering.task.bricks import Bricks
from fhash_codec.rendering.task.task import Frame, Surface, Table, Task


def task_of(shape, extinctions, surfaces=(), low=0.0, high=1.0):
    table = Table(
        low=low,
        high=high,
        colours=np.ones((len(extinctions), 3), dtype=np.float32),
        extinctions=np.array(extinctions),
    )
    grid = Grid(counts=shape[::-1], origin=np.zeros(3), spacing=np.ones(3))
    return Task(
        rays=Rays.of(Camera(), grid, (4, 4)),
        step=0.5,
        threshold=0.0,
        table=table,
        surfaces=surfaces,
    )


def bricks_of(values):
    return Bricks.of(Frame(values=np.asarray(values, dtype=np.float32), first=(0, 0, 0)))


def noise(shape, share_missing=0.0):
    rng = np.random.default_rng(sum(shape))
    values = rng.uniform(0, 0.4, shape).astype(np.float32)
    values[rng.random(shape) < 0.04] = 0.9
    values[rng.random(shape) < share_missing] = np.nan
    return values


def test_limits_lie_around_what_is_seen() -> None:
    values = np.linspace(0, 1, 64).reshape(4, 4, 4)
    bricks = bricks_of(values)
    steps = [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 2.0, 3.0]
    np.testing.assert_allclose(
        limits_of(bricks, task_of(values.shape, steps)), [[0.125, 0.375], [0.75, np.inf]]
    )
    # What touches is one.
    np.testing.assert_allclose(
        limits_of(bricks, task_of(values.shape, [1.0, 0.0, 1.0, 0.0, 0.0])), [[-np.inf, 0.75]]
    )
    surface = Surface(value=0.6, colour=np.ones(3), opacity=1.0)
    found = limits_of(bricks, task_of(values.shape, [0.0, 0.0], (surface,)))
    assert found.shape == (1, 2)
    assert found[0, 0] < 0.6 < found[0, 1]
    assert found[0, 1] - found[0, 0] < 1e-5
    assert limits_of(bricks, task_of(values.shape, [0.0, 0.0])).shape == (0, 2)


@pytest.mark.parametrize("shape", [(9, 9, 9), (17, 20, 23), (1, 22, 30), (6, 1, 40), (2, 2, 2)])
@pytest.mark.parametrize("missing", [0.0, 0.2])
def test_a_bit_is_set_where_values_of_the_cell_reach_what_is_seen(shape, missing) -> None:
    library = native.library()
    values = noise(shape, missing)
    values[-1, -1, -1] = 0.9
    bricks = bricks_of(values)
    for extinctions, surfaces in (
        ([0.0] * 8 + [1.0] * 3, ()),
        ([0.0] * 8 + [1.0] * 3, (Surface(value=0.97, colour=np.ones(3), opacity=1.0),)),
        (
            [0.0, 0.0],
            (
                Surface(value=0.395, colour=np.ones(3), opacity=1.0),
                Surface(value=0.41, colour=np.ones(3), opacity=1.0),
            ),
        ),
    ):
        task = task_of(shape, extinctions, surfaces)
        cells = cells_of(library, bricks, task, bricks.distance(task))
        limits = limits_of(bricks, task)
        padded = np.pad(values, [(0, int(size == 1)) for size in shape], mode="edge")
        corners = sliding_window_view(padded, (2, 2, 2)).reshape(
            *(max(size - 1, 1) for size in shape), 8
        )
        low, high = (
            np.where(np.isnan(corners), np.inf, corners).min(-1),
            np.where(np.isnan(corners), -np.inf, corners).max(-1),
        )
        exact = np.any(
            [(high > first) & (low < stop) & (low <= high) for first, stop in limits], axis=0
        )
        if cells is None:
            assert exact.mean() > 0.3
            continue
        z, y, x = np.indices(exact.shape)
        bits = (
            cells[z // 4, y // 4, x // 4, z // 2 % 2]
            >> (z % 2 * 16 + y % 4 * 4 + x % 4).astype(np.uint32)
            & 1
        )
        np.testing.assert_array_equal(bits.astype(bool), exact)


def test_where_most_cells_are_seen_they_are_not_looked_for() -> None:
    library = native.library()
    values = noise((17, 17, 17))
    bricks = bricks_of(values)
    for extinctions in ([1.0, 1.0], [0.0, 0.0], [0.0, 1.0] * 20 + [0.0, 0.0, 1.0] * 20):
        task = task_of(values.shape, extinctions)
        assert cells_of(library, bricks, task, bricks.distance(task)) is None
