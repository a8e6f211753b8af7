"""Fill values for vertices that do not count: all are finite, and vertices that count stay."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from untrained_heads import some_head

from fhash_codec.compact import sample as sample_module
from fhash_codec.compact.sample import Sample, fill, strata
from fhash_codec.compact.tiles import Coding, Index, Tile
from fhash_codec.compact.transform import usual_transform
from fhash_formats.transform.encoding import OFFSETS
from fhash_formats.transform.tile_format import TileSettings

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


class Row:
    """A row of tiles; all values of a tile are its number."""

    complete, in_memory, tile = True, True, (1, 1, 10, 100)

    def __init__(self, tiles: int) -> None:
        self.tiles = tiles
        self.shape = (1, 1, 10 * tiles, 100)

    def indices(self) -> Iterator[Index]:
        return iter([(0, 0, number, 0) for number in range(self.tiles)])

    def weight(self, index: Index) -> int:
        return 1

    def read(self, index: Index) -> Tile:
        return Tile(np.full(self.tile, index[2], np.float32), None)


SETTINGS_SAMPLE = TileSettings(
    transform=usual_transform(Row.tile), step=1.0, center=0.0, low=0.0, high=16.0
)


def test_an_expensive_tile_stands_for_itself_and_a_cheap_one_for_many() -> None:
    """The sample must have the one tile in which everything happens, and count it once."""
    costs = [1.0] * 16
    costs[11] = 400.0
    with ThreadPoolExecutor(1) as workers:
        sample = Sample(Row(16), 4_000, workers, costs)
        numbers = [int(tile.values[0, 0, 0, 0]) for tile in sample.tiles]
        assert dict(zip(numbers, sample.weights, strict=True))[11] == 1
        assert sum(sample.weights) == 16
        assert sample.counted == 16_000
        assert sample.run(SETTINGS_SAMPLE, Coding()).count == 16_000


@pytest.mark.parametrize("max_tiles", [1, 3, 7, 40])
def test_strata_cover_all_tiles(max_tiles: int) -> None:
    costs = np.random.default_rng(max_tiles).gamma(0.3, 100.0, 40).tolist()
    chosen = strata(costs, max_tiles)
    assert len(chosen) <= max_tiles
    assert sum(weight for _, weight in chosen) == 40
    assert [tile for tile, _ in chosen] == sorted({tile for tile, _ in chosen})
    estimate = sum(costs[tile] * weight for tile, weight in chosen)
    assert max_tiles < 7 or abs(estimate / sum(costs) - 1) < 0.25
    assert [weight for _, weight in strata([0.0] * 40, 4)] == [10] * 4


@pytest.mark.parametrize("in_memory", [True, False])
def test_all_tiles_of_the_series_come_in_order(in_memory: bool) -> None:
    row = Row(40)
    row.in_memory = in_memory
    with ThreadPoolExecutor(3) as workers:
        sample = Sample(row, 4_000, workers)
        firsts = list(sample.map_all(lambda tile: int(tile.values.flat[0])))
    assert firsts == list(range(40))


def test_what_was_coded_before_is_not_coded_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Streams are taken as they are, and a head that joins is measured on them."""
    coded: list[TileSettings] = []
    original = sample_module.code

    def counted(tile: Tile, settings: TileSettings, coding: Coding) -> Any:
        coded.append(settings)
        return original(tile, settings, coding)

    monkeypatch.setattr(sample_module, "code", counted)
    settings = replace(SETTINGS_SAMPLE, high=4.0)
    headed = replace(settings, head=some_head())
    with ThreadPoolExecutor(1) as workers:
        sample, fresh = (Sample(Row(4), 4_000, workers) for _ in range(2))
        first = sample.run(settings, Coding())
        assert len(coded) == 4
        assert sample.run(replace(settings), Coding()) == first
        values = sample.decoded(settings, Coding())
        with_head = sample.run(headed, Coding())
        assert len(coded) == 4
        assert set(sample.coded(settings, Coding())) == set(sample.indices)
        assert sample.coded(replace(settings, step=2.0), Coding()) == {}
        assert fresh.run(headed, Coding()) == with_head
        for known, new in zip(values, fresh.decoded(settings, Coding()), strict=True):
            np.testing.assert_array_equal(known, new)
