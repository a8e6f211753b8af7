"""Fill values for vertices that do not count: all are finite, and vertices that count stay."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fhash_codec.compact.choices.transform import usual_transform
from fhash_codec.compact.tiles.blocks import Tile
from fhash_codec.compact.tiles.filling import fill
from fhash_formats.transform.tile.integers import OFFSETS
from fhash_formats.transform.tile.settings import TileSettings

SHAPE = (4, 12, 20, 24)
SETTINGS = TileSettings(
    transform=usual_transform(SHAPE), step=0.05, center=0.5, low=0.0, high=1.0, offsets=OFFSETS
)
IN_CORESET = np.indices(SHAPE)[1] <= 6


def wave() -> npt.NDArray[Any]:
    """Return a wave that is noisy where z > 6, values from 0 to 1."""
    t, z, y, x = np.indices(SHAPE)
    noise = np.random.default_rng(3).normal(size=SHAPE)
    return (0.5 + 0.3 * np.sin(0.3 * x + 0.2 * t) * np.cos(0.2 * y) + 0.15 * noise * (z > 6)).clip(
        0, 1
    )


@pytest.mark.parametrize("density", [0, 1, 2])
@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.uint8])
def test_vertices_that_count_stay_and_all_others_have_a_value(dtype: Any, density: int) -> None:
    values = (wave() * (200 if dtype == np.uint8 else 1)).astype(dtype)
    settings = SETTINGS
    if dtype == np.uint8:
        settings = replace(SETTINGS, high=200.0, center=100.0, step=10.0)
    else:
        values[:, 9, 3:6] = np.nan
        values[:, 2, 2, 2] = np.inf
    filled, counted = fill(Tile(values, IN_CORESET), settings, density)
    assert filled.dtype == values.dtype
    assert np.isfinite(filled).all()
    np.testing.assert_array_equal(counted, IN_CORESET & np.isfinite(values))
    np.testing.assert_array_equal(filled[counted], values[counted])


@pytest.mark.parametrize("counted", [None, np.ones(SHAPE, bool), np.zeros(SHAPE, bool)])
def test_a_tile_of_which_all_or_nothing_counts_stays(counted: npt.NDArray[np.bool_] | None) -> None:
    tile = Tile(wave(), counted)
    assert fill(tile, SETTINGS, 2) is tile
