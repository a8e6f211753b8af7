"""Errors of frames and of whole series against plain numpy."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from skimage import metrics

from fhash_codec.measure.errors import (
    Errors,
    bulk_of_ranks,
    error_sums,
    find_bulk,
    range_and_sum,
)
from fhash_codec.measure.metrics import Comparer, measure_quality, neighbours_of, ssim, ssim_steps
from fhash_codec.measure.value_range import STRIDE, Mean, Ranks, RanksSpan, ValueRange, power_of_two
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
    for step, figures in enumerate(errors.per_step()):
        of_step = (decoded - original.astype(np.float64))[step][mask[step]]
        assert figures["step"] == step
        assert figures["rmse"] == pytest.approx(math.sqrt(np.mean(of_step**2)), rel=1e-12)
        assert figures["max_abs_error"] == pytest.approx(np.abs(of_step).max(), rel=1e-12)
    together = Errors(1000.0)
    for span in (slice(1), slice(1, 3)):
        chosen = mask[span] if masked else None
        together.take(together.compare(span.start or 0, original[span], decoded[span], chosen))
    assert together.per_step() == errors.per_step()
    assert (together.count, together.rmse, together.psnr) == (
        errors.count,
        errors.rmse,
        errors.psnr,
    )


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_bulk_has_both_of_its_ends(dtype) -> None:
    original = np.array([[[1, 2, 3, 4, 5]]], dtype)
    decoded = original + np.array([0.5, 0.25, 0.125, 0.75, 0.5], dtype)
    errors = Errors(4.0, ValueRange(2, 4))
    errors.add(0, original, decoded)
    mean = (0.25**2 + 0.125**2 + 0.75**2) / 3
    assert errors.bulk_quality().rmse == pytest.approx(math.sqrt(mean), rel=1e-12)


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
    count, squares, largest = error_sums(original, decoded, mask, 0.125)[:3]
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
    assert sums[:3] == error_sums(original, decoded, None, 0.5)[:3]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_told(value) -> None:
    original, decoded = pair(20_000, np.float32)
    decoded[-3] = value
    assert error_sums(original, decoded, None, 1.0)[0] == -1
    mask = np.ones(20_000, bool)
    mask[-3] = False
    assert error_sums(original, decoded, mask, 1.0)[0] == 19_999
    original[-3] = value
    assert error_sums(original, decoded, None, 1.0)[0] == 19_999


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
    shape = (steps, *original.shape[1:])

    def decoded(block: range):
        return np.stack([decode(step) for step in block])

    return measure_quality(
        comparer, original.__getitem__, decoded, shape, list(range(steps)), **options
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


def test_quality_measures_the_coreset_and_the_domain(monkeypatch) -> None:
    monkeypatch.setattr("fhash_formats.series.BLOCK", 1)
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
@pytest.mark.parametrize("together", [1, 2, 9])
def test_steps_are_counted_in_order_whatever_is_held(monkeypatch, held, together) -> None:
    original, decoded = frames(9)
    monkeypatch.setattr("fhash_codec.measure.metrics.FRAMES_HELD", held)
    monkeypatch.setattr("fhash_formats.series.BLOCK", together * original[0].size)
    calls = []
    quality = quality_of(
        original,
        decoded.__getitem__,
        9,
        Comparer(1.0, 0.0),
        progress=lambda *call: calls.append(call),
    )
    stops = [min(first + together, 9) for first in range(0, 9, together)]
    assert [(call[1], call[2]) for call in calls] == [(stop, 9) for stop in stops]
    assert [step["step"] for step in quality.per_step] == list(range(9))
    assert quality.max_abs_error == pytest.approx(np.abs(original - decoded).max())


KINDS = {
    "normal": RNG.normal(size=40_000),
    "ascending": np.arange(40_000.0),
    "descending": -np.arange(40_000.0),
    "waves": np.tile(np.arange(100.0), 400),
    "few values": RNG.integers(0, 5, 40_000),
    "outliers": np.where(RNG.random(40_000) < 0.001, 1e30, RNG.normal(size=40_000) + 300),
    "float32": RNG.normal(size=40_000).astype(np.float32),
    "int16": RNG.integers(-30_000, 30_000, 40_000).astype(np.int16),
}


def ranks_of(values: np.ndarray, size: int, parts: int) -> Ranks:
    ranks = Ranks(size)
    for part in np.array_split(values, parts):
        ranks.add(part)
    return ranks


@pytest.mark.parametrize("parts", [1, 13])
@pytest.mark.parametrize("size", [64, 1000])
@pytest.mark.parametrize("beyond", [400, 3000])
@pytest.mark.parametrize("kind", KINDS)
def test_ends_lie_outside_by_the_error_at_most(
    kind: str, beyond: int, size: int, parts: int
) -> None:
    values = KINDS[kind]
    ranks = ranks_of(values, size, parts)
    levels = math.ceil(math.log2(values.size / size))
    assert 0 < ranks.error <= values.size * STRIDE * (levels + 1) / (2 * size)
    low, high = ranks.middle(beyond)
    assert np.count_nonzero(values < low) <= beyond
    assert np.count_nonzero(values > high) <= beyond
    slack = beyond - 2 * ranks.error - STRIDE * 2**levels
    assert np.count_nonzero(values <= low) >= slack
    assert np.count_nonzero(values >= high) >= slack
    if slack <= 0:
        return
    assert math.isfinite(low)
    assert math.isfinite(high)


def test_an_end_that_is_not_known_is_infinite() -> None:
    ranks = ranks_of(np.arange(1000.0), 16, 1)
    assert ranks.middle(0) == (-math.inf, math.inf)


@pytest.mark.parametrize("dtype", ["f4", "i2", "f8"])
@pytest.mark.parametrize("seed", range(20))
def test_spans_make_the_sketch_of_one_pass(dtype, seed) -> None:
    generator, size = np.random.default_rng(seed), 8
    values = (100 * generator.standard_normal(generator.integers(1, 2000))).astype(dtype)
    whole, parts = Ranks(size), Ranks(size)
    whole.add(values)
    cuts = np.sort(generator.integers(0, values.size + 1, generator.integers(0, 9)))
    for first, end in pairwise([0, *cuts.tolist(), values.size]):
        span = RanksSpan(first, size)
        middle = (first + end) // 2
        span.add(values[first:middle])
        span.add(values[middle:end].reshape(1, -1))
        assert len(span.blocks) <= 2 * max(1, values.size // size).bit_length()
        parts.extend(span)
    assert (parts.count, parts.error) == (whole.count, whole.error)
    for beyond in {0, values.size // 100, (values.size - 1) // 2}:
        assert parts.middle(beyond) == whole.middle(beyond)
    more = values[:500]
    whole.add(more)
    parts.add(more)
    assert (parts.error, parts.middle(2)) == (whole.error, whole.middle(2))


def test_a_span_of_another_place_is_refused() -> None:
    span = RanksSpan(3, 8)
    with pytest.raises(ValueError, match="values from 3 on do not follow 0"):
        Ranks(8).extend(span)


RANGES = [
    (0.0, 1.0),
    (-5.0, 3.0),
    (1e8, 1e8 + 1e-3),
    (-1e8 - 1e-3, -1e8),
    (1e-38, 1e38),
    (-1.7e308, 1.7e308),
    (5e-324, 2e-322),
    (-5e-324, 5e-324),
    (1e-310, 1.0),
    (2.0**53, 2.0**53 + 2),
]
finite = st.floats(allow_nan=False, allow_infinity=False)


def check_round_trip(values, low, high) -> None:
    value_range = ValueRange(low, high)
    unit = value_range.to_unit(values)
    back = value_range.from_unit(unit)
    assert unit.dtype == np.float32
    assert back.dtype == np.float64
    assert ((unit >= 0) & (unit <= 1)).all()
    assert ((back >= low) & (back <= high)).all()
    # Halves, since the full span of +-1.7e308 is not a float64.
    error, span = np.abs(back / 2 - values / 2), high / 2 - low / 2
    assert (error <= 2.0**-25 * span + math.ulp(max(abs(low), abs(high)))).all()


@pytest.mark.parametrize(("low", "high"), RANGES)
def test_error_law_and_exact_ends(low, high) -> None:
    fractions = np.linspace(0, 1, 1001)
    values = np.clip(low * (1 - fractions) + high * fractions, low, high)
    check_round_trip(values, low, high)
    value_range = ValueRange(low, high)
    np.testing.assert_array_equal(value_range.to_unit([low, high]), [0, 1])
    assert value_range.from_unit(0.0) == low
    assert (np.diff(value_range.to_unit(np.sort(values))) >= 0).all()


@given(st.lists(finite, min_size=1, max_size=20))
def test_error_law_for_any_values(numbers) -> None:
    check_round_trip(np.array(numbers), min(numbers), max(numbers))


@pytest.mark.parametrize(("low", "high"), [(1.0, 0.0), (np.nan, 1.0), (0.0, np.inf)])
def test_a_pair_that_is_no_range_is_refused(low, high) -> None:
    with pytest.raises(InputError, match="lower first"):
        ValueRange(low, high)


@given(st.floats(min_value=0, allow_infinity=False, allow_nan=False))
def test_power_of_two_is_exact_and_its_reciprocal_is_too(peak) -> None:
    scale = power_of_two(peak)
    assert scale * (1 / scale) == 1
    assert peak * scale / scale == peak
    assert peak * scale <= 2.0**25


@pytest.mark.parametrize(
    ("parts", "mean"),
    [
        ([[1.7e308, 1.7e308], [-1.7e308], [1.7e308]], 0.85e308),
        ([[5e-324, 5e-324], [5e-324]], 5e-324),
        ([[1e8, 1e8 + 1e-3], [1e8 + 2e-3]], 1e8 + 1e-3),
        ([[], [3]], 3.0),
    ],
)
def test_mean_neither_overflows_nor_drifts(parts, mean) -> None:
    total = Mean()
    for part in parts:
        total.add(np.array(part))
    assert total.count == sum(map(len, parts))
    assert math.isclose(total.value(), mean, rel_tol=1e-15)


def test_means_of_parts_make_that_of_the_whole() -> None:
    values = np.random.default_rng(2).normal(1e6, 3, 1000)
    whole, parts = Mean(), Mean()
    for part in np.split(values, [10, 10, 700]):
        whole.add(part)
        one = Mean()
        one.add(part)
        parts.join(one)
    assert (parts.count, parts.value()) == (whole.count, whole.value())


SHAPES = [
    (11, 11, 11),
    (12, 64, 70),
    (25, 40, 33),
    (1, 60, 70),
    (1, 1, 90),
    (5, 30, 2),
    (3, 4, 5),
    (1, 1, 1),
]


def pair_value_range(shape, seed=0):
    rng = np.random.default_rng(seed)
    original = rng.random(shape)
    return original, original + 0.1 * rng.standard_normal(shape)


def blurred(field):
    """The Gaussian mean around each vertex, mirrored at the borders, tap by tap."""
    weights = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    weights /= weights.sum()
    for axis in range(3):
        size = field.shape[axis]
        padded = np.pad(
            field, [(5, 5) if a == axis else (0, 0) for a in range(3)], mode="symmetric"
        )
        field = sum(w * padded.take(range(i, i + size), axis) for i, w in enumerate(weights))
    return field


def similarity(a, b, data_range):
    mean_a, mean_b = blurred(a), blurred(b)
    variance_a, variance_b = blurred(a * a) - mean_a**2, blurred(b * b) - mean_b**2
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    above = (2 * mean_a * mean_b + c1) * (2 * (blurred(a * b) - mean_a * mean_b) + c2)
    return above / ((mean_a**2 + mean_b**2 + c1) * (variance_a + variance_b + c2))


@pytest.mark.parametrize("shape", [(11, 11, 11), (12, 64, 70), (25, 40, 33), (1, 60, 70)], ids=str)
@pytest.mark.parametrize("offset", [0.0, 300.0])
def test_agrees_with_scikit_image(shape, offset) -> None:
    original, decoded = (field + offset for field in pair_value_range(shape))
    expected = metrics.structural_similarity(
        original.squeeze(),
        decoded.squeeze(),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.2,
    )
    total, count = ssim(original, decoded, 1.2)
    assert total / count == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_a_mask_counts_its_vertices_and_hides_the_rest(shape) -> None:
    original, decoded = pair_value_range(shape)
    mask = np.random.default_rng(4).random(shape) < 0.4
    mask.flat[0] = False
    expected = similarity(original, np.where(mask, decoded, original), 1.0)[mask]
    decoded[~mask] = np.nan
    total, count = ssim(original, decoded, 1.0, mask)
    assert count == mask.sum()
    assert total == pytest.approx(expected.sum(), rel=1e-9, abs=1e-12)


def test_a_mask_of_everything_is_no_mask() -> None:
    original, decoded = pair_value_range((12, 20, 13))
    assert ssim(original, decoded, 1.0, np.ones(original.shape, bool)) == ssim(
        original, decoded, 1.0
    )


@pytest.mark.parametrize("masked", [False, True])
def test_vertices_that_are_not_finite_do_not_count(masked) -> None:
    original, decoded = pair_value_range((6, 7, 40))
    bad = np.random.default_rng(5).random(original.shape) < 0.1
    mask = (
        np.random.default_rng(6).random(original.shape) < 0.5
        if masked
        else np.ones(original.shape, bool)
    )
    mean = original[~bad].mean()
    one, other = (
        np.where(bad, mean, original),
        np.where(bad, mean, np.where(mask, decoded, original)),
    )
    counts = mask & ~bad
    if not masked:
        counts[..., :5] = counts[..., -5:] = False
    original[bad], decoded[bad] = np.inf, np.nan
    total, count = ssim(original, decoded, 1.0, mask if masked else None)
    assert count == counts.sum()
    assert total == pytest.approx(similarity(one, other, 1.0)[counts].sum(), rel=1e-9)


def test_wrong_frames_are_refused_value_range() -> None:
    original, decoded = pair_value_range((5, 6, 7))
    with pytest.raises(InputError, match="one shape"):
        ssim(original, decoded[1:], 1.0)
    with pytest.raises(InputError, match="one shape"):
        ssim(original[0], decoded[0], 1.0)
    decoded[2, 2, 2] = np.nan
    with pytest.raises(InputError, match="not finite"):
        ssim(original, decoded, 1.0)


@pytest.mark.parametrize("steps", [1, 2, 3, 7, 48, 1000])
@pytest.mark.parametrize("vertices", [1, 1000, 2**20])
@pytest.mark.parametrize("budget", [1, 2**21, 2**25])
def test_measured_steps_are_even_within_budget_and_include_the_ends(
    steps, vertices, budget
) -> None:
    chosen = ssim_steps(steps, vertices, budget)
    assert len(chosen) == max(1, min(steps, budget // max(vertices, 2**15)))
    assert len(chosen) == 1 or (chosen[0], chosen[-1]) == (0, steps - 1)
    gaps = np.diff(chosen)
    assert all(0 <= step < steps for step in chosen)
    assert not len(gaps) or (gaps.min() >= 1 and gaps.max() - gaps.min() <= 1)


MEMORY = """
import resource
import numpy as np
from fhash_codec.measure.metrics import _Frames
frame = np.zeros((16, 1200, 1200), np.float32)
frame[3] = 1
frames = _Frames(frame, frame, 1.0, None)
with open("/proc/self/status") as status:
    used = next(int(line.split()[1]) for line in status if line.startswith("VmData")) << 10
resource.setrlimit(resource.RLIMIT_DATA, (used + (64 << 20), used + (64 << 20)))
try:
    frames.similarity(((0, 16), (0, 1200), (0, 1200)))
except MemoryError as error:
    print(error)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="needs Linux's limits on memory")
def test_no_memory_for_a_tile_is_said_and_ends_no_process() -> None:
    done = subprocess.run([sys.executable, "-c", MEMORY], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "no memory to compare" in done.stdout
