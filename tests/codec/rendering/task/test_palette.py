"""Palettes: colours and extinctions between entries, and what a range of values can show."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.rendering.task.arrays import NUMPY, Arrays
from fhash_codec.rendering.task.palette import Palette
from fhash_codec.rendering.task.task import Table

TABLE = Table(
    low=-1.0,
    high=3.0,
    colours=np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], dtype=np.float32),
    extinctions=np.array([0.0, 0.0, 2.0, 4.0, 0.0]),
)


@pytest.fixture(params=["numpy", "torch"])
def arrays(request: pytest.FixtureRequest, tensors: Arrays) -> Arrays:
    return NUMPY if request.param == "numpy" else tensors


def test_values_between_entries_are_linear_and_values_beyond_are_those_of_the_ends(
    arrays: Arrays,
) -> None:
    palette = Palette.of(TABLE, arrays)
    values = arrays.array([-9.0, -0.5, 1.5, 9.0])
    assert arrays.host(palette.extinction(values)).tolist() == [0.0, 0.0, 3.0, 0.0]
    expected = [[0, 0, 0], [0.5, 0, 0], [0, 0.5, 0.5], [1, 1, 1]]
    np.testing.assert_allclose(arrays.host(palette.colour(values)), expected, atol=1e-12)


def test_a_range_is_visible_where_some_value_in_it_has_an_extinction(arrays: Arrays) -> None:
    palette = Palette.of(TABLE, arrays)
    ends = np.linspace(-2.0, 4.0, 25)
    low, high = (axis.ravel() for axis in np.meshgrid(ends, ends, indexing="ij"))
    visible = arrays.host(palette.visible(arrays.array(low), arrays.array(high)))
    entries = np.linspace(TABLE.low, TABLE.high, 5)
    for first, last, seen in zip(low, high, visible, strict=True):
        samples = np.linspace(first, last, 400) if first <= last else np.empty(0)
        shown = bool((np.interp(samples, entries, TABLE.extinctions) > 0).any())
        # Whole entries are looked at: a range may be called visible beside one that is.
        assert seen or not shown
        assert not seen or first <= last


def test_a_missing_value_makes_no_range_visible(arrays: Arrays) -> None:
    palette = Palette.of(TABLE, arrays)
    low, high = arrays.array([np.nan, 1.0, 2.0]), arrays.array([2.0, np.nan, 1.0])
    assert not arrays.host(palette.visible(low, high)).any()
