"""Smoothed values: linear ones stay, noise falls, missing ones stay missing."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec import native
from fhash_codec.rendering.task.slopes import DEVIATIONS
from fhash_codec.rendering.task.smoothing import smoothed


def values(shape: tuple[int, int, int], seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random(shape, dtype=np.float32)


@pytest.mark.parametrize("deviation", DEVIATIONS)
def test_linear_values_stay_up_to_the_faces(deviation: float, way: str) -> None:
    z, y, x = np.mgrid[:9, :8, :17].astype(np.float32)
    linear = np.ascontiguousarray(z - 2 * y + 0.5 * x)
    np.testing.assert_allclose(smoothed(linear, deviation), linear, atol=1e-5)


def test_noise_falls_and_missing_values_stay_missing(way: str) -> None:
    noise = values((24, 24, 24))
    noise[3:5, 7, 9] = np.nan
    found = smoothed(noise, 2.0)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(noise))
    inner = (slice(6, -6),) * 3
    assert np.nanstd(np.diff(found[inner], axis=0)) < 0.05 * np.nanstd(np.diff(noise, axis=0))
    assert np.nanmean(found) == pytest.approx(float(np.nanmean(noise)), abs=0.02)


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 5, 2), (3, 1, 40), (12, 13, 14)])
@pytest.mark.skipif(native.library() is None, reason="needs the native library")
def test_both_ways_agree(shape: tuple[int, int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    given = values(shape, 1)
    given[given > 0.97] = np.nan
    fast = smoothed(given, 1.3)
    monkeypatch.setenv("FHASH_NATIVE", "0")
    assert native.library() is None
    np.testing.assert_allclose(fast, smoothed(given, 1.3), atol=2e-6)
