"""Rays as lines: where they enter a box, and the shares by which their samples are shifted."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.rendering.stream.beams import shares, slab
from fhash_codec.rendering.task.arrays import NUMPY, Arrays

CUBE = np.array([[0.0, 1.0]] * 3)


@pytest.mark.parametrize(
    ("origin", "direction", "enter", "leave"),
    [
        ((-1.0, 0.5, 0.5), (1.0, 0.0, 0.0), 1.0, 2.0),
        ((2.0, 0.5, 0.5), (-0.5, 0.0, 0.0), 2.0, 4.0),
        ((0.5, 0.5, 0.5), (0.0, 1.0, 0.0), 0.0, 0.5),
        ((-1.0, -1.0, 0.5), (1.0, 1.0, 0.0), 1.0, 2.0),
        ((-1.0, 1.0, 0.5), (1.0, 0.0, 0.0), 1.0, 2.0),
    ],
    ids=["along x", "backwards", "from inside", "through an edge", "along a face"],
)
def test_rays_enter_and_leave_a_box(
    origin: tuple[float, ...], direction: tuple[float, ...], enter: float, leave: float
) -> None:
    first, last = slab(np.array([origin]), np.array([direction]), CUBE, NUMPY)
    assert (first[0], last[0]) == (enter, leave)


@pytest.mark.parametrize("origin", [(-1.0, 2.0, 0.5), (2.0, 0.5, 0.5)])
def test_a_ray_that_misses_leaves_before_it_enters(origin: tuple[float, ...]) -> None:
    first, last = slab(np.array([origin]), np.array([[1.0, 0.0, 0.0]]), CUBE, NUMPY)
    assert last[0] < first[0]


def test_shares_are_spread_evenly_and_alike_in_every_library(tensors: Arrays) -> None:
    numbers = np.arange(4096)
    share = shares(numbers, NUMPY)
    assert 0 < share.min() <= share.max() < 1
    counts, _ = np.histogram(share, bins=16, range=(0, 1))
    # 256 are expected in each bin: five standard deviations are 5 * 15.5.
    assert np.abs(counts - 256).max() < 5 * np.sqrt(256 * 15 / 16)
    np.testing.assert_array_equal(tensors.host(shares(tensors.array(numbers), tensors)), share)
