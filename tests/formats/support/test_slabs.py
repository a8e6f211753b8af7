"""Chunks: bounded, equal, and cut along leading axes first."""

from __future__ import annotations

from math import prod

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fhash_formats.support.slabs import slab_shape


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
