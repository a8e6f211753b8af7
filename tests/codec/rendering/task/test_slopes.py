"""Scales of gradients for shading."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec import Renderer, Scene, Volume
from fhash_codec.rendering.camera.camera import Grid
from fhash_codec.rendering.task.slopes import (
    DEVIATIONS,
    FLATTEST,
    QUIETEST,
    STEEPEST,
    factors_at_vertices,
    flatness,
    slope_scale,
    smoothing,
)
from fhash_codec.rendering.task.task import GRADES, Grading


def grid(*spacing: float) -> Grid:
    return Grid(counts=(9, 9, 9), origin=np.zeros(3), spacing=np.array(spacing))


def test_gradients_are_shares_of_the_range_in_the_distance_of_vertices() -> None:
    np.testing.assert_allclose(slope_scale(grid(1, 1, 1), 4.0, 0.0, 4.0), [0.25] * 3)
    factors = slope_scale(grid(1, 2, -4), 4.0, 0.0, 4.0)
    np.testing.assert_allclose(factors / factors[0], [1, 0.5, -0.25])


def test_no_gradient_is_too_steep_to_be_squared_in_float32() -> None:
    factors = slope_scale(grid(1e-14, 1, 1), 1e-30, 0.0, 10.0)
    assert np.abs(factors).max() * 10.0 <= STEEPEST
    assert np.isfinite(np.float32(STEEPEST) ** 2)


def test_noise_of_rounding_is_not_lit() -> None:
    assert flatness(0.0, 1.0, 0.0, 1.0) == (1.0, FLATTEST)
    span, floor = flatness(1000.0, 1001.0, 1000.0, 1001.0)
    assert span == 1.0
    # Half of a unit in the last place of 1001 in float32, in both of two values.
    assert floor >= float(np.spacing(np.float32(1001)))
    assert flatness(5.0, 5.0, 5.0, 5.0)[0] == pytest.approx(1.0)


def test_errors_of_coding_are_not_lit() -> None:
    assert flatness(0.0, 4.0, 0.0, 4.0, 1e-9)[1] == FLATTEST
    quiet = flatness(0.0, 4.0, 0.0, 4.0, 4 * QUIETEST)
    assert quiet == (4.0, QUIETEST)
    # Above it the noise that smoothing leaves counts, and it grows with the noise to the end.
    floors = [flatness(0.0, 4.0, 0.0, 4.0, 4 * share)[1] for share in (0.0011, 0.02, 0.5, 100.0)]
    assert floors == sorted(floors)
    assert floors[0] < floors[1] <= QUIETEST * (1 + 1e-12)
    assert floors[3] <= 1.0


def test_values_are_smoothed_as_far_as_their_noise_needs() -> None:
    assert smoothing(4.0, 4 * QUIETEST) == 0.0
    assert smoothing(4.0, 4 * QUIETEST * 1.001) == DEVIATIONS[0]
    deviations = [smoothing(4.0, 4 * share) for share in (0.003, 0.01, 0.02)]
    assert deviations == sorted(set(deviations))
    assert DEVIATIONS[0] < deviations[0] < deviations[2] < DEVIATIONS[1]
    assert smoothing(4.0, 400.0) == DEVIATIONS[1]


LINEAR = Grading(factors=np.linspace(0.0, 1.0, GRADES + 1), top=2.0)


def test_a_gradient_is_a_share_of_the_range_in_the_distance_of_two_vertices(volume: Volume) -> None:
    scene = {"transfer_function": {"gradient_opacity": [[0.1, 0.2], [0.5, 1]]}}
    for scale in (1.0, 3.0):
        plan = Renderer(volume).plan(Scene.from_dict({**scene, "scale": [scale] * 3}))
        grading = plan.task.grading
        assert grading is not None
        assert grading.top == pytest.approx(
            0.5 * (volume.value_range.high - volume.value_range.low) / scale
        )
        np.testing.assert_allclose(grading.factors[[0, 205, 1024]], [0.2, 0.2, 1.0], atol=1e-3)
    assert Renderer(volume).plan(Scene()).task.grading is None


def test_factors_at_vertices_are_those_of_their_gradients() -> None:
    z, y, x = np.mgrid[:5, :6, :7].astype(np.float32)
    slope = np.ascontiguousarray(0.5 * x - 0.3 * y + 0.4 * z)
    spacing = np.array([1.0, -0.5, 2.0])
    steep = np.sqrt(0.5**2 + 0.6**2 + 0.2**2)
    np.testing.assert_allclose(factors_at_vertices(slope, LINEAR, spacing), steep / 2, atol=1e-5)
    assert np.all(factors_at_vertices(40 * slope, LINEAR, spacing) == 1)
    assert np.all(factors_at_vertices(np.ones((1, 1, 1), np.float32), LINEAR, spacing) == 0)


def test_neighbours_that_are_missing_do_not_count() -> None:
    row = np.array([[[0.0, 1.0, np.nan, 5.0, np.nan, np.nan, 8.0, 9.0]]], dtype=np.float32)
    factors = factors_at_vertices(row, LINEAR, np.ones(3))[0, 0]
    np.testing.assert_allclose(factors, [0.5, 0.5, 0, 0, 0, 0, 0.5, 0.5], atol=1e-6)


def test_gradients_near_zero_are_all_beyond_the_last_factor_or_zero(volume: Volume) -> None:
    """Their inverse would be infinite, and infinity times a gradient of 0 is no number."""
    scene = Scene.from_dict({"transfer_function": {"gradient_opacity": [[0, 0], [5e-324, 1]]}})
    grading = Renderer(volume).plan(scene).task.grading
    assert grading is not None
    assert grading.top > 0
    row = np.array([[[3.0, 3.0, 3.0, 4.0]]], dtype=np.float32)
    for spacing in (np.ones(3), np.full(3, 1e-30)):
        assert factors_at_vertices(row, grading, spacing).tolist() == [[[0, 0, 1, 1]]]
