"""Projections of passes of samples: the same whatever the passes are."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.rendering.stream.projection import Projection
from fhash_codec.rendering.task.arrays import NUMPY

VALUES = np.array([[0.2, 0.9, np.nan, 0.4], [np.nan, 0.1, 0.6, 0.6], [np.nan] * 4])
LENGTHS = np.array([[1.0, 1.0, 1.0, 0.5]] * 3)
OPACITIES = np.where(np.isnan(VALUES), 0.0, 0.5 * np.nan_to_num(VALUES))


@pytest.mark.parametrize("pace", [1, 3, 4])
@pytest.mark.parametrize(
    ("kind", "values", "at"),
    [
        ("maximum", [0.9, 0.6], [1, 2]),
        ("minimum", [0.2, 0.1], [0, 1]),
        ("average", [1.3 / 2.5, 1.0 / 2.5], [0, 1]),
        ("attenuated", [0.9 * 0.9, 0.6 * 0.95], [1, 2]),
    ],
)
def test_values_and_places(kind: str, values: list[float], at: list[int], pace: int) -> None:
    projection = Projection(kind, (0.0, 1.0), 3, NUMPY)
    alive = np.arange(3)
    for first in range(0, 4, pace):
        part = slice(first, min(first + pace, 4))
        sample = np.broadcast_to(np.arange(4)[part], VALUES[:, part].shape)
        projection.add(alive, sample, VALUES[:, part], LENGTHS[:, part], OPACITIES[:, part])
    np.testing.assert_allclose(projection.values[:2], values, rtol=1e-14)
    assert not np.isfinite(projection.values[2])
    np.testing.assert_array_equal(projection.at[:2], at)


def test_only_an_attenuated_maximum_can_be_finished_early() -> None:
    for kind in ("maximum", "minimum", "average", "attenuated"):
        projection = Projection(kind, (0.0, 1.0), 1, NUMPY)
        projection.add(
            np.array([0]), np.array([[0]]), np.array([[0.7]]), np.ones((1, 1)), np.full((1, 1), 0.5)
        )
        assert projection.finished(np.array([0]))[0] == (kind == "attenuated")
