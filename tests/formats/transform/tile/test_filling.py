"""What stands where values do not count: what counts is left alone, and the rest takes few bytes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from fhash_formats.transform.axes.spec import AxisTransform, TransformSpec
from fhash_formats.transform.tile.encoding import encode_tile, transform_for
from fhash_formats.transform.tile.filling import RATIOS, filled
from fhash_formats.transform.tile.settings import TileSettings

SHAPE = (1, 4, 32, 40)
NINE = AxisTransform(kind="9/7", depth=3)
SPEC = TransformSpec(
    axes=(AxisTransform(kind="none"), AxisTransform(kind="9/7", depth=1), NINE, NINE)
)
SETTINGS = TileSettings(transform=SPEC, step=0.1, center=0.0, low=-100.0, high=100.0)

Values = npt.NDArray[np.float32]


def field(outside: str) -> tuple[Values, npt.NDArray[np.bool_]]:
    """A smooth field that counts in a ball, and something else around it."""
    _, z, y, x = np.indices(SHAPE)
    values = (np.sin(0.2 * y + 0.1 * z) + np.cos(0.15 * x)).astype(np.float32)
    counts = (y - 16) ** 2 + (x - 20) ** 2 + 4 * z**2 < 150
    noise = np.random.default_rng(0).normal(0, 20, SHAPE).astype(np.float32)
    around = {
        "the same": values,
        "noise": noise,
        "far away": np.full(SHAPE, -99, np.float32),
        "rough": values + noise / 50,
    }[outside]
    return np.where(counts, values, around), counts


@pytest.mark.parametrize("outside", ["the same", "noise", "far away", "rough"])
@pytest.mark.parametrize("density", list(RATIOS))
def test_what_counts_stays_and_the_rest_costs_less(outside: str, density: int) -> None:
    values, counts = field(outside)
    found = filled(
        values, counts, np.ones(SHAPE, bool), transform_for(SETTINGS, SHAPE), SETTINGS, density
    )
    np.testing.assert_array_equal(found[counts], values[counts])
    before, after = (len(encode_tile(target, SETTINGS).data) for target in (values, found))
    if outside == "the same":
        assert after <= before
    else:
        assert after < before / 1.5


def test_more_thresholds_find_a_better_filling() -> None:
    values, counts = field("rough")
    sizes = [
        len(encode_tile(values, SETTINGS, care=counts, density=density).data) for density in RATIOS
    ]
    assert sizes[-1] < sizes[0]


def test_missing_values_are_filled_as_well() -> None:
    values, counts = field("noise")
    holes = np.where(counts, values, np.nan)
    coded = encode_tile(holes, replace(SETTINGS, step=0.05), keep_missing=False)
    assert np.abs(coded.decoded - values)[counts].max() < 0.1
    assert np.isfinite(coded.decoded).all()
