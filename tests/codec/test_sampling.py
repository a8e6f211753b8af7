"""Points that have a value, beside the definition: one point and one corner at a time."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.boxes import Box
from fhash_codec.sampling import interpolable

BOX = Box((1, 5), (0, 4), (2, 6))


def occupied_at(step: float, region: Box) -> npt.NDArray[np.bool_]:
    """A coreset that differs from step to step; between two steps a vertex must be in both."""
    steps = {math.floor(step), math.ceil(step)}
    masks = [np.random.default_rng(number).random((6, 6, 7)) < 0.9 for number in steps]
    return np.logical_and.reduce(masks)[region.slices()]


def test_a_point_needs_the_vertices_of_its_cell_that_have_weight() -> None:
    random = np.random.default_rng(5)
    steps = np.concatenate([random.integers(0, 3, 150), random.random(150) * 2])
    space = [np.round(2 * random.uniform(-0.5, 6.5, steps.size)) / 2 for _ in range(3)]
    inside = interpolable(BOX, steps, steps, space, occupied_at)
    expected = []
    for step, *point in zip(steps, *space, strict=True):
        in_box = all(first <= p <= end - 1 for p, (first, end) in zip(point, BOX, strict=True))
        corners = product(*({math.floor(p), math.ceil(p)} for p in point))
        expected.append(
            in_box
            and all(
                occupied_at(step, Box.of((vertex, vertex + 1) for vertex in corner)).all()
                for corner in corners
            )
        )
    assert 10 < sum(expected) < steps.size - 100
    np.testing.assert_array_equal(inside, expected)
