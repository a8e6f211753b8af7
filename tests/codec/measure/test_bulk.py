"""The bulk: percentiles found in one or two passes."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.measure.bulk import MIN_SHARE, bulk_of_ranks, find_bulk, is_wide, whole_psnr
from fhash_codec.measure.ranks import Ranks
from fhash_codec.measure.value_range import ValueRange


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
