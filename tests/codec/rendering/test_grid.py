"""Axes as they are drawn, and the even grid."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest

from fhash_codec.rendering import grid as module
from fhash_codec.rendering.grid import Axis, Grid, downward, drawn_counts
from fhash_formats.series import Coordinate


def coordinate(values: Any, **attributes: Any) -> Coordinate:
    return Coordinate(name="a", values=np.asarray(values, dtype=np.float64), attributes=attributes)


@pytest.mark.parametrize(("off", "even"), [(0.0099, True), (0.0101, False)])
def test_coordinates_are_even_up_to_a_thousandth_of_their_extent(off: float, even: bool) -> None:
    values = np.arange(11.0)
    values[5] += off
    axis = Axis.of(coordinate(values))
    assert axis.even is even
    assert axis.problem == ""


@pytest.mark.parametrize("values", [[0, 1, 4, 9], [9, 4, 1, 0], [5, 10, 5000]])
def test_uneven_vertices_are_found_where_they_lie(values: list[float]) -> None:
    axis = Axis.of(coordinate(values))
    (count,) = drawn_counts([axis])
    places = axis.places(count)
    assert places[[0, -1]].tolist() == [0, len(values) - 1]
    assert np.all(np.diff(places) > 0)
    evenly = np.linspace(values[0], values[-1], count)
    np.testing.assert_allclose(np.interp(places, range(len(values)), values), evenly, rtol=1e-12)


def test_longitudes_go_on_beyond_the_whole_turn() -> None:
    axis = Axis.of(coordinate([350, 355, 0, 5], units="degrees_east"))
    assert axis.even
    np.testing.assert_allclose(axis.values, [350, 355, 360, 365])


@pytest.mark.parametrize("values", [[0, 2, 1], [0, 0, 1, 5], [np.nan, 1], [1, 1], [0, 1e101]])
def test_what_is_no_line_is_told(values: list[float]) -> None:
    axis = Axis.of(coordinate(values))
    assert axis.even
    assert axis.values.tolist() == list(range(len(values)))
    assert "vertices are drawn one unit apart" in axis.problem


def test_an_uneven_axis_is_drawn_with_its_smallest_distance_within_limits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    even = Axis.of(coordinate(range(10)))
    fine = Axis.of(coordinate([0, 1, 5, 10]))
    assert drawn_counts([fine, even]) == [11, 10]
    # Nearly even: twice as fine all the same, so that nothing is smeared.
    assert drawn_counts([Axis.of(coordinate([0, 1, 2.05, 3]))]) == [7]
    assert drawn_counts([Axis.of(coordinate([0, 1e-9, 1, 2]))]) == [3 * module.MOST_FINER + 1]
    many = np.arange(400.0) ** 2
    assert drawn_counts([Axis.of(coordinate(many))]) == [399 * 2 + 1]
    monkeypatch.setattr(module, "MAX_DRAWN", 60)
    assert drawn_counts([fine, even])[0] <= 6
    monkeypatch.setattr(module, "MAX_DRAWN", 10)
    assert drawn_counts([fine, even]) == [4, 10]


@pytest.mark.parametrize(
    ("attributes", "down"),
    [
        ({}, False),
        ({"units": "m"}, False),
        ({"positive": "down"}, True),
        ({"positive": "Down "}, True),
        ({"positive": "up", "standard_name": "depth"}, False),
        ({"standard_name": "depth"}, True),
        ({"standard_name": "height"}, False),
        ({"units": "hPa"}, True),
        ({"units": "Pa", "positive": "up"}, False),
    ],
)
def test_what_ascends_downwards(attributes: dict[str, str], down: bool) -> None:
    assert downward(coordinate([0, 1], **attributes)) is down


def grid(scale: tuple[float, float, float] | None = None, **axes: Any) -> Grid:
    values = {"x": range(11), "y": range(11), "z": range(11), **axes}
    given = {
        axis: at
        if isinstance(at, Coordinate)
        else Coordinate(name=axis, values=np.array(list(at), dtype=np.float64))
        for axis, at in values.items()
    }
    return Grid.of(given, scale)


def test_an_uneven_axis_keeps_its_ends_and_needs_no_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        uneven = grid(x=np.arange(11) ** 2, y=-(np.arange(11.0) ** 1.5))
    assert uneven.counts == (101, 33, 11)
    assert uneven.series_counts == (11, 11, 11)
    np.testing.assert_allclose(uneven.corners, [[0, 100], [0, -(10**1.5)], [0, 10]])
    assert uneven.warp is not None
    np.testing.assert_allclose(uneven.warp.to_series(0, [0, 1, 4, 81]), [0, 1, 2, 9])
    assert uneven.warp.places[2] is None
    assert uneven.coarseness[0] == pytest.approx(19)
    assert uneven.coarseness[2] == 1
    # Opacities are of vertices of the series: the finer ones change nothing.
    assert uneven.series_spacing == pytest.approx((10 * 10**0.5 * 1) ** (1 / 3))
    assert grid().warp is None
    assert grid().series_spacing == grid().vertex_spacing
