"""Grids: drawn vertices and those of the series, planes, lines, and directions."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest

from fhash_codec.rendering.camera.camera import view_of
from fhash_codec.rendering.camera.grid import LINE, Grid
from fhash_formats.series import Coordinate


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


def test_depths_go_downwards_with_any_stretch() -> None:
    depth = Coordinate(name="depth", values=np.linspace(0, 40, 11), attributes={"positive": "down"})
    np.testing.assert_allclose(grid(z=depth).corners[2], [0, -40])
    np.testing.assert_allclose(grid(z=depth, scale=(1, 1, 2)).corners[2], [0, -80])
    assert grid(z=depth).scale == (1, 1, -1)


def test_planes_lines_and_a_point_are_seen_from_above() -> None:
    one = [3.0]
    for axes, flat, view in (
        ({}, False, "iso"),
        ({"z": [0, 1]}, False, "iso"),
        ({"z": one}, True, "xy"),
        ({"y": one}, True, "xz"),
        ({"x": one}, True, "yz"),
        ({"z": one, "y": one}, True, "xy"),
        ({"x": one, "y": one}, True, "xz"),
        ({"x": one, "y": one, "z": one}, True, "xy"),
    ):
        made = grid(**axes)
        assert made.flat is flat
        assert view_of("auto", made) == view
        assert view_of("yx", made) == "yx"


def test_a_line_is_thick_enough_to_be_seen() -> None:
    one = [0.0]
    for count in (17, 33, 34, 321):
        line = grid(y=one, z=one, x=range(count))
        thick = max(1.0, LINE * (count - 1))
        np.testing.assert_allclose(line.corners[1:], [[-thick / 2, thick / 2]] * 2)


def test_the_thinnest_axis_is_measured_in_vertex_spacings() -> None:
    assert grid(z=[0, 1, 2]).thinnest == pytest.approx((3, 2))
    assert grid(z=[5.0]).thinnest == pytest.approx((1, 1))
    count, length = grid(z=[0, 10, 20]).thinnest
    assert count == 3
    assert length == pytest.approx(20 / 10 ** (1 / 3))
