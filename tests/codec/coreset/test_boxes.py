"""Boxes: their laws, and the smallest ones around masks and other boxes."""

from __future__ import annotations

import itertools
import json
import pickle

import numpy as np
import numpy.typing as npt
import pytest

from fhash_codec.coreset.boxes import Box, bounding_box, fuse

SHAPE = (3, 4, 5)
LINES = [[(first, end) for end in range(n + 1) for first in range(end)] for n in SHAPE]
BOXES = [Box(*spans) for spans in itertools.product(*LINES)][::17]


def mask_of(box: Box) -> npt.NDArray[np.bool_]:
    """The vertices of a box, True in a grid of SHAPE."""
    mask = np.zeros(SHAPE, bool)
    mask[box.slices()] = True
    return mask


def test_a_box_is_the_tuple_of_its_spans() -> None:
    spans = ((1, 4), (2, 3), (0, 7))
    box = Box(*spans)
    assert box == spans
    assert hash(box) == hash(spans)
    assert Box.of([[1, 4], [2, 3], [0, 7]]) == box
    assert json.dumps(box) == json.dumps(spans) == "[[1, 4], [2, 3], [0, 7]]"
    assert pickle.loads(pickle.dumps(box)) == box
    assert box.first == (1, 2, 0)
    assert Box.of_shape((3, 1, 7)) == ((0, 3), (0, 1), (0, 7))
    with pytest.raises(ValueError, match="unpack"):
        Box.of([(0, 1), (0, 1)])


@pytest.mark.parametrize("box", BOXES[::5], ids=str)
def test_slices_cut_out_the_shape_of_a_box(box: Box) -> None:
    grid = np.moveaxis(np.indices(SHAPE), 0, -1)
    assert grid[box.slices()].shape == (*box.shape, 3)
    assert tuple(grid[box.slices()][0, 0, 0]) == box.first
    moved = box.shift(-first for first in box.first)
    assert moved == Box.of_shape(box.shape)
    assert moved.shift(box.first) == box


def test_the_intersection_holds_the_vertices_of_both_boxes() -> None:
    for first, second in itertools.combinations_with_replacement(BOXES, 2):
        common = first.intersect(second)
        assert common == second.intersect(first)
        both = mask_of(first) & mask_of(second)
        assert common == bounding_box(both)
        assert common is None or bool(both[common.slices()].all())


def test_bounding_boxes_are_the_smallest_and_their_fusion_holds_all() -> None:
    mask = np.zeros((5, 6, 7), bool)
    assert bounding_box(mask) is None
    assert fuse([None, None]) is None
    mask[1, 2, 3] = mask[4, 2, 6] = True
    box = bounding_box(mask)
    assert box == ((1, 5), (2, 3), (3, 7))
    assert fuse([box, None, Box((0, 2), (4, 6), (3, 4))]) == ((0, 5), (2, 6), (3, 7))
