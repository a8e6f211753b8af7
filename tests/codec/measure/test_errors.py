"""The bulk: percentiles found in one or two passes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fhash_codec.measure.errors import (
    MIN_SHARE,
    Errors,
    bulk_of_ranks,
    error_sums,
    find_bulk,
    histogram,
    is_wide,
    psnr,
    range_and_sum,
    squared_errors,
    whole_psnr,
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


@pytest.mark.parametrize("factor", [1e-300, 1e300])
@pytest.mark.parametrize("offset", [0.0, 50.0])
def test_the_bulk_scales_with_the_values(factor, offset) -> None:
    values = heavy(20.0) + offset
    plain, scaled = bulk_of(values), bulk_of(values * factor)
    assert scaled.low / factor == pytest.approx(plain.low, abs=0.01)
    assert scaled.high / factor == pytest.approx(plain.high, abs=0.01)


def test_it_does_not_depend_on_the_order_or_the_pieces() -> None:
    values = heavy(300.0).astype(np.float32)
    expected = bulk_of(values)
    assert bulk_of(values[::-1], pieces=7) == expected


@pytest.mark.parametrize("dtype", [np.int8, np.uint16, np.int32, np.int64])
def test_whole_numbers_have_whole_ends(dtype) -> None:
    labels = np.repeat([0, 1, 2, 3, 120], [500, 300, 150, 45, 5]).astype(dtype)
    assert bulk_of(labels, whole=True) == ValueRange(0.0, 3.0)


def test_large_whole_numbers_have_ends_near_the_percentiles() -> None:
    values = np.random.default_rng(0).integers(-(10**8), 10**8, 20_000)
    bulk, (low, high) = bulk_of(values, whole=True), percentiles(values)
    assert bulk.low == round(bulk.low)
    assert bulk.low == pytest.approx(low, abs=0.001 * (high - low))
    assert bulk.high == pytest.approx(high, abs=0.001 * (high - low))


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


def test_a_range_that_overflows_has_no_bulk() -> None:
    assert bulk_of((2 * np.random.default_rng(0).random(1000) - 1) * 1.79e308) is None


def test_two_values_are_their_own_bulk() -> None:
    assert bulk_of(np.array([1.0, 3.0])) == ValueRange(1.0, 3.0)


@pytest.mark.parametrize(("share", "wide"), [(MIN_SHARE, True), (MIN_SHARE * 0.999, False)])
def test_a_wide_bulk_spans_a_share_of_the_range(share, wide) -> None:
    assert is_wide(ValueRange(0.0, share), ValueRange(0.0, 1.0)) == wide


def test_the_whole_psnr_has_the_same_rmse() -> None:
    assert whole_psnr(40.0, ValueRange(1.0, 2.0), 10.0) == pytest.approx(60.0)


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


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_bulk_has_both_of_its_ends(dtype) -> None:
    original = np.array([[[1, 2, 3, 4, 5]]], dtype)
    decoded = original + np.array([0.5, 0.25, 0.125, 0.75, 0.5], dtype)
    errors = Errors(4.0, ValueRange(2, 4))
    errors.add(0, original, decoded)
    mean = (0.25**2 + 0.125**2 + 0.75**2) / 3
    assert errors.bulk_quality().rmse == pytest.approx(math.sqrt(mean), rel=1e-12)


def test_values_that_are_not_finite_do_not_count() -> None:
    original, decoded = frames()
    original[0, 0, 0, :3] = np.nan, np.inf, -np.inf
    decoded[0, 0, 0, 0] = np.nan
    errors = added(Errors(1.0), original, decoded)
    finite = np.isfinite(original)
    assert errors.count == finite.sum() == original.size - 3
    assert errors.rmse == pytest.approx(
        math.sqrt(np.mean((original - decoded)[finite] ** 2)), rel=1e-12
    )


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


def test_a_range_that_overflows_leaves_only_psnr_unknown() -> None:
    original = np.array([-1.7e308, 1.7e308, 0.0]).reshape(1, 1, 3)
    errors = Errors(math.inf)
    errors.add(0, original, original + np.array([1e300, 0, -1e300]))
    assert errors.psnr is None
    assert errors.rmse == pytest.approx(1e300 * math.sqrt(2 / 3), rel=1e-6)
    assert errors.max_abs_error == pytest.approx(1e300, rel=1e-6)


@pytest.mark.parametrize(
    ("data_range", "rmse"), [(0.0, 1.0), (1.0, 0.0), (1.0, None), (math.inf, 1.0)]
)
def test_psnr_is_none_where_it_has_no_finite_value(data_range, rmse) -> None:
    assert psnr(data_range, rmse) is None


def test_psnr_of_extreme_ratios() -> None:
    assert psnr(1e308, 1e-308) == pytest.approx(20 * 616)
    assert psnr(10.0, 1.0) == pytest.approx(20.0)


def test_a_frame_of_which_nothing_counts_has_no_figures() -> None:
    original, decoded = frames(1)
    errors = Errors(1.0)
    figures = errors.add(4, original[0], decoded[0], np.zeros(original[0].shape, bool))
    assert (figures.step, figures.psnr, figures.rmse, figures.max_abs_error) == (
        4,
        None,
        None,
        None,
    )
    assert (errors.count, errors.psnr, errors.rmse, errors.max_abs_error) == (0, None, None, None)


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


def test_zeros_have_no_sign_and_sums_may_be_infinite() -> None:
    for values in ([0.0, -0.0], [-0.0, 0.0], [-0.0]):
        _, low, high, _ = range_and_sum(np.array(values))
        assert not np.signbit([low, high]).any()
    largest = np.finfo(np.float64).max
    assert range_and_sum(np.full(1000, largest)) == (1000, largest, largest, np.inf)
    assert range_and_sum(np.full(1000, largest), 2.0**-20)[3] == pytest.approx(
        largest * (1000 * 2.0**-20)
    )


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


def test_values_beyond_a_histogram_go_to_its_ends() -> None:
    counts = np.zeros(4, np.int64)
    values = np.array([[-1e300, -1, 0, 0.99], [1, 3.5, 4, 1e300], [np.nan, np.inf, -np.inf, 2]])
    histogram(values, counts, scale=1.0, low=0.0, factor=1.0)
    histogram(np.array([1, 2, 9], np.uint8), counts, scale=1.0, low=0.0, factor=1.0)
    assert counts.tolist() == [4, 2, 2, 4]


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


def test_arrays_need_not_be_contiguous() -> None:
    original, decoded = (part.reshape(10, 20, 25) for part in pair(5000, np.float32))
    mask = original > 0
    assert squared_errors(
        original[::2, :, ::-1], decoded[::2, :, ::-1], mask[::2, :, ::-1], 1.0
    ) == squared_errors(
        original[::2, :, ::-1].copy(), decoded[::2, :, ::-1].copy(), mask[::2, :, ::-1].copy(), 1.0
    )
    assert range_and_sum(original[:, ::3]) == range_and_sum(original[:, ::3].copy())
