"""Figures at key frames and between them, against plain numpy."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from fhash_codec.measure.metrics import measure_quality, neighbours_of
from fhash_codec.measure.value_range import ValueRange

RNG = np.random.default_rng(0)
SOURCE = RNG.random((7, 4, 5, 6)).astype(np.float32)
KEY_FRAMES = (1, 3, 4)
MASKS = RNG.random((7, 4, 5, 6)) < 0.6


def key_index(step: float) -> float:
    return float(np.interp(step, KEY_FRAMES, np.arange(3)))


def decoded(step: int) -> np.ndarray:
    index = key_index(step)
    around = MASKS[KEY_FRAMES[math.floor(index)]] | MASKS[KEY_FRAMES[math.ceil(index)]]
    frame = SOURCE[step] + np.float32(0.01) * (step + 1)
    return np.where(around, frame, np.float32(np.nan))


def neighbours(source=SOURCE, read=None):
    read = read or source.__getitem__
    return neighbours_of(KEY_FRAMES, key_index, read, lambda step: MASKS[int(step)])


def psnr(errors) -> float:
    return -10 * math.log10(np.mean(np.concatenate(errors) ** 2))


def test_figures_are_those_of_the_steps_and_of_the_interpolated_source() -> None:
    quality = measure_quality(
        SOURCE.__getitem__, decoded, 7, 1.0, 0.0, neighbours=neighbours()
    ).between
    own, linear, fringe, fringe_linear = [], [], [], []
    mean = (SOURCE[1].astype(float) + SOURCE[3]) / 2
    for step, frame in ((0, SOURCE[1]), (2, mean), (5, SOURCE[4]), (6, SOURCE[4])):
        values = decoded(step)
        there = np.isfinite(values)
        own.append((values - SOURCE[step])[there])
        linear.append((frame - SOURCE[step])[there])
        if step == 2:
            only_one = MASKS[1] ^ MASKS[3]
            fringe.append((values - SOURCE[step])[only_one])
            fringe_linear.append((frame - SOURCE[step])[only_one])
    assert quality.psnr == pytest.approx(psnr(own), abs=1e-4)
    assert quality.psnr_linear == pytest.approx(psnr(linear), abs=1e-4)
    assert quality.psnr_fringe == pytest.approx(psnr(fringe), abs=1e-4)
    assert quality.psnr_fringe_linear == pytest.approx(psnr(fringe_linear), abs=1e-4)
    assert quality.fringe_fraction == len(fringe[0]) / sum(map(len, own))
    keys = [(decoded(step) - SOURCE[step])[MASKS[step]] for step in KEY_FRAMES]
    assert quality.psnr_key_frames == pytest.approx(psnr(keys), abs=1e-4)


def test_vertices_that_a_key_frame_lacks_have_no_interpolated_source() -> None:
    gaps = SOURCE.copy()
    gaps[1, 0], gaps[3, 1] = np.nan, np.inf
    found = neighbours(gaps)(2)
    assert np.isfinite(found.interpolated()[2:]).all()
    quality = measure_quality(
        SOURCE.__getitem__, decoded, 7, 1.0, 0.0, neighbours=neighbours(gaps)
    ).between
    assert quality.psnr_linear is not None


def test_huge_values_are_interpolated_without_overflow() -> None:
    huge = np.full((7, 1, 1, 1), np.finfo(np.float64).max)
    near = neighbours_of(KEY_FRAMES, key_index, huge.__getitem__, lambda step: huge[0] > 0)
    assert np.isfinite(near(2).interpolated()).all()


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
