"""Shapes of chunks: bounded bytes, whole parts of tiles, small tiles joined."""

from __future__ import annotations

from math import prod

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fhash_codec.zarr_view.chunking import FEW_BYTES, MOST_BYTES, view_chunks


@pytest.mark.parametrize(
    ("shape", "tile", "itemsize", "chunk"),
    [
        # one tile of all steps: a frame each, or several where frames are small
        ((12, 25, 125, 125), (12, 25, 125, 125), 4, (1, 25, 125, 125)),
        ((12, 13, 63, 63), (12, 13, 63, 63), 4, (6, 13, 63, 63)),
        # a tile of a good size stays
        ((12, 25, 125, 125), (4, 25, 42, 42), 4, (4, 25, 42, 42)),
        # steps are cut by divisors, so that no chunk reaches into the next tile
        ((40, 25, 125, 125), (10, 25, 125, 125), 1, (5, 25, 125, 125)),
        # huge frames: blocks of like sides
        ((3, 512, 512, 512), (1, 512, 512, 512), 4, (1, 64, 64, 128)),
        # tiny tiles are joined, in space first
        ((12, 25, 125, 125), (4, 9, 9, 9), 4, (4, 25, 36, 18)),
        ((1000, 4, 4, 4), (10, 4, 4, 4), 8, (320, 4, 4, 4)),
        ((1, 1, 1, 1), (4, 8, 8, 8), 8, (1, 1, 1, 1)),
    ],
)
def test_chunks_by_tile(
    shape: tuple[int, ...], tile: tuple[int, ...], itemsize: int, chunk: tuple[int, ...]
) -> None:
    assert view_chunks(shape, tile, itemsize) == chunk


sides = st.tuples(st.integers(1, 99), *[st.integers(1, 700)] * 3)


@given(shape=sides, tile=sides, itemsize=st.sampled_from([1, 2, 4, 8]))
def test_chunks_are_bounded_and_within_the_array(
    shape: tuple[int, ...], tile: tuple[int, ...], itemsize: int
) -> None:
    chunk = view_chunks(shape, tile, itemsize)
    size = itemsize * prod(chunk)
    assert all(1 <= side <= length for side, length in zip(chunk, shape, strict=True))
    assert size <= MOST_BYTES
    few = 2 * size > FEW_BYTES
    assert few or all(
        side == length or itemsize * prod(chunk) // side * min(2 * side, length) > FEW_BYTES
        for side, length in zip(chunk, shape, strict=True)
    )


@given(
    tile=st.tuples(*[st.sampled_from([1, 2, 4, 8, 16, 32, 48])] * 4),
    tiles=st.tuples(*[st.integers(1, 6)] * 4),
)
def test_no_chunk_reaches_into_a_part_of_another_tile(
    tile: tuple[int, ...], tiles: tuple[int, ...]
) -> None:
    shape = tuple(n * m for n, m in zip(tile, tiles, strict=True))
    for side, n, length in zip(view_chunks(shape, tile, 4), tile, shape, strict=True):
        assert n % side == 0 or side % n == 0 or side == length or n == length
