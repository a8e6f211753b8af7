"""The quantiser step, and the residual quantum that goes with it."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.compact.choices.step import with_step
from fhash_codec.compact.choices.transform import usual_transform
from fhash_codec.compact.goal import Goal
from fhash_formats.transform.tile.encoding import Coding, encode_tile
from fhash_formats.transform.tile.settings import TileSettings

SHAPE = (2, 16, 32, 32)


@pytest.mark.parametrize(("rounding", "exact"), [(2.0**-24, False), (0.0, True)])
def test_rounding_to_the_type_of_the_source_stores_no_tile_exactly(
    rounding: float, exact: bool
) -> None:
    """A float32 near 1000 is 3e-5 off at most: a residual must leave room for that."""
    source = (1000 + np.random.default_rng(0).normal(size=SHAPE).cumsum(axis=3)).astype(np.float32)
    low, high, error = float(source.min()), float(source.max()), 0.002
    begun = TileSettings(
        transform=usual_transform(SHAPE), step=1.0, center=1000.0, low=low, high=high
    )
    coded = encode_tile(
        source,
        with_step(begun, 4 * error, Goal(error=error, data_range=high - low), rounding),
        Coding(error=error),
    )
    assert np.abs(coded.decoded.astype(np.float64) - source).max() <= error
    assert np.array_equal(coded.decoded, source) == exact


@pytest.mark.parametrize(("step", "double"), [(1e-3, False), (1e-7, True), (0.0, True)])
def test_a_fine_step_is_computed_in_float64_and_never_too_fine(step: float, double: bool) -> None:
    settings = TileSettings(
        transform=usual_transform(SHAPE), step=1.0, center=0.0, low=-1.0, high=1.0
    )
    chosen = with_step(settings, step, Goal(psnr=50.0, data_range=2.0))
    assert chosen.double == double
    assert chosen.quantum == 0.0
    assert chosen.step >= step
    assert 2.0 / chosen.step < 2.0**30
