"""The quality of a whole series, against plain numpy."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from fhash_codec.measure.metrics import measure_quality
from fhash_codec.measure.value_range import ValueRange


def frames(count=3, shape=(6, 7, 8), *, seed=0, dtype=np.float64):
    rng = np.random.default_rng(seed)
    original = rng.random((count, *shape)).astype(dtype)
    return original, (original + 0.01 * rng.standard_normal(original.shape)).astype(dtype)


def test_quality_measures_the_coreset_and_the_domain() -> None:
    original, decoded = frames(4, (12, 13, 14), dtype=np.float32)
    outside = np.random.default_rng(3).random(original.shape) < 0.4
    outside[2] = True
    decoded[outside] = np.nan
    original[0, 0, 0, :2] = np.nan
    calls = []
    quality = measure_quality(
        original.__getitem__, decoded.__getitem__, 4, 1.0, 0.5, lambda *call: calls.append(call)
    )
    finite = np.isfinite(original)
    inside = finite & ~outside
    filled = np.where(outside, np.float32(0.5), decoded)
    assert quality.rmse == pytest.approx(
        math.sqrt(np.mean((original - decoded)[inside].astype(float) ** 2)), rel=1e-5
    )
    assert quality.rmse_domain == pytest.approx(
        math.sqrt(np.mean((original - filled)[finite].astype(float) ** 2)), rel=1e-5
    )
    assert quality.psnr == pytest.approx(-20 * math.log10(quality.rmse))
    assert quality.psnr_domain == pytest.approx(-20 * math.log10(quality.rmse_domain))
    assert quality.max_abs_error == pytest.approx(
        np.abs(original - decoded)[inside].max(), rel=1e-5
    )
    assert quality.max_abs_error_domain == pytest.approx(
        np.abs(original - filled)[finite].max(), rel=1e-5
    )
    assert 0.9 < quality.ssim < 1
    assert quality.ssim_window == {
        "sigma": 1.5,
        "window": 11,
        "data_range": 1.0,
        "steps": [0, 1, 2, 3],
    }
    figures = json.loads(json.dumps(quality.to_dict(), allow_nan=False))
    overall = {
        "psnr",
        "rmse",
        "max_abs_error",
        "bulk",
        "ssim",
        "ssim_window",
        "psnr_domain",
        "rmse_domain",
        "max_abs_error_domain",
    }
    assert set(figures) == overall | {"per_step", "between"}
    assert [step["step"] for step in figures["per_step"]] == [0, 1, 2, 3]
    assert figures["per_step"][2] == {"step": 2, "psnr": None, "rmse": None, "max_abs_error": None}
    assert [call[:3] for call in calls] == [("measuring", step, 4) for step in (1, 2, 3, 4)]
    # The note is of all steps so far, not of the last one, which has no PSNR here.
    assert [calls[step][3] for step in (1, 2)] == [calls[1][3]] * 2
    assert calls[3][3] == f"{figures['psnr']:.1f} dB so far"


def test_the_bulk_is_measured_within_its_range_and_the_coreset() -> None:
    original, decoded = frames(4, (12, 13, 14), dtype=np.float32)
    decoded[original > 0.75] += 1.0
    decoded[np.random.default_rng(3).random(original.shape) < 0.4] = np.nan
    quality = measure_quality(
        original.__getitem__, decoded.__getitem__, 4, 1.0, 0.5, bulk=ValueRange(0.25, 0.75)
    )
    inside = np.isfinite(decoded) & (original >= 0.25) & (original <= 0.75)
    rmse = math.sqrt(np.mean((original - decoded)[inside].astype(float) ** 2))
    assert quality.bulk.rmse == pytest.approx(rmse, rel=1e-5)
    assert quality.bulk.psnr == pytest.approx(20 * math.log10(0.5 / rmse), rel=1e-6)
    assert quality.bulk.psnr > 30 > quality.psnr
    assert json.loads(json.dumps(quality.to_dict(), allow_nan=False))["bulk"] == {
        "psnr": quality.bulk.psnr,
        "rmse": quality.bulk.rmse,
        "range": [0.25, 0.75],
    }


def test_a_bulk_without_error_or_without_vertices_has_no_psnr() -> None:
    original, _ = frames(2)
    read = original.__getitem__
    exact = measure_quality(read, read, 2, 1.0, 0.5, bulk=ValueRange(0.25, 0.75)).bulk
    assert (exact.psnr, exact.rmse) == (None, 0.0)
    empty = measure_quality(read, read, 2, 1.0, 0.5, bulk=ValueRange(5.0, 6.0)).bulk
    assert (empty.psnr, empty.rmse) == (None, None)
    assert measure_quality(read, read, 2, 1.0, 0.5).bulk is None


@pytest.mark.parametrize(("data_range", "value"), [(0.0, 3.0), (math.inf, 1e308)])
def test_quality_of_a_constant_or_overflowing_series_is_valid_json(data_range, value) -> None:
    frame = np.full((3, 3, 3), value)
    quality = measure_quality(lambda _: frame, lambda _: frame, 2, data_range, 0.0)
    assert (quality.psnr, quality.rmse, quality.ssim) == (None, 0.0, None)
    json.dumps(quality.to_dict(), allow_nan=False)


def test_quality_of_nothing_kept() -> None:
    original, _ = frames(2)
    quality = measure_quality(
        original.__getitem__, lambda step: np.full_like(original[step], np.nan), 2, 1.0, 0.5
    )
    assert (quality.psnr, quality.rmse, quality.max_abs_error, quality.ssim) == (
        None,
        None,
        None,
        None,
    )
    assert quality.rmse_domain == pytest.approx(math.sqrt(np.mean((original - 0.5) ** 2)))


@pytest.mark.parametrize("held", [1, 8])
def test_steps_are_counted_in_order_whatever_is_held(monkeypatch, held) -> None:
    monkeypatch.setattr("fhash_codec.measure.metrics.FRAMES_HELD", held)
    original, decoded = frames(9)
    calls = []
    quality = measure_quality(
        lambda step: original[step],
        lambda step: decoded[step],
        9,
        1.0,
        0.0,
        lambda *call: calls.append(call),
    )
    assert [(call[1], call[2]) for call in calls] == [(step + 1, 9) for step in range(9)]
    assert [step.step for step in quality.per_step] == list(range(9))
    assert quality.max_abs_error == pytest.approx(np.abs(original - decoded).max())
