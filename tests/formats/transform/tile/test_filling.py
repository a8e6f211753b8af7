"""Fill values: the counted values stay as they are, and the others take few bytes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from specs import spec_of

from fhash_formats.transform.tile.decoding import transform_for
from fhash_formats.transform.tile.encoding import Coding, encode_tile
from fhash_formats.transform.tile.filling import RATIOS, filled
from fhash_formats.transform.tile.settings import TileSettings

SHAPE = (1, 4, 32, 40)
SPEC = spec_of(("none", "9/7", "9/7", "9/7"), (0, 1, 3, 3), SHAPE)
SETTINGS = TileSettings(transform=SPEC, step=0.1, center=0.0, low=-100.0, high=100.0)

Values = npt.NDArray[np.float32]


def field(outside: str) -> tuple[Values, npt.NDArray[np.bool_]]:
    """A smooth field and the ball in which it counted; outside the ball are other values."""
    _, z, y, x = np.indices(SHAPE)
    values = (np.sin(0.2 * y + 0.1 * z) + np.cos(0.15 * x)).astype(np.float32)
    counted = (y - 16) ** 2 + (x - 20) ** 2 + 4 * z**2 < 150
    noise = np.random.default_rng(0).normal(0, 20, SHAPE).astype(np.float32)
    around = {
        "the same": values,
        "noise": noise,
        "far away": np.full(SHAPE, -99, np.float32),
        "rough": values + noise / 50,
    }[outside]
    return np.where(counted, values, around), counted


@pytest.mark.parametrize("outside", ["the same", "noise", "far away", "rough"])
@pytest.mark.parametrize("density", list(RATIOS))
def test_counted_values_stay_and_the_others_cost_less(outside: str, density: int) -> None:
    values, counted = field(outside)
    result = filled(
        values, counted, np.ones(SHAPE, bool), transform_for(SETTINGS, SHAPE), SETTINGS, density
    )
    np.testing.assert_array_equal(result[counted], values[counted])
    before, after = (len(encode_tile(target, SETTINGS).data) for target in (values, result))
    if outside == "the same":
        assert after <= before
    else:
        assert after < before / 1.5


def test_more_thresholds_find_a_better_filling() -> None:
    values, counted = field("rough")
    sizes = [
        len(encode_tile(values, SETTINGS, Coding(density=density), in_coreset=counted).data)
        for density in RATIOS
    ]
    assert sizes[-1] < sizes[0]


def test_missing_values_are_filled_as_well() -> None:
    values, counted = field("noise")
    holes = np.where(counted, values, np.nan)
    coded = encode_tile(holes, replace(SETTINGS, step=0.05), Coding(keep_missing=False))
    assert np.abs(coded.decoded - values)[counted].max() < 0.1
    assert np.isfinite(coded.decoded).all()
