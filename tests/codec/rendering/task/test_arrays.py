"""numpy's arrays: repeated rows are added in order, and conversions round towards 0."""

from __future__ import annotations

import numpy as np

from fhash_codec.rendering.task.arrays import NUMPY


def test_values_of_a_repeated_row_add_up_in_order() -> None:
    sums = NUMPY.full((2, 1), 0.0)
    rows = NUMPY.array([0, 1, 0, 0])
    NUMPY.add_rows(sums, rows, NUMPY.array([[1e16], [5.0], [1.0], [-1e16]]))
    # In another order the 1 would not be lost.
    assert sums[:, 0].tolist() == [(1e16 + 1.0) - 1e16, 5.0]


def test_integers_are_rounded_towards_zero() -> None:
    rounded = NUMPY.to_int64(NUMPY.array([-1.9, -0.1, 0.9, 2.0]))
    assert rounded.tolist() == [-1, 0, 0, 2]
    assert rounded.dtype == np.int64


def test_an_array_of_another_type_is_converted() -> None:
    assert NUMPY.array([1, 2], "float64").dtype == np.float64
