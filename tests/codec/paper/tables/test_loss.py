"""The samples of the coreset, tile by tile, and the errors of a network on them."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.coreset.occupancy import unpack
from fhash_codec.paper.points import decode_region
from fhash_codec.paper.tables.loss import Samples
from fhash_codec.paper.tables.tiles import tile_shape


@pytest.fixture(scope="module")
def samples(random_model) -> Samples:
    selection = random_model.selection
    tile = (2, *tile_shape(selection.architecture.levels[0])[1:3], 8)
    return Samples(selection.coreset, random_model.bricks, tile)


def test_errors_are_those_of_the_clipped_values_at_all_samples(random_model, samples) -> None:
    network = random_model.network()
    squares, count = samples.squares(network, list(samples.counts))
    box = tuple((0, n) for n in network.box_size)
    coreset = random_model.selection.coreset
    masks = [unpack(coreset.occupancy[key], network.box_size) for key in range(5)]
    # Samples of the fringe do not count: the promise is about the coreset.
    assert coreset.values.size > count == sum(int(mask.sum()) for mask in masks)
    assert sum(samples.counts.values()) == count
    direct = 0.0
    for key, mask in enumerate(masks):
        unit = np.clip(decode_region(network, key, box).astype(np.float64), 0, 1)
        error = unit - random_model.bricks.samples(key, box)
        direct += float((error[mask] ** 2).sum())
    assert squares == pytest.approx(direct)


def test_chosen_tiles_hold_about_the_samples_asked_for(samples) -> None:
    count = sum(samples.counts.values())
    for asked in (0, count // 3, count):
        tiles = samples.choose(asked)
        assert tiles == sorted(tiles)
        held = sum(samples.counts[index] for index in tiles)
        assert 0 < held <= max(asked, max(samples.counts.values()))
    assert tiles == list(samples.counts)


def test_slopes_are_taken_at_samples_of_the_tiles(random_model, samples) -> None:
    tiles = list(samples.counts)
    slopes = samples.slopes(random_model.network(), tiles)
    assert slopes.shape[0] == random_model.selection.architecture.inputs
    assert 0 < slopes.shape[1] <= sum(samples.counts.values())
    assert np.isfinite(slopes).all()
    assert slopes.any()
