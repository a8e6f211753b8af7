"""Palettes, bricks and visible cells."""

from __future__ import annotations

import numpy as np
import pytest
from frame_field import frame_of, table_of
from frame_field import task_of as plain_task
from numpy.lib.stride_tricks import sliding_window_view

from fhash_codec import native
from fhash_codec.rendering.bricks import FARTHEST, SIDE, Bricks, cells_of, limits_of, smoothed
from fhash_codec.rendering.march_task import Surface


def bricks_of(values):
    return Bricks.of(frame_of(values))


def task_of(shape, extinctions, surfaces=()):
    return plain_task(shape, table_of(extinctions), surfaces=surfaces)


@pytest.mark.parametrize("shape", [(20, 17, 33), (9, 8, 10), (1, 30, 2), (1, 1, 1), (70, 70, 70)])
def test_a_brick_has_the_extremes_of_its_vertices(shape) -> None:
    values = np.random.default_rng(3).normal(size=shape).astype(np.float32)
    values[values > 1.5] = np.nan
    bricks = bricks_of(values)
    for at in np.ndindex(bricks.low.shape):
        part = values[tuple(slice(i * SIDE, i * SIDE + SIDE + 1) for i in at)]
        known = part[~np.isnan(part)]
        assert bricks.low[at] == (known.min() if known.size else np.inf)
        assert bricks.high[at] == (known.max() if known.size else -np.inf)
    assert all(
        count == max(-(-(size - 1) // SIDE), 1)
        for count, size in zip(bricks.low.shape, shape, strict=True)
    )


def test_bricks_matter_where_something_can_be_seen() -> None:
    values = np.zeros((33, 33, 33))
    values[22, 2, 10] = 1.0
    values[2, 26, 26] = 0.4
    bricks = bricks_of(values)
    peak = task_of(values.shape, [0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    assert np.argwhere(bricks.matters(peak)).tolist() == [[5, 0, 2]]
    surface = Surface(value=0.3, colour=np.ones(3), opacity=1.0)
    assert bricks.matters(task_of(values.shape, [0.0, 0.0], (surface,))).sum() == 2
    assert not bricks.matters(task_of(values.shape, [0.0, 0.0])).any()
    assert bricks.matters(task_of(values.shape, [1.0, 0.0])).all()


def test_the_distance_is_that_to_the_nearest_brick_that_matters() -> None:
    values = np.zeros((60, 50, 90))
    for z, y, x in ((4, 4, 4), (50, 20, 60), (33, 44, 85)):
        values[z, y, x] = 1.0
    bricks, task = bricks_of(values), task_of(values.shape, [0.0, 0.0, 1.0])
    matters = np.argwhere(bricks.matters(task))
    every = np.array(list(np.ndindex(bricks.low.shape)))
    exact = np.abs(every[:, None] - matters).max(axis=2).min(axis=1)
    assert np.array_equal(bricks.distance(task).ravel(), exact)
    assert np.all(bricks.distance(task_of(values.shape, [0.0, 0.0])) == FARTHEST)


def values(shape: tuple[int, int, int], seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random(shape, dtype=np.float32)


@pytest.mark.parametrize("error", [0.0, 0.01, 0.2])
def test_smoothed_values_stay_within_the_error(error: float) -> None:
    noise = values((9, 11, 20))
    noise[3, 4, 5] = np.nan
    free, found = smoothed(noise, 1.5), smoothed(noise, 1.5, error)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(noise))
    assert np.nanmax(np.abs(free - noise)) > error
    assert np.nanmax(np.abs(found - noise)) <= error + 1e-6
    near = np.abs(free - noise) <= error
    np.testing.assert_allclose(found[near], free[near], atol=1e-6)


def test_errors_cancel_and_what_is_larger_than_they_are_stays() -> None:
    """A plateau with errors becomes flat; a step beside it keeps its height between neighbours."""
    step = np.zeros((16, 16, 16), np.float32)
    step[..., 8:] = 1
    bounded = step + (0.02 * values(step.shape) - 0.01).astype(np.float32)
    free, found = smoothed(bounded, 2.5), smoothed(bounded, 2.5, 0.01)
    plateau = (slice(4, -4), slice(4, -4), slice(0, 3))
    assert np.ptp(found[plateau]) < 0.5 * np.ptp(bounded[plateau])
    heights = found[4:-4, 4:-4, 8] - found[4:-4, 4:-4, 7]
    assert heights.min() > 0.95
    assert (free[..., 8] - free[..., 7]).max() < 0.5


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
