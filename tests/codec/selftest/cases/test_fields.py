"""Fields have the stated range and coordinates."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.selftest.cases.fields import SHAPE, lattice, noise, series, waves


@pytest.mark.parametrize("shape", [SHAPE, (2, 2, 2, 2), (1, 1, 1, 5)])
def test_waves_reach_both_ends_of_their_range(shape: tuple[int, int, int, int]) -> None:
    assert waves(shape).shape == shape
    assert (waves(shape).min(), waves(shape).max()) == (0.0, 1.0)


def test_waves_of_one_value_are_finite() -> None:
    assert waves((1, 1, 1, 1)).tolist() == [[[[0.0]]]]


def test_the_lattice_counts_vertices() -> None:
    for axis, index in enumerate(lattice((2, 3, 4, 5))):
        assert index.shape == (2, 3, 4, 5)
        np.testing.assert_array_equal(np.diff(index, axis=axis), 1.0)


def test_noise_is_the_same_for_a_seed_and_another_for_another() -> None:
    np.testing.assert_array_equal(noise(), noise())
    assert not np.array_equal(noise(), noise(seed=1))


def test_a_series_has_the_given_coordinates() -> None:
    given = series(waves((2, 3, 1, 1)), times=[5.0, 7.0], units="K", z=np.array([1.0, 2.0, 4.0]))
    assert given.units == "K"
    assert given.coords["t"].values.tolist() == [5.0, 7.0]
    assert given.coords["z"].values.tolist() == [1.0, 2.0, 4.0]
    assert given.coords["x"].values.tolist() == [0.0]
