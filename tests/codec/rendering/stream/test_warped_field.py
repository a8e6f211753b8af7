"""Fields of uneven axes: the values, slopes and visible cells of the field behind them."""

from __future__ import annotations

import numpy as np
import pytest
from frame_field import FrameField

from fhash_codec.rendering.camera.grid import Grid
from fhash_codec.rendering.stream.warped_field import WarpedField
from fhash_codec.rendering.task.arrays import NUMPY, Arrays
from fhash_codec.rendering.task.palette import Palette
from fhash_codec.rendering.task.task import Frame, Table
from fhash_formats.series import Coordinate

X = np.array([0, 1, 2, 4, 8, 16, 17, 18, 19, 20.0])
COORDS = {
    axis: Coordinate(name=axis, values=values)
    for axis, values in (("x", X), ("y", np.arange(9.0)), ("z", np.arange(7.0)))
}


def fields(arrays: Arrays = NUMPY) -> tuple[FrameField, WarpedField, Grid]:
    grid = Grid.of(COORDS)
    assert grid.warp is not None
    values = np.random.default_rng(0).random((7, 9, 10)).astype(np.float32)
    values[:, :, 5] = np.nan
    own = Grid(counts=(10, 9, 7), origin=np.zeros(3), spacing=np.ones(3))
    frame = Frame(values=values, first=(0, 0, 0))
    inner = FrameField(frame, own, arrays)
    return inner, WarpedField(inner, grid.warp), grid


def test_values_and_slopes_are_those_of_the_series() -> None:
    inner, field, grid = fields()
    random = np.random.default_rng(1)
    physical = random.uniform([0, 0, 0], [20, 8, 6], (200, 3))
    drawn = physical / grid.spacing
    own = physical.copy()
    own[:, 0] = np.interp(physical[:, 0], X, np.arange(10))
    found, expected = field.values(drawn), inner.values(own)
    assert np.isnan(expected).any()
    np.testing.assert_allclose(found, expected, atol=1e-9)
    ahead = drawn + np.array([1e-5, 0, 0])
    slopes = field.slopes(drawn)
    rising = (field.values(ahead) - found) / 1e-5
    inside = np.isfinite(rising) & (np.floor(drawn[:, 0]) == np.floor(ahead[:, 0]))
    np.testing.assert_allclose(slopes[inside, 0], rising[inside], atol=1e-4)
    np.testing.assert_allclose(np.asarray(field.bounds), grid.bounds)


def test_cells_and_bricks_hide_nothing() -> None:
    _, field, grid = fields()
    table = Table(
        low=0.0,
        high=1.0,
        colours=np.ones((101, 3), dtype=np.float32),
        extinctions=(np.arange(101) > 88) * 1.0,
    )
    cells = np.asarray(field.visible(Palette.of(table)))
    assert cells.shape == tuple(count - 1 for count in grid.counts[::-1])
    assert not cells.all()
    places = np.random.default_rng(2).uniform(0, np.array(grid.counts) - 1.001, (4000, 3))
    values = field.values(places)
    assert np.nanmax(values) > 0.88
    x, y, z = places.astype(int).T
    assert cells[z, y, x][np.nan_to_num(values) > 0.88].all()
    low, high = (part[z // 4, y // 4, x // 4] for part in (field.bricks.low, field.bricks.high))
    known = np.isfinite(values)
    assert np.all((low[known] <= values[known] + 1e-6) & (values[known] <= high[known] + 1e-6))


def test_tensors_give_the_same(tensors: Arrays) -> None:
    pytest.importorskip("torch")
    places = np.random.default_rng(3).uniform(0, 6, (50, 3))
    _, numpy_field, _ = fields()
    _, torch_field, _ = fields(tensors)
    moved = tensors.array(places)
    np.testing.assert_allclose(
        tensors.host(torch_field.values(moved)), numpy_field.values(places), atol=1e-12
    )
    np.testing.assert_allclose(
        tensors.host(torch_field.slopes(moved)), numpy_field.slopes(places), atol=1e-12
    )
