"""Colours and extinctions of values by a transfer function."""

from __future__ import annotations

import numpy as np

from fhash_codec.rendering.task.palette import Palette
from fhash_codec.rendering.task.task import Table

ENTRIES = np.array([0.0, 0.0, 2.0, 0.0, 0.0])
TABLE = Table(
    low=1.0,
    high=3.0,
    colours=np.random.default_rng(1).uniform(size=(5, 3)).astype(np.float32),
    extinctions=ENTRIES,
)


def test_values_are_interpolated_between_the_entries_and_clamped_to_them() -> None:
    palette, values = Palette.of(TABLE), np.linspace(0, 4, 33)
    places = np.linspace(1, 3, 5)
    np.testing.assert_allclose(palette.extinction(values), np.interp(values, places, ENTRIES))
    for channel in range(3):
        np.testing.assert_allclose(
            palette.colour(values)[:, channel],
            np.interp(values, places, TABLE.colours[:, channel]),
        )


def test_an_interval_is_visible_if_a_value_in_it_has_an_extinction() -> None:
    visible = Palette.of(TABLE).visible
    low = np.array([1.6, 1.0, 2.5, 1.0, 0.0, 2.4, np.nan, 2.2])
    high = np.array([1.7, 1.5, 9.0, 3.0, 0.9, 2.6, 2.0, 1.8])
    assert visible(low, high).tolist() == [True, False, False, True, False, True, False, False]
