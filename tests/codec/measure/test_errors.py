"""Errors of frames and of whole series against plain numpy."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from fhash_codec.measure.errors import (
    Errors,
    bulk_of_ranks,
    error_sums,
    find_bulk,
    range_and_sum,
    squared_errors,
)
from fhash_codec.measure.metrics import Comparer, measure_quality, neighbours_of
from fhash_codec.measure.value_range import Ranks, ValueRange
from fhash_formats.errors import InputError


def bulk_of(values, *, pieces=3, whole=False):
    """The bulk of an array that comes in pieces."""
    finite = values[np.isfinite(values)].astype(np.float64)
    limits = ValueRange(float(finite.min()), float(finite.max()))
    parts = np.array_split(values.reshape(-1), pieces)
    return find_bulk(lambda: iter(parts), limits, whole=whole)


def percentiles(values):
    finite = np.sort(values[np.isfinite(values)], axis=None)
    beyond = (finite.size - 1) // 100
    return float(finite[beyond]), float(finite[finite.size - 1 - beyond])


def heavy(scale):
    """Values of which few are far beyond the others, `scale` times as far."""
    values = np.random.default_rng(0).normal(size=20_000)
    values[:100] *= scale
    return values


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.float16])
@pytest.mark.parametrize("scale", [1.0, 20.0, 1000.0])
def test_the_ends_are_the_percentiles_rounded_outwards(dtype, scale) -> None:
    values = heavy(scale).astype(dtype)
    values[5:8] = np.nan, np.inf, -np.inf
    bulk = bulk_of(values)
    low, high = percentiles(values)
    assert bulk.low <= low
    assert high <= bulk.high
    assert bulk.high - bulk.low <= (high - low) * 1.005


@pytest.mark.parametrize("dtype", [np.int8, np.uint16, np.int32, np.int64])
def test_whole_numbers_have_whole_ends(dtype) -> None:
    labels = np.repeat([0, 1, 2, 3, 120], [500, 300, 150, 45, 5]).astype(dtype)
    assert bulk_of(labels, whole=True) == ValueRange(0.0, 3.0)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("others", "found"), [(9, False), (10, True)])
def test_a_plateau_of_nearly_all_values_has_no_bulk(others, found, sign) -> None:
    """The bulk of 1000 values leaves out the 9 least and the 9 greatest."""
    values = np.zeros(1000)
    values[:others] = sign * np.linspace(1, 2, others)
    assert (bulk_of(values) is not None) == found


@pytest.mark.parametrize("values", [[3.0], [3.0, 3.0], [0.0, 1e-12] * 500 + [1.0]], ids=len)
def test_without_width_there_is_no_bulk(values) -> None:
    assert bulk_of(np.array(values)) is None


@pytest.mark.parametrize("scale", [1.0, 20.0, 1e6])
def test_ranks_give_the_bulk_in_one_pass(scale) -> None:
    values = heavy(scale).astype(np.float32)
    limits = ValueRange(float(values.min()), float(values.max()))
    ranks = Ranks(4000)
    ranks.add(values)
    found, (low, high) = bulk_of_ranks(ranks, limits), percentiles(values)
    assert ranks.error > 0
    assert found.low <= low
    assert high <= found.high
    inside = np.count_nonzero((values >= found.low) & (values <= found.high))
    assert 0.98 <= inside / values.size <= 0.98 + (6 * ranks.error + 100) / values.size
    exact = Ranks()
    exact.add(values)
    assert bulk_of_ranks(exact, limits).low == pytest.approx(low, abs=0.001 * (high - low))


def test_ranks_without_a_width_give_no_bulk() -> None:
    flat, plateau, huge = Ranks(), Ranks(), Ranks()
    assert bulk_of_ranks(flat, ValueRange(0, 1)) is None
    plateau.add(np.repeat([3.0, 9.0], [999, 1]))
    assert bulk_of_ranks(plateau, ValueRange(3, 9)) is None
    huge.add(np.array([-1.7e308, 0.0, 1.0, 1.7e308]))
    assert bulk_of_ranks(huge, ValueRange(-1.7e308, 1.7e308)) is None


@pytest.mark.parametrize("dtype", [np.int8, np.int64])
def test_ranks_of_whole_numbers_give_whole_ends(dtype) -> None:
    labels = np.repeat([0, 1, 2, 3, 120], [500, 300, 150, 45, 5]).astype(dtype)
    ranks = Ranks()
    ranks.add(labels)
    assert bulk_of_ranks(ranks, ValueRange(0, 120), whole=True) == ValueRange(0.0, 3.0)


def frames(count=3, shape=(6, 7, 8), *, seed=0, dtype=np.float64):
    rng = np.random.default_rng(seed)
    original = rng.random((count, *shape)).astype(dtype)
    return original, (original + 0.01 * rng.standard_normal(original.shape)).astype(dtype)


def added(errors, original, decoded, mask=None):
    for step in range(len(original)):
        errors.add(step, original[step], decoded[step], None if mask is None else mask[step])
    return errors


@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int16, np.uint64])
@pytest.mark.parametrize("masked", [False, True])
def test_errors_are_those_of_plain_numpy(dtype, masked) -> None:
    rng = np.random.default_rng(1)
    original = (rng.random((3, 4, 5, 6)) * 1000).astype(dtype)
    decoded = original.astype(np.float64) + rng.standard_normal(original.shape)
    mask = rng.random(original.shape) < 0.3 if masked else np.ones(original.shape, bool)
    errors = added(Errors(1000.0), original, decoded, mask if masked else None)
    difference = (decoded - original.astype(np.float64))[mask]
    assert errors.count == mask.sum()
    assert errors.rmse == pytest.approx(math.sqrt(np.mean(difference**2)), rel=1e-12)
    assert errors.max_abs_error == pytest.approx(np.abs(difference).max(), rel=1e-12)
    assert errors.psnr == pytest.approx(20 * math.log10(1000 / errors.rmse), rel=1e-12)
    for step, figures in enumerate(errors.steps):
        errors_of_step = (decoded - original.astype(np.float64))[step][mask[step]]
        assert figures.step == step
        assert figures.rmse == pytest.approx(math.sqrt(np.mean(errors_of_step**2)), rel=1e-12)
        assert figures.max_abs_error == pytest.approx(np.abs(errors_of_step).max(), rel=1e-12)


@pytest.mark.parametrize("factor", [2.0**-1040, 2.0**-900, 2.0**900, 2.0**1023])
def test_figures_scale_with_the_data_however_huge_or_tiny(factor) -> None:
    original, decoded = frames()
    plain = added(Errors(1.0), original, decoded)
    scaled = added(Errors(factor), original * factor, decoded * factor)
    # The tiniest factor leaves 34 bits of precision: denormal numbers.
    assert scaled.psnr == pytest.approx(plain.psnr, rel=1e-6)
    assert scaled.rmse == pytest.approx(plain.rmse * factor, rel=1e-6, abs=0)
    assert scaled.max_abs_error == pytest.approx(plain.max_abs_error * factor, rel=1e-6, abs=0)


def test_wrong_frames_are_refused() -> None:
    original, decoded = frames(1)
    with pytest.raises(InputError, match="one shape"):
        Errors(1.0).add(0, original[0], decoded[0, 1:])
    with pytest.raises(InputError, match="one shape"):
        Errors(1.0).add(0, original[0], decoded[0], np.ones((1, 1, 1), bool))
    with pytest.raises(InputError, match="data range"):
        Errors(math.nan)
    decoded[0, 1, 1, 1] = np.nan
    with pytest.raises(InputError, match="step 7: decoded values are not finite"):
        Errors(1.0).add(7, original[0], decoded[0])


SIZES = [1, 255, 256, 257, 16383, 16384, 16385, 50_000]


def pair(size, dtype, *, missing=False):
    rng = np.random.default_rng(size)
    original = (rng.standard_normal(size) * 1e3).astype(dtype)
    decoded = (original + rng.standard_normal(size)).astype(dtype)
    if missing:
        original[rng.random(size) < 0.1] = np.nan
        original[:1] = np.inf
    return original, decoded


@pytest.mark.parametrize("missing", [False, True])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("size", SIZES)
def test_range_and_sum_are_those_of_numpy(size, dtype, missing) -> None:
    values, _ = pair(size, dtype, missing=missing)
    finite = values[np.isfinite(values)].astype(np.float64)
    count, low, high, total = range_and_sum(values, 0.5)
    assert count == finite.size
    assert (low, high) == ((finite.min(), finite.max()) if count else (np.inf, -np.inf))
    assert total == pytest.approx(finite.sum() / 2, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize(
    "dtypes",
    [
        (np.float32, np.float32),
        (np.float64, np.float64),
        (np.uint8, np.float32),
        (np.float32, np.float64),
    ],
    ids=str,
)
@pytest.mark.parametrize("size", SIZES)
def test_errors_are_those_of_numpy(size, dtypes, masked) -> None:
    original, decoded = (
        part.astype(dtype) for part, dtype in zip(pair(size, np.float64), dtypes, strict=True)
    )
    mask = np.random.default_rng(1).random(size) < 0.5 if masked else None
    difference = (original.astype(np.float64) - decoded)[slice(None) if mask is None else mask] / 8
    count, squares, largest = squared_errors(original, decoded, mask, 0.125)
    assert count == difference.size
    assert squares == pytest.approx(np.square(difference).sum(), rel=1e-12)
    assert largest == np.abs(difference).max(initial=0)


@pytest.mark.parametrize("dtype", [np.float32, np.int16, np.int64])
def test_the_bulk_is_summed_once_more(dtype) -> None:
    original = pair(20_000, np.float64)[0].astype(dtype)
    decoded = original + np.linspace(-1, 1, original.size).astype(np.float32)
    low, high = float(original[3]), float(original[3]) + 700  # both ends belong to it
    sums = error_sums(original, decoded, None, 0.5, (low, high))
    inside = (original >= low) & (original <= high)
    errors = (original.astype(np.float64) - decoded)[inside] / 2
    assert 0 < inside.sum() < original.size
    assert sums.bulk_count == inside.sum()
    assert sums.bulk_squares == pytest.approx(np.square(errors).sum(), rel=1e-12)
    assert sums[:3] == squared_errors(original, decoded, None, 0.5)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_told(value) -> None:
    original, decoded = pair(20_000, np.float32)
    decoded[-3] = value
    assert squared_errors(original, decoded, None, 1.0)[0] == -1
    mask = np.ones(20_000, bool)
    mask[-3] = False
    assert squared_errors(original, decoded, mask, 1.0)[0] == 19_999
    original[-3] = value
    assert squared_errors(original, decoded, None, 1.0)[0] == 19_999


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


def quality_of(original, decode, steps, comparer, **options):
    """The quality with the SSIM of all steps."""
    return measure_quality(
        comparer, original.__getitem__, decode, steps, list(range(steps)), **options
    )


def test_figures_are_those_of_the_steps_and_of_the_interpolated_source() -> None:
    quality = quality_of(SOURCE, decoded, 7, Comparer(1.0, 0.0), neighbours=neighbours()).between
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
    near = neighbours(gaps)
    quality = quality_of(SOURCE, decoded, 7, Comparer(1.0, 0.0), neighbours=near).between
    assert quality.psnr_linear is not None


def test_huge_values_are_interpolated_without_overflow() -> None:
    huge = np.full((7, 1, 1, 1), np.finfo(np.float64).max)
    near = neighbours_of(KEY_FRAMES, key_index, huge.__getitem__, lambda step: huge[0] > 0)
    assert np.isfinite(near(2).interpolated()).all()


def test_quality_measures_the_coreset_and_the_domain() -> None:
    original, decoded = frames(4, (12, 13, 14), dtype=np.float32)
    outside = np.random.default_rng(3).random(original.shape) < 0.4
    outside[2] = True
    decoded[outside] = np.nan
    original[0, 0, 0, :2] = np.nan
    calls = []
    quality = quality_of(
        original,
        decoded.__getitem__,
        4,
        Comparer(1.0, 0.5),
        progress=lambda *call: calls.append(call),
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
    comparer = Comparer(1.0, 0.5, ValueRange(0.25, 0.75))
    quality = quality_of(original, decoded.__getitem__, 4, comparer)
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
    quality = quality_of(
        original,
        decoded.__getitem__,
        9,
        Comparer(1.0, 0.0),
        progress=lambda *call: calls.append(call),
    )
    assert [(call[1], call[2]) for call in calls] == [(step + 1, 9) for step in range(9)]
    assert [step.step for step in quality.per_step] == list(range(9))
    assert quality.max_abs_error == pytest.approx(np.abs(original - decoded).max())
