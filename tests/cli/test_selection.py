"""Steps, vertices and coordinates that `--t`, `--roi` and `--box` select."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

import fhash_codec
from fhash_cli.selection import region_of_box, steps_of
from fhash_formats.errors import RegionError
from fhash_formats.series import Coordinate

COORDINATE = Coordinate(name="x", values=np.array([1.0, 2.0, 4.0, 8.0]))
VOLUME = cast(
    fhash_codec.Volume,
    SimpleNamespace(shape=(4, 4, 4, 4), coords=dict.fromkeys("tzyx", COORDINATE)),
)


@pytest.mark.parametrize(
    ("chosen", "steps"),
    [(None, [0, 1, 2, 3]), (slice(-1, None), [3]), (slice(1, 4, 2), [1, 3]), (slice(0, 1), [0])],
)
def test_steps_are_those_of_a_python_slice(chosen: slice | None, steps: list[float]) -> None:
    assert steps_of(VOLUME, chosen) == steps


@pytest.mark.parametrize(
    ("positions", "box", "expected"),
    [
        ([0.0, 5.0, 1.0, 6.0], (0.5, 2.0), (2, 3)),
        ([0.0, 5.0, 1.0, 6.0], (0.0, 6.0), (0, 4)),
        ([0.0, 5.0, 1.0, 6.0], (0.0, 1.0), None),
        ([0.0, 1.0, 1.0, 2.0], (1.0, 1.0), (1, 3)),
        ([3.0, 2.0, 1.0, 0.0], (1.0, 2.0), (1, 3)),
    ],
)
def test_a_box_never_gives_vertices_outside_it(
    positions: list[float], box: tuple[float, float], expected: tuple[int, int] | None
) -> None:
    coordinate = Coordinate(name="x", values=np.array(positions))
    volume = cast(
        fhash_codec.Volume,
        SimpleNamespace(coords={"x": coordinate, "y": coordinate, "z": coordinate}),
    )
    if expected is None:
        with pytest.raises(RegionError, match=r"neither ascend nor descend.*--roi"):
            region_of_box(volume, [(None, None), (None, None), box])
    else:
        assert region_of_box(volume, [(None, None), (None, None), box])[2] == expected


def test_a_box_outside_by_little_says_by_how_much() -> None:
    coordinate = Coordinate(name="x", values=347921.0 + np.arange(3) / 1000)
    volume = cast(fhash_codec.Volume, SimpleNamespace(coords=dict.fromkeys("zyx", coordinate)))
    with pytest.raises(
        RegionError, match=r"347921:347921\.003; the domain has positions 347921 to 347921\.002"
    ):
        region_of_box(volume, [(347921.0, 347921.003), (None, None), (None, None)])
