"""Tables in coded tiles: their shape, and regions and points of the files they make."""

from __future__ import annotations

import numpy as np
import pytest

import fhash_codec
from fhash_codec.paper.tables.tiles import FEW_TILES, TILE_VERTICES, tile_shape


def decoded(path) -> np.ndarray:
    with fhash_codec.open(path) as volume:
        return volume[...]


@pytest.mark.parametrize(
    "index",
    [np.s_[3], np.s_[1:4, 2:7, 3:11, 5:17], np.s_[:, 8, ::-2, 19], np.s_[4, 3:5, 4:6, 7:9]],
    ids=str,
)
def test_a_region_is_that_slice_of_the_whole_bit_for_bit(pair, index) -> None:
    path = pair["coded"][1]
    whole = decoded(path)
    with fhash_codec.open(path) as volume:
        np.testing.assert_array_equal(volume[index], whole[index])


def test_points_and_times_between_are_as_smooth_as_before(waves, pair) -> None:
    random = np.random.default_rng(0)
    points = {
        axis: random.random(300) * (n - 1) for axis, n in zip("tzyx", waves().shape, strict=True)
    }
    with fhash_codec.open(pair["coded"][1]) as volume, fhash_codec.open(pair["exact"][1]) as other:
        values, slopes = volume.sample(**points, gradient=True)
        expected = other.sample(**points)
        finite = np.isfinite(expected)
        assert finite.sum() > 30
        np.testing.assert_array_equal(finite, np.isfinite(values))
        assert np.isfinite(slopes[finite]).all()
        span = float(np.ptp(waves()))
        assert np.sqrt(np.mean((values - expected)[finite] ** 2)) < 0.05 * span


@pytest.mark.parametrize(
    "resolution",
    [(1, 1, 1, 1), (9, 20, 30, 40), (81, 40, 40, 63), (17, 200, 200, 200), (3, 1, 1, 5000)],
    ids=str,
)
def test_tiles_cut_a_level_evenly(resolution) -> None:
    tile = tile_shape(resolution)
    covered = [-(-n // length) * length for n, length in zip(resolution, tile, strict=True)]
    assert np.prod(covered) < 1.2 * np.prod(resolution)
    assert np.prod(tile) < 1.5 * TILE_VERTICES
    assert all(1 <= length <= n for length, n in zip(tile, resolution, strict=True))


@pytest.mark.parametrize(("steps", "most"), [(14, 32 * 1.5), (16, 8 * 1.5)])
def test_tiles_of_a_long_series_have_few_time_nodes(steps, most) -> None:
    tile = tile_shape((steps * 16, 64, 64, 32))  # as many times TILE_VERTICES as `steps`
    assert tile[0] <= most
    assert (tile[0] > 8 * 1.5) == (steps < FEW_TILES)
