"""Smoothed values: linear ones stay, noise falls, missing ones stay missing."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.rendering.task.slopes import DEVIATIONS
from fhash_codec.rendering.task.smoothing import smoothed


def values(shape: tuple[int, int, int], seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random(shape, dtype=np.float32)


@pytest.mark.parametrize("deviation", DEVIATIONS)
def test_linear_values_stay_up_to_the_faces(deviation: float) -> None:
    z, y, x = np.mgrid[:9, :8, :17].astype(np.float32)
    linear = np.ascontiguousarray(z - 2 * y + 0.5 * x)
    np.testing.assert_allclose(smoothed(linear, deviation), linear, atol=1e-5)


def test_noise_falls_and_missing_values_stay_missing() -> None:
    noise = values((24, 24, 24))
    noise[3:5, 7, 9] = np.nan
    found = smoothed(noise, 2.0)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(noise))
    inner = (slice(6, -6),) * 3
    assert np.nanstd(np.diff(found[inner], axis=0)) < 0.05 * np.nanstd(np.diff(noise, axis=0))
    assert np.nanmean(found) == pytest.approx(float(np.nanmean(noise)), abs=0.02)


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


def test_values_near_the_largest_float_stay_finite() -> None:
    given = np.float32(3.2e38) * values((9, 10, 24), 3)
    found = smoothed(given, 1.3)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(
        found / np.float32(1e38), smoothed(given / np.float32(1e38), 1.3), rtol=1e-5
    )
