"""Crossings of rays with isosurfaces: exact roots, in order, and none where a value is missing."""

from __future__ import annotations

import numpy as np

from fhash_codec.rendering.stream.crossings import crossings
from fhash_codec.rendering.task.task import Surface


def test_roots_are_exact() -> None:
    sample = np.arange(6.0)[None]
    found = crossings(
        lambda row, at: (at - 2.3) ** 3,
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


def test_a_sample_without_a_value_hides_the_crossings_beside_it() -> None:
    sample = np.arange(4.0)[None]
    steps = np.array([[-1.0, 1.0, np.nan, -1.0]])
    found = crossings(
        lambda row, at: 2 * at - 1,
        sample,
        steps,
        (Surface(value=0.0, colour=np.ones(3), opacity=1.0),),
    )
    assert found.opacity[0, :, 0].tolist() == [1.0, 0.0, 0.0]
    np.testing.assert_allclose(found.at[0, 0, 0], 0.5)
