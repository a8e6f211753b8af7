"""Sums in a stated order: the same bits native and in numpy, and the figures of plain numpy."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.measure.sums import error_sums, histogram, range_and_sum, squared_errors

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
