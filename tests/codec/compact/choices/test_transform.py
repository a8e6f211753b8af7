"""Choice of the transform by trial."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from fhash_codec.compact.choices.transform import (
    choose_transform,
    likely_transform,
    refit,
    usual_transform,
)
from fhash_codec.compact.tiles.blocks import Index, Tile
from fhash_codec.compact.tiles.coding import Coding
from fhash_codec.compact.tiles.sample import Sample
from fhash_formats.transform.tile.settings import TileSettings


class Hats:
    """One tile, linear between every second vertex of y and x: all details of 5/3 are 0."""

    shape = tile = (1, 1, 65, 65)
    in_memory = False

    def indices(self) -> Iterator[Index]:
        return iter([(0, 0, 0, 0)])

    def weight(self, index: Index) -> int:
        return 1

    def read(self, index: Index) -> Tile:
        values = np.zeros((65, 65))
        values[::2, ::2] = np.random.default_rng(0).normal(size=(33, 33))
        values[1::2, ::2] = (values[:-1:2, ::2] + values[2::2, ::2]) / 2
        values[:, 1::2] = (values[:, :-1:2] + values[:, 2::2]) / 2
        return Tile(values.astype(np.float32).reshape(self.tile), None)


def test_hats_are_transformed_by_5_3() -> None:
    settings = TileSettings(
        transform=usual_transform(Hats.tile), step=1e-3, center=0.0, low=-5.0, high=5.0
    )
    with ThreadPoolExecutor(1) as workers:
        sample = Sample(Hats(), 1 << 20, workers)
        chosen, _ = choose_transform(sample, settings, Coding())
    assert [axis.kind for axis in chosen.transform.axes] == ["none", "none", "5/3", "5/3"]
    # Without bases of the data's own there is nothing to fit.
    assert refit(sample, chosen) is chosen


class FewShapes:
    """One tile in which each line along x is a sum of two patterns that no wavelet has."""

    shape = tile = (1, 8, 24, 40)
    in_memory = True

    def indices(self) -> Iterator[Index]:
        return iter([(0, 0, 0, 0)])

    def weight(self, index: Index) -> int:
        return 1

    def read(self, index: Index) -> Tile:
        rng = np.random.default_rng(1)
        values = rng.normal(size=(8 * 24, 2)) @ rng.normal(size=(2, 40))
        return Tile(values.astype(np.float32).reshape(self.tile), None)


def test_few_patterns_get_a_basis_of_their_own() -> None:
    settings = TileSettings(
        transform=usual_transform(FewShapes.tile), step=0.01, center=0.0, low=-9.0, high=9.0
    )
    with ThreadPoolExecutor(1) as workers:
        sample = Sample(FewShapes(), 1 << 20, workers)
        chosen, cost = choose_transform(sample, settings, Coding())
        assert chosen.transform.axes[3].kind == "klt"
        usual = sample.run(settings, Coding())
        assert cost < usual.size
        assert refit(sample, chosen) is not chosen


def test_a_likely_transform_is_found_by_four_trials() -> None:
    hats = Hats()
    with ThreadPoolExecutor(1) as pool:
        sample = Sample(hats, 1 << 20, pool)  # type: ignore[arg-type]
        settings = TileSettings(
            transform=usual_transform(hats.shape), step=0.1, center=0.0, low=-4.0, high=4.0
        )
        # A series that is not in memory has no bases, and keeps the usual transform.
        assert likely_transform(sample, settings, Coding()) == settings


class MovingSpikes:
    """Spikes that jump in time and in space: no transform of time or z does any good."""

    shape = tile = (6, 12, 24, 24)
    in_memory = False

    def indices(self) -> Iterator[Index]:
        return iter([(0, 0, 0, 0)])

    def weight(self, index: Index) -> int:
        return 1

    def read(self, index: Index) -> Tile:
        values = np.random.default_rng(4).normal(size=self.tile)
        return Tile(np.where(np.abs(values) > 2.5, values, 0).astype(np.float32), None)


def test_time_is_looked_at_again_after_z() -> None:
    settings = TileSettings(
        transform=usual_transform(MovingSpikes.tile), step=0.5, center=0.0, low=-5.0, high=5.0
    )
    with ThreadPoolExecutor(1) as workers:
        sample = Sample(MovingSpikes(), 1 << 20, workers)
        chosen, _ = choose_transform(sample, settings, Coding())
    t, z, _, _ = chosen.transform.axes
    assert (t.kind, z.kind) == ("none", "none")
