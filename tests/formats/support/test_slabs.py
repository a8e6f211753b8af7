"""Chunks: bounded, equal, cut along leading axes first; their regions tile the array."""

from __future__ import annotations

from math import prod

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fhash_formats.errors import RegionError
from fhash_formats.support.slabs import chunk_region, common_part, region_bounds, slab_shape


@pytest.mark.parametrize(
    ("shape", "itemsize", "limit", "chunk"),
    [
        ((10,), 8, 2**21, (10,)),
        ((4, 100, 100, 100), 2, 2**21, (1, 100, 100, 100)),
        ((4, 100, 100, 100), 4, 2**21, (1, 50, 100, 100)),
        ((1, 1, 2048, 1024), 4, 2**21, (1, 1, 512, 1024)),
        ((3, 2**30), 1, 2**21, (1, 2**21)),
        ((5, 5), 8, 1, (1, 1)),
        ((), 8, 100, ()),
        ((3, 0, 2), 8, 100, (3, 0, 2)),
    ],
)
def test_slabs(shape: tuple[int, ...], itemsize: int, limit: int, chunk: tuple[int, ...]) -> None:
    assert slab_shape(shape, itemsize, limit) == chunk


@given(
    st.lists(st.integers(1, 10**6), max_size=5),
    st.sampled_from([1, 2, 4, 8]),
    st.integers(8, 10**9),
)
def test_slabs_keep_the_limit_and_use_it(shape: list[int], itemsize: int, limit: int) -> None:
    chunk = slab_shape(shape, itemsize, limit)
    size = prod(chunk) * itemsize
    assert size <= limit
    assert all(1 <= part <= whole for part, whole in zip(chunk, shape, strict=True))
    assert size == prod(shape) * itemsize or size > limit / 4


@given(st.lists(st.tuples(st.integers(1, 9), st.integers(1, 5)), min_size=1, max_size=3))
def test_regions_of_chunks_tile_the_array(axes: list[tuple[int, int]]) -> None:
    shape, chunk = (tuple(column) for column in zip(*axes, strict=True))
    covered = np.zeros(shape, dtype=int)
    for index in np.ndindex(*(-(-n // c) for n, c in axes)):
        covered[chunk_region(index, chunk, shape)] += 1
    np.testing.assert_array_equal(covered, 1)


def test_the_common_parts_of_all_chunks_make_the_region() -> None:
    values = np.arange(5 * 7).reshape(5, 7)
    bounds, chunk = [(1, 5), (2, 6)], (2, 3)
    region = np.zeros((4, 4), int)
    for index in np.ndindex(3, 2):
        in_region, in_chunk = common_part(index, chunk, bounds)
        region[in_region] += values[chunk_region(index, chunk, values.shape)][in_chunk]
    np.testing.assert_array_equal(region, values[1:5, 2:6])


def test_bounds_of_a_region() -> None:
    assert region_bounds((slice(None), slice(1, 3, 1)), (4, 5), "a") == [(0, 4), (1, 3)]
    for region in [(slice(0, 5),), (slice(2, 1),), (slice(0, 4, 2),), (slice(-1, 2),)]:
        with pytest.raises(RegionError, match=r"a: .* within 0\.\.4"):
            region_bounds(region, (4,), "a")
    with pytest.raises(RegionError, match="2 axes; the array has 1"):
        region_bounds((slice(0, 1), slice(0, 1)), (4,), "a")
