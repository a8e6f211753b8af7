"""Choice of the fill values by bytes."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from fhash_codec.compact.choices.fillings import choose_filling
from fhash_codec.compact.choices.transform import usual_transform
from fhash_codec.compact.goal import Goal
from fhash_codec.compact.tiles.blocks import Index, Tile
from fhash_codec.compact.tiles.coding import Coding
from fhash_codec.compact.tiles.sample import Sample
from fhash_formats.transform.tile.integers import OFFSETS
from fhash_formats.transform.tile.settings import TileSettings

SHAPE = (3, 12, 16, 20)
SETTINGS = TileSettings(
    transform=usual_transform(SHAPE), step=0.05, center=0.5, low=0.0, high=1.0, offsets=OFFSETS
)


class Grid:
    """Two tiles of noise in which a smooth half along z counts."""

    complete, in_memory, shape, tile = False, True, (3, 12, 32, 20), SHAPE
    dtype = np.dtype(np.float32)

    def indices(self) -> Iterator[Index]:
        return iter([(0, 0, number, 0) for number in range(2)])

    def weight(self, index: Index) -> int:
        return 1

    def read(self, index: Index) -> Tile:
        t, z, y, x = np.indices(SHAPE)
        noise = np.random.default_rng(index[2]).normal(size=SHAPE)
        smooth = 0.5 + 0.3 * np.sin(0.3 * x + 0.2 * t) * np.cos(0.2 * y)
        values = (smooth + 0.15 * noise * (z > 6)).clip(0, 1).astype(np.float32)
        return Tile(values, z <= 6)


def test_a_filling_takes_fewer_bytes_than_noise() -> None:
    with ThreadPoolExecutor(2) as workers:
        sample = Sample(Grid(), 10**7, workers)
        coding = Coding(filled=True, weight=0.09)
        plain = sample.run(SETTINGS, coding)
        filled = sample.filled(SETTINGS, 2).run(SETTINGS, coding)
        assert filled.size < 0.8 * plain.size
        assert filled.count == plain.count


def test_the_chosen_filling_is_no_larger_than_the_existing_values() -> None:
    with ThreadPoolExecutor(2) as workers:
        sample = Sample(Grid(), 10**7, workers)
        goal, coding = Goal(psnr=35.0, data_range=1.0), Coding(filled=True)
        chosen = choose_filling(sample, SETTINGS, coding, goal, 4)
        settings = replace(SETTINGS, step=0.06)
        assert chosen.run(settings, coding).size <= sample.run(settings, coding).size
