"""Searches of the compact profile: secants, exchange rates, the cheapest step; and what a head does under a strict bound."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.compact.choices.search import cheapest, exchange, secant
from fhash_codec.compact.choices.step import with_step
from fhash_codec.compact.choices.transform import choose_transform, usual_transform
from fhash_codec.compact.goal import Goal
from fhash_codec.compact.tiles.coding import Coding
from fhash_codec.compact.tiles.sample import Sample, strata
from fhash_codec.compact.tiles.tiling import tile_for
from fhash_formats.transform.tile import encoding
from fhash_formats.transform.tile.encoding import encode_tile
from fhash_formats.transform.tile.settings import TileSettings


def test_a_single_point_takes_the_usual_slope():
    assert secant([(1.0, 40.0)], 42.0, 5.0) == pytest.approx(1.0 - 2.0 / 5.0)


def test_two_points_take_their_own_slope_within_reason():
    assert secant([(0.0, 50.0), (1.0, 44.0)], 41.0, 5.0) == pytest.approx(1.5)
    assert secant([(0.0, 44.1), (1.0, 44.0)], 42.0, 5.0) == pytest.approx(1.0 + 2.0 / 2.0)
    assert secant([(0.0, 90.0), (1.0, 44.0)], 32.0, 5.0) == pytest.approx(2.0)
    assert secant([(1.0, 44.0), (1.0, 44.0)], 42.0, 5.0) == pytest.approx(1.0 + 2.0 / 5.0)


def test_an_exchange_rate_is_that_of_the_last_points_that_say_something():
    points = [(10.0, 40.0), (11.0, 42.3), (11.0, 42.31)]
    assert exchange(points, 4.5) == pytest.approx(2.3)
    assert exchange(points[:1], 4.5) == exchange([], 4.5) == 4.5
    # More bytes and less quality: no rate.
    assert exchange([(10.0, 40.0), (11.0, 39.0)], 4.5) == 4.5


@pytest.mark.parametrize("start", [0, 3, 9, 12])
@pytest.mark.parametrize("lowest", [0, 5, 7, 12])
def test_the_cheapest_is_found_from_everywhere(start, lowest):
    asked = []

    def run(numbers):
        asked.extend(numbers)
        return [(float((number - lowest) ** 2), f"at {number}") for number in numbers]

    assert cheapest(run, start, 12, strides=(2, 1)) == f"at {lowest}"
    assert len(asked) == len(set(asked))
    assert all(0 <= number <= 12 for number in asked)


def test_what_cannot_be_run_is_walked_around():
    def run(numbers):
        return [(float(number), number) if number > 2 else None for number in numbers]

    assert cheapest(run, 7, 12, strides=(2, 1)) == 3


class Eight:
    """Eight tiles that know their number."""

    shape, tile = (1, 1, 800, 10000), (1, 1, 100, 10000)

    def indices(self):
        return iter([(0, 0, number, 0) for number in range(8)])

    def read(self, index):
        return np.full(self.tile, index[2], np.float32), None


class Sixteen(Eight):
    shape = (1, 1, 1600, 10000)

    def indices(self):
        return iter([(0, 0, number, 0) for number in range(16)])


def test_a_wider_sample_has_more_tiles_of_the_same_series():
    with ThreadPoolExecutor(1) as workers:
        narrow = Sample(Sixteen(), 4_000_000, workers)
        wide = narrow.wider(8_000_000)
        assert (len(narrow.tiles), narrow.weights, len(wide.tiles), wide.weights) == (
            4,
            [4] * 4,
            8,
            [2] * 8,
        )
        whole = Sample(Eight(), 8_000_000, workers)
        assert whole.complete
        assert whole.wider(16_000_000) is whole


def test_a_dear_tile_stands_for_itself_and_a_cheap_one_for_many():
    """One tile in which everything happens among fifteen plain ones: the sample must have it, and count it once."""
    costs = [1.0] * 16
    costs[11] = 400.0
    with ThreadPoolExecutor(1) as workers:
        sample = Sample(Sixteen(), 4_000_000, workers, costs)
        numbers = [int(values[0, 0, 0, 0]) for values, _ in sample.tiles]
        assert dict(zip(numbers, sample.weights, strict=True))[11] == 1
        assert sum(sample.weights) == 16
        assert sample.counted == 16_000_000
        assert (
            sample.run(
                TileSettings(
                    transform=usual_transform(Eight.tile), step=1.0, center=0.0, low=0.0, high=16.0
                ),
                Coding(),
            ).count
            == 16_000_000
        )


@pytest.mark.parametrize("number", [1, 3, 7, 40])
def test_strata_cover_all_tiles(number):
    costs = np.random.default_rng(number).gamma(0.3, 100.0, 40).tolist()
    chosen = strata(costs, number)
    assert len(chosen) <= number
    assert sum(weight for _, weight in chosen) == 40
    assert [tile for tile, _ in chosen] == sorted({tile for tile, _ in chosen})
    guessed = sum(costs[tile] * weight for tile, weight in chosen)
    assert number < 7 or abs(guessed / sum(costs) - 1) < 0.25
    assert [weight for _, weight in strata([0.0] * 40, 4)] == [10] * 4


class Hats(Eight):
    """One tile, linear between every second vertex of y and x: the details of 5/3 are nothing but 0."""

    shape = tile = (1, 1, 65, 65)
    held = False

    def indices(self):
        return iter([(0, 0, 0, 0)])

    def read(self, index):
        values = np.zeros((65, 65))
        values[::2, ::2] = np.random.default_rng(0).normal(size=(33, 33))
        values[1::2, ::2] = (values[:-1:2, ::2] + values[2::2, ::2]) / 2
        values[:, 1::2] = (values[:, :-1:2] + values[:, 2::2]) / 2
        return values.astype(np.float32).reshape(self.tile), None


def test_hats_are_transformed_by_5_3():
    settings = TileSettings(
        transform=usual_transform(Hats.tile), step=1e-3, center=0.0, low=-5.0, high=5.0
    )
    with ThreadPoolExecutor(1) as workers:
        chosen, _ = choose_transform(Sample(Hats(), 1 << 20, workers), settings, Coding())
    assert [axis.kind for axis in chosen.transform.axes] == ["none", "none", "5/3", "5/3"]


def fronts() -> np.ndarray:
    """Two plateaus with a travelling, slanted and curved border: what a wavelet smears and a head sharpens."""
    t, z, y, x = np.meshgrid(
        np.arange(8), np.arange(24), np.arange(48), np.arange(48), indexing="ij"
    )
    distance = x + 0.6 * y - 2 * t + 4 * np.sin(z / 5 + t / 4) - 30
    return (1 / (1 + np.exp(-2 * distance))).astype(np.float32)


def test_under_a_bound_a_head_makes_files_smaller_and_the_bound_is_kept(tmp_path, monkeypatch):
    # Prediction would be smaller still.
    monkeypatch.setattr(
        "fhash_codec.compact.choices.predictor.race",
        lambda sample, settings, size, **_: (settings, size),
    )
    source, sizes = fronts(), {}
    for effort in (4, 5):
        figures = fhash_codec.encode(
            source, tmp_path / "a.fhz", EncodeConfig(effort=effort, max_error=0.01), force=True
        )
        with fhash_codec.open(tmp_path / "a.fhz") as volume:
            assert np.abs(volume[...].astype(np.float64) - source).max() <= 0.01
            assert (volume.info["model"]["head"] is not None) == (effort == 5)
        sizes[effort] = figures["bytes"]
    assert sizes[5] < 0.97 * sizes[4]


@pytest.mark.parametrize(("rounding", "exact"), [(2.0**-24, False), (0.0, True)])
def test_rounding_to_the_type_of_the_source_stores_no_tile_exactly(rounding, exact):
    """A float32 near 1000 is 3e-5 off at most: a residual of nearly twice the bound must leave room for that."""
    source = (1000 + np.random.default_rng(0).normal(size=(2, 16, 32, 32)).cumsum(axis=3)).astype(
        np.float32
    )
    low, high, error = float(source.min()), float(source.max()), 0.002
    begun = TileSettings(
        transform=usual_transform(source.shape), step=1.0, center=1000.0, low=low, high=high
    )
    coded = encode_tile(
        source,
        with_step(begun, 4 * error, Goal(error=error, data_range=high - low), rounding),
        encoding.Coding(error=error),
    )
    assert np.abs(coded.decoded.astype(np.float64) - source).max() <= error
    assert np.array_equal(coded.decoded, source) == exact


@pytest.mark.parametrize("shape", [(64, 128, 256, 256), (1, 512, 512, 512), (500, 3, 100, 400)])
def test_tiles_of_a_large_series_stay_small_however_few_bytes_it_takes(shape):
    """Some tiles are in memory at a time: a file of a few kB must not ask for gigabytes."""
    assert np.prod(tile_for(shape, 1000.0)) <= 4 << 20


def test_tiles_hang_little_over_the_border():
    for shape in ((10, 64, 64, 64), (12, 25, 125, 125), (33, 64, 64, 64)):
        tile = tile_for(shape, 1e6)
        covered = np.prod([-(-n // length) * length for n, length in zip(shape, tile, strict=True)])
        assert covered <= 1.04 * np.prod(shape)
