"""What stands where nothing counts: found once, raced by bytes, and never in the way of what counts."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

import fhash_codec
from fhash_codec.compact.choices import fillings as surroundings
from fhash_codec.compact.choices.transform import usual_transform
from fhash_codec.compact.goal import Goal
from fhash_codec.compact.tiles.coding import OFFSETS, Coding, total
from fhash_codec.compact.tiles.filling import fill
from fhash_codec.compact.tiles.sample import Sample
from fhash_formats.transform.tile.settings import TileSettings

SHAPE = (4, 12, 20, 24)
SETTINGS = TileSettings(
    transform=usual_transform(SHAPE), step=0.05, center=0.5, low=0.0, high=1.0, offsets=OFFSETS
)


def wave(dtype=np.float32):
    t, z, y, x = np.indices(SHAPE)
    noise = np.random.default_rng(3).normal(size=SHAPE)
    return (
        (0.5 + 0.3 * np.sin(0.3 * x + 0.2 * t) * np.cos(0.2 * y) + 0.15 * noise * (z > 6))
        .clip(0, 1)
        .astype(dtype)
    )


CARE = np.indices(SHAPE)[1] <= 6


class Grid:
    """Four tiles of which the first half along z counts."""

    complete, held, shape, tile = False, True, (4, 12, 80, 24), SHAPE
    dtype = np.dtype(np.float32)

    def indices(self):
        return iter([(0, 0, number, 0) for number in range(4)])

    def read(self, index):
        return wave() * np.float32(1 - 0.1 * index[2]), CARE


@pytest.mark.parametrize("density", [0, 1, 2])
@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.uint8])
def test_what_counts_stays_and_all_else_has_a_value(dtype, density):
    values = (wave(np.float64) * (200 if dtype == np.uint8 else 1)).astype(dtype)
    if dtype != np.uint8:
        values[:, 9, 3:6] = np.nan
        values[:, 2, 2, 2] = np.inf
    settings = (
        SETTINGS if dtype != np.uint8 else replace(SETTINGS, high=200.0, center=100.0, step=10.0)
    )
    found, counts = fill(values, CARE, settings, density)
    assert found.dtype == values.dtype
    assert np.isfinite(found).all()
    np.testing.assert_array_equal(counts, CARE & np.isfinite(values))
    np.testing.assert_array_equal(found[counts], values[counts])


def test_a_filling_takes_fewer_bytes_than_noise():
    with ThreadPoolExecutor(2) as workers:
        sample = Sample(Grid(), 10**7, workers)
        coding = Coding(filled=True, weight=0.09)
        plain, filled = (one.run(SETTINGS, coding) for one in (sample, sample.filled(SETTINGS, 2)))
        assert filled.size < 0.8 * plain.size
        assert filled.count == plain.count
        # Whatever stood there before, the next filling begins with the source.
        again = sample.filled(SETTINGS, 1).filled(SETTINGS, 2)
        for (one, _), (other, _) in zip(again.tiles, sample.filled(SETTINGS, 2).tiles, strict=True):
            np.testing.assert_array_equal(one, other)


def test_all_trials_at_once_are_what_each_gives_alone():
    with ThreadPoolExecutor(3) as workers:
        sample = Sample(Grid(), 10**7, workers)
        trials = [(replace(SETTINGS, step=step), Coding(filled=True)) for step in (0.02, 0.1)]
        assert sample.run_all(trials) == [sample.run(*trial) for trial in trials]
        assert sample.run_all([]) == []
        assert total([]).size == 0


def test_the_race_is_never_lost_to_the_values_that_are_there():
    with ThreadPoolExecutor(2) as workers:
        sample = Sample(Grid(), 10**7, workers)
        goal, coding = Goal(psnr=35.0, data_range=1.0), Coding(filled=True)
        won = surroundings.race(sample, SETTINGS, coding, goal, 4)
        settings = replace(SETTINGS, step=0.06)
        assert won.run(settings, coding).size <= sample.run(settings, coding).size


def test_a_feature_of_whole_numbers_keeps_its_bound(tmp_path):
    values = np.round(wave(np.float64) * 200).astype(np.uint8)
    feature = "interval:150:255"
    fhash_codec.encode(
        values,
        tmp_path / "a.fhz",
        fhash_codec.EncodeConfig(max_error=3.0, features=(feature,), effort=4),
    )
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        inside = volume.occupancy(1)
        assert inside[values[1] >= 150].all()
        assert np.abs(volume.read(1)[inside] - values[1][inside].astype(float)).max() <= 3
