"""The bulk: percentiles found in one or two passes."""

from __future__ import annotations

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


def test_the_psnr_of_denormals_does_not_come_from_their_rounding() -> None:
    original = 5e-324 * np.arange(1000.0).reshape(1, 10, 100)
    decoded = original.copy()
    decoded[0, 0, :7] += 5e-324
    errors = Errors(float(original.max()))
    errors.add(0, original, decoded)
    # The root mean square is less than the smallest number.
    assert errors.psnr == pytest.approx(20 * math.log10(999 / math.sqrt(7 / 1000)))
    assert errors.steps[0].psnr == errors.psnr


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
