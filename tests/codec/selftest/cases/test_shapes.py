"""Cases of shapes have the shapes and positions that their names say."""

from __future__ import annotations

from math import prod

import numpy as np
import pytest

from fhash_codec.selftest.cases import shapes

CASES = {case.name: case for case in shapes.CASES}


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("one-voxel", (1, 1, 1, 1)),
        ("one-frame", (1, 9, 10, 11)),
        ("one-along-y", (4, 9, 1, 11)),
        ("twos", (2, 2, 2, 2)),
        ("primes", (5, 7, 11, 13)),
    ],
)
def test_a_case_has_the_shape_of_its_name(name: str, shape: tuple[int, ...]) -> None:
    assert CASES[name].make().shape == shape


def test_long_axes_are_hundreds_of_times_as_long_as_the_others() -> None:
    for axis, name in enumerate(("long-t", "long-z", "long-y", "long-x")):
        lengths = list(CASES[name].make().shape)
        assert lengths.pop(axis) >= 200 * max(lengths)


def test_series_are_small() -> None:
    assert max(prod(case.make().shape) for case in shapes.CASES) <= 10_000


def test_odd_tiles_do_not_divide_the_lengths_but_one() -> None:
    tile = [int(n) for n in CASES["odd-tiles"].settings["tiles"].tile.split("x")]
    lengths = CASES["odd-tiles"].make().shape
    assert [length % n for length, n in zip(lengths, tile, strict=True)] == [1, 1, 0, 4]


@pytest.mark.parametrize(
    ("name", "holds"),
    [
        ("descending-positions", lambda positions: (np.diff(positions) < 0).all()),
        ("tiny-positions", lambda positions: np.ptp(positions) < 1e-10),
        ("huge-positions", lambda positions: np.ptp(positions) > 1e300),
        (
            "far-positions",
            lambda positions: np.ptp(positions) < 1000 * np.spacing(positions[0]),
        ),
        ("uneven-positions", lambda positions: (positions[1:] == 2 * positions[:-1]).all()),
    ],
)
def test_positions_are_as_their_name_says(name: str, holds: object) -> None:
    coords = CASES[name].make().coords
    assert all(holds(coords[axis].values) for axis in "zyx")
