"""Ranks of many values in one pass: exact while they fit, then within the error that is told."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from fhash_codec.measure.ranks import Ranks, RanksSpan

RNG = np.random.default_rng(0)
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


@pytest.mark.parametrize("beyond", [0, 1, 400, 19_999])
@pytest.mark.parametrize("kind", KINDS)
def test_values_that_fit_have_their_exact_ranks(kind: str, beyond: int) -> None:
    ranks, ordered = ranks_of(KINDS[kind], 50_000, 7), np.sort(KINDS[kind])
    assert ranks.error == 0
    assert ranks.middle(beyond) == (ordered[beyond], ordered[-1 - beyond])


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
    assert 0 < ranks.error <= values.size * levels / (2 * size)
    low, high = ranks.middle(beyond)
    assert np.count_nonzero(values < low) <= beyond
    assert np.count_nonzero(values > high) <= beyond
    slack = beyond - 2 * ranks.error - 2**levels
    assert np.count_nonzero(values <= low) >= slack
    assert np.count_nonzero(values >= high) >= slack
    if slack <= 0:
        return
    assert math.isfinite(low)
    assert math.isfinite(high)


def test_an_end_that_is_not_known_is_infinite() -> None:
    ranks = ranks_of(np.arange(1000.0), 10, 1)
    assert ranks.middle(0) == (-math.inf, math.inf)


def test_only_finite_values_count() -> None:
    ranks = Ranks()
    ranks.add(np.array([[np.nan, 3.0], [np.inf, 1.0]]))
    ranks.add(np.full(3, np.nan))
    assert ranks.count == 2
    assert ranks.middle(0) == (1.0, 3.0)


def test_the_error_is_small_where_memory_is() -> None:
    """The whole blocks of n values give log2(n / size) n / (2 size) at most."""
    size, count = 1 << 10, 1 << 18
    ranks = ranks_of(np.random.default_rng(1).random(count), size, 5)
    assert ranks.error == 8 * count // (2 * size)
    low, high = ranks.middle(count // 100)
    shift = abs(low - 0.01), abs(high - 0.99)
    assert max(shift) < 3 * ranks.error / count
    assert ranks.count == count


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
