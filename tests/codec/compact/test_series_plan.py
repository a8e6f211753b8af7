"""Recipes: JSON and back, and the coding of some layers as in the whole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fhash_codec.appending.series_plan import Filling, Recipe, code_layers
from fhash_codec.boxes import Box
from fhash_codec.compact.tiles import Blocks, Coding, code
from fhash_codec.compact.transform import usual_transform
from fhash_codec.features.features import Extent
from fhash_codec.progress import silent
from fhash_formats.container.record import Record
from fhash_formats.series import ArraySeries
from fhash_formats.support.threads import thread_pool
from fhash_formats.transform.tile_format import TileSettings

TILE = (2, 4, 4, 4)
SETTINGS = TileSettings(transform=usual_transform(TILE), step=0.1, center=0.5, low=0.0, high=1.0)
RECIPE = Recipe(tile=TILE, settings=SETTINGS, coding=Coding(error=0.05, rounds=2, density=4))
FILLED = replace(RECIPE, filling=Filling(settings=replace(SETTINGS, step=0.2), density=2))


def read(values) -> Recipe:
    return Recipe.from_dict(Record(values, "recipe."))


@pytest.mark.parametrize("recipe", [RECIPE, FILLED])
@pytest.mark.parametrize("layers", [range(0, 1), range(1, 3)])
def test_some_layers_have_the_bytes_of_the_whole(recipe, layers) -> None:
    values = np.random.default_rng(0).random((5, 4, 6, 8), dtype=np.float32)
    packed = [np.packbits(frame < 0.8) for frame in values]
    extent = Extent(
        box=Box.of_shape(values.shape[1:]),
        key_frames=tuple(range(5)),
        packed=packed,
        domain=values.shape[1:],
        samples=int((values < 0.8).sum()),
        background=0.0,
    )
    blocks = Blocks(ArraySeries(values), extent, TILE)
    with thread_pool() as workers:
        whole = code_layers(blocks, recipe, range(3), workers, silent)
        some = code_layers(blocks.by_layers(), recipe, layers, workers, silent)
    per_layer = len(whole.streams) // 3
    assert some.streams == whole.streams[layers.start * per_layer : layers.stop * per_layer]
    assert some.outcome.size == sum(map(len, some.streams))
    assert whole.outcome.max_error <= 0.05
    if recipe is RECIPE:
        tile = blocks.read((0, 0, 0, 0))
        assert code(tile, SETTINGS, RECIPE.coding)[0].data == whole.streams[0]
