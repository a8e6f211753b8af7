"""The fringe in the finest table: rounded alone, and to a step that follows from its numbers."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.coreset.bricks import Coreset, build_coreset
from fhash_codec.coreset.features import Interval
from fhash_codec.coreset.occupancy import unpack
from fhash_codec.coreset.scan import scan
from fhash_codec.paper.fringe import fringe_step, round_fringe
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries


def coreset_of(fringe: bool) -> Coreset:
    """A plane that moves through the box from one key frame to the next."""
    values = np.zeros((3, 6, 5, 7), np.float32)
    for step in range(3):
        values[step, 2 * step : 2 * step + 2] = 1.0
    series = ArraySeries(values)
    scanned = scan(series, silent)
    return build_coreset(series, scanned, range(3), [Interval(0.5, 2.0)], 0, silent, fringe=fringe)


@pytest.fixture
def coreset() -> Coreset:
    return coreset_of(fringe=True)


def finest(scale: float = 1.0):
    frames = np.random.default_rng(0).standard_normal((3, 6, 5, 7, 2)).astype(np.float32)
    frames[0, 4:] = 0.0  # in no coreset beside this key frame: no samples
    frames[2, :2] = 0.0
    return lambda key: frames[key] * np.float32(scale)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1.7, 300.0])
def test_only_the_fringe_is_rounded_and_by_half_a_step_at_most(coreset, scale) -> None:
    table = finest(scale)
    step = fringe_step(coreset, 3, table)
    for key in range(3):
        rounded = round_fringe(coreset, key, table(key), step)
        inside = unpack(coreset.occupancy[key], coreset.box.shape)
        np.testing.assert_array_equal(rounded[inside], table(key)[inside])
        assert np.abs(rounded - table(key)).max() <= step / 2
        assert not np.array_equal(rounded, table(key))
        multiples = rounded[~inside] / step
        np.testing.assert_array_equal(multiples, np.rint(multiples))
        assert not np.signbit(rounded[~inside][rounded[~inside] == 0]).any()


def test_the_step_is_a_power_of_two_below_half_of_the_root_mean_square(coreset) -> None:
    table = finest()
    outside = np.concatenate(
        [table(key)[~unpack(coreset.occupancy[key], coreset.box.shape)].ravel() for key in range(3)]
    )
    root = np.sqrt(np.mean(outside[outside != 0].astype(float) ** 2))
    step = fringe_step(coreset, 3, table)
    assert np.log2(step) == np.floor(np.log2(step))
    assert step <= root / 2 < 2 * step


def test_without_a_fringe_nothing_is_rounded(coreset) -> None:
    assert fringe_step(coreset, 3, lambda key: np.zeros((6, 5, 7, 2), np.float32)) is None
    table = finest()
    np.testing.assert_array_equal(round_fringe(coreset, 0, table(0), None), table(0))
