"""Crossings of streamed rays with isosurfaces."""

from __future__ import annotations

import numpy as np

from fhash_codec.rendering.stream.crossings import crossings
from fhash_codec.rendering.task.task import Surface


def test_roots_are_exact() -> None:
    sample = np.arange(6.0)[None]
    found = crossings(
        lambda row, at, counted: (at - 2.3) ** 3,
        sample,
        (sample - 2.3) ** 3,
        (
            Surface(value=0.0, colour=np.ones(3), opacity=0.5),
            Surface(value=-1.0, colour=np.ones(3), opacity=0.25),
        ),
    )
    assert found.opacity[0].tolist() == [[0, 0], [0.25, 0], [0.5, 0], [0, 0], [0, 0]]
    np.testing.assert_allclose(found.at[0, 1:3, 0], [1.3, 2.3], atol=1e-4)
    assert found.which[0, 1:3, 0].tolist() == [1, 0]


def test_nothing_is_crossed_where_a_value_is_missing() -> None:
    """Neither between samples of which one has no value, nor where the search meets none."""
    surface = Surface(value=0.5, colour=np.ones(3), opacity=1.0)
    sample, values = np.arange(4.0)[None], np.array([[0.0, np.nan, 0.0, 1.0]])
    missing = crossings(lambda row, at, _: np.full(len(at), np.nan), sample, values, (surface,))
    assert not missing.opacity.any()
    there = crossings(lambda row, at, counted: at - 2, sample, values, (surface,))
    assert there.opacity[0, :, 0].tolist() == [0, 0, 1]
    assert there.at[0, 2, 0] == 2.5
