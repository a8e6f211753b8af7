"""The vertices of a table that the coreset depends on."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.paper.regions import decode_region
from fhash_codec.paper.tables.trained_tables import corners, spread


@pytest.mark.parametrize(("length", "resolution"), [(1, 1), (5, 3), (5, 5), (9, 2), (20, 7)])
def test_corners_are_those_of_the_interpolation(length, resolution) -> None:
    position = np.arange(length) * (resolution - 1) / max(length - 1, 1)
    first, last = corners(length, resolution)
    np.testing.assert_array_equal(first, np.floor(position + 1e-12))
    np.testing.assert_array_equal(last, np.ceil(position - 1e-12))
    weighs = np.zeros((length, resolution), bool)
    weighs[np.arange(length), first] = weighs[np.arange(length), last] = True
    for seed in range(5):
        mask = np.random.default_rng(seed).random((2, length)) < 0.3
        np.testing.assert_array_equal(
            spread(mask, 1, resolution), (weighs.T[None] & mask[:, None]).any(axis=2)
        )


def test_the_coreset_does_not_depend_on_what_is_not_needed(random_model) -> None:
    for table in random_model.trained[:2]:
        region = tuple(slice(0, n) for n in table.shape[:4])
        assert (~table.needed(region)).sum() > 50
    one, other = random_model.network(fill=5.0), random_model.network(fill=-7.0)
    box = tuple((0, n) for n in one.box_size)
    for key in range(5):
        mask = random_model.bricks.mask(key, box)
        np.testing.assert_array_equal(
            decode_region(one, key, box)[mask], decode_region(other, key, box)[mask]
        )
