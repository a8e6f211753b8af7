"""The exchange of quality for bytes, from outcomes of trials."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fhash_codec.compact.goal import Goal
from fhash_codec.compact.step import (
    is_smaller,
    off_trellis,
    on_trellis,
    plain_step,
    with_step,
)
from fhash_codec.compact.tiles import Coding, Outcome
from fhash_codec.compact.transform import usual_transform
from fhash_formats.transform.encoding import OFFSETS, encode_tile
from fhash_formats.transform.encoding import Coding as Coding_step
from fhash_formats.transform.spec import AxisTransform, TransformSpec
from fhash_formats.transform.tile_format import TileSettings


def outcome(size: int, psnr: float) -> Outcome:
    return Outcome(size=size, squares=10 ** (-psnr / 10) * 100, count=100, max_error=1.0)


NONE = AxisTransform(kind="none")
SETTINGS = TileSettings(
    transform=TransformSpec(axes=(NONE,) * 4),
    step=0.1,
    center=0.0,
    low=0.0,
    high=1.0,
    offsets=OFFSETS,
)
GOAL = Goal(psnr=40.0, data_range=1.0)


def test_the_way_to_the_trellis_and_back() -> None:
    settings, coding = on_trellis(SETTINGS, Coding())
    assert settings.trellis
    assert settings.step < SETTINGS.step
    assert plain_step(settings) == pytest.approx(plain_step(SETTINGS))
    back, plain = off_trellis(settings, coding)
    assert replace(back, step=0.1) == SETTINGS
    assert plain == Coding()


def test_bytes_are_compared_at_the_same_quality() -> None:
    # One dB is worth a tenth of the bytes, by what was tried.
    tried = [outcome(1000, 40.0), outcome(1100, 41.0)]
    assert is_smaller(outcome(1000, 40.0), outcome(1010, 40.0), tried, GOAL)
    assert not is_smaller(outcome(1000, 40.0), outcome(990, 40.0), tried, GOAL)
    assert not is_smaller(outcome(1000, 40.0), outcome(1050, 41.0), tried, GOAL)
    assert is_smaller(outcome(1000, 40.0), outcome(1150, 41.0), tried, GOAL)
    bound = Goal(error=0.1, data_range=1.0)
    assert is_smaller(outcome(1000, 40.0), outcome(1050, 41.0), tried, bound)


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
        Coding_step(error=error),
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
