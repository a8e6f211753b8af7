"""Scales of gradients for shading."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.rendering.camera.camera import Grid
from fhash_codec.rendering.task.slopes import (
    DEVIATIONS,
    FLATTEST,
    QUIETEST,
    STEEPEST,
    flatness,
    slope_scale,
    smoothing,
)


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
