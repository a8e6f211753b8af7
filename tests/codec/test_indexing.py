"""Indices of a volume, beside numpy's own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fhash_codec.coreset.boxes import Box
from fhash_codec.indexing import (
    BLOCK,
    coarse_vertices,
    expand_index,
    index_ranges,
    shared_part,
    slice_of,
    step_blocks,
)
from fhash_formats.errors import RegionError

SHAPE = (3, 4, 1, 5)
ENDS = st.none() | st.integers(-7, 7)
PARTS = st.tuples(
    *(
        st.integers(-length, length - 1)
        | st.builds(slice, ENDS, ENDS, st.none() | st.sampled_from([1, 2, 3, -1, -2]))
        for length in SHAPE
    )
)


@given(parts=PARTS, count=st.integers(0, 4), ellipsis=st.none() | st.integers(0, 4))
def test_an_index_names_the_positions_that_numpy_takes(
    parts: tuple[Any, ...], count: int, ellipsis: int | None
) -> None:
    index = parts[:count]
    if ellipsis is not None and ellipsis <= count:
        # The parts behind `...` belong to the last axes.
        behind = parts[4 - (count - ellipsis) :]
        index = (*parts[:ellipsis], ..., *behind)
    vertices = np.moveaxis(np.indices(SHAPE), 0, -1)
    expanded = expand_index(index)
    positions = index_ranges(expanded, SHAPE)
    assert len(expanded) == len(positions) == 4
    grid = np.stack(np.meshgrid(*positions, indexing="ij"), axis=-1)
    expected = vertices[(*index, slice(None)) if ... in index else (*index, ...)]
    np.testing.assert_array_equal(grid.reshape(expected.shape), expected)


@given(along=st.builds(slice, ENDS, ENDS, st.none() | st.sampled_from([1, 2, 3, -1, -2])))
def test_a_slice_takes_the_positions_of_a_range_from_an_array_that_begins_later(
    along: slice,
) -> None:
    positions = range(9)[along]
    if positions:
        first = min(positions)
        assert list(range(first, 9)[slice_of(positions, first)]) == list(positions)


@pytest.mark.parametrize("index", [(0,) * 5, (..., ...), None, [0], True, 1.0, "t"], ids=repr)
def test_other_indices_are_refused(index: Any) -> None:
    with pytest.raises(IndexError, match="a volume"):
        expand_index(index)


def test_the_part_that_a_region_shares_with_a_box() -> None:
    box, region = Box.of([(1, 4), (2, 6), (0, 3)]), Box.of([(0, 2), (3, 9), (1, 2)])
    assert shared_part(box, region) == (
        Box.of([(1, 2), (0, 3), (0, 1)]),
        Box.of([(0, 1), (1, 4), (1, 2)]),
    )
    assert shared_part(box, Box.of([(4, 5), (2, 6), (0, 3)])) is None


@given(low=st.integers(0, 11), length=st.integers(1, 12), lod=st.integers(0, 3))
def test_coarse_vertices_are_those_of_the_box_in_the_region(
    low: int, length: int, lod: int
) -> None:
    box, region = Box.of([(2, 9), (0, 12), (3, 4)]), Box.of([(low, low + length)] * 3)
    expected = [
        [n for n in range(first, end, 1 << lod) if low <= n < low + length] for first, end in box
    ]
    if all(expected):
        assert [list(along) for along in coarse_vertices(box, region, lod, "run")] == expected
    else:
        with pytest.raises(RegionError, match="holds no vertex of level of detail"):
            coarse_vertices(box, region, lod, "run")


@pytest.mark.parametrize(
    ("steps", "frame", "blocks"),
    [
        (range(5), (1, 1, 1), [range(5)]),
        (range(3, 8), (1, 1, BLOCK // 2), [range(3, 5), range(5, 7), range(7, 8)]),
        (range(2, 4), (2, 1, BLOCK), [range(2, 3), range(3, 4)]),
        (range(6, 0, -3), (1, 1, 1), [range(6, 7), range(3, 4)]),
        (range(0, 5, 2), (1, 1, 1), [range(1), range(2, 3), range(4, 5)]),
        (range(0), (1, 1, 1), []),
    ],
)
def test_steps_are_cut_into_neighbours_that_are_read_together(
    steps: range, frame: tuple[int, int, int], blocks: list[range]
) -> None:
    cut = list(step_blocks(steps, frame))
    assert [together for _, together in cut] == blocks
    assert [step for places, _ in cut for step in steps[places]] == list(steps)
