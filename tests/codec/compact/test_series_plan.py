"""Recipes: JSON and back, and the coding of some layers as in the whole."""

from __future__ import annotations

import json
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
from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.series import ArraySeries
from fhash_formats.support.threads import thread_pool
from fhash_formats.transform.spec import AxisTransform, TransformSpec, fit_basis
from fhash_formats.transform.tile_format import TileSettings

TILE = (2, 4, 4, 4)
SETTINGS = TileSettings(transform=usual_transform(TILE), step=0.1, center=0.5, low=0.0, high=1.0)
RECIPE = Recipe(tile=TILE, settings=SETTINGS, coding=Coding(error=0.05, rounds=2, density=4))
FILLED = replace(RECIPE, filling=Filling(settings=replace(SETTINGS, step=0.2), density=2))


def read(values) -> Recipe:
    return Recipe.from_dict(Record(values, "recipe."))


@pytest.mark.parametrize("recipe", [RECIPE, FILLED])
def test_a_recipe_comes_back_from_json(recipe) -> None:
    assert read(json.loads(json.dumps(recipe.to_dict()))) == recipe


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("tile", [2, 4, 4]),
        ("tile", [2, 4, 4, 0]),
        ("settings", []),
        ("settings", {"step": 1}),
        ("coding", {}),
        ("coding", {**vars(Coding()), "filled": 1}),
        ("coding", {**vars(Coding()), "rounds": -1}),
        ("coding", {**vars(Coding()), "density": 3}),
        ("coding", {**vars(Coding()), "density": 0}),
        ("coding", {**vars(Coding()), "error": "a"}),
        ("coding", {**vars(Coding()), "error": -1.0}),
        ("filling", {"settings": {}, "density": 1}),
        ("filling", 3),
    ],
)
def test_other_values_are_refused(key, value) -> None:
    with pytest.raises((DamagedFileError, InputError)):
        read({**FILLED.to_dict(), key: value})


def test_a_basis_of_another_length_is_refused() -> None:
    basis = fit_basis(np.eye(4) + 0.1, 0.1)
    t, z, _, x = SETTINGS.transform.axes
    axes = (t, z, AxisTransform(kind="klt", basis=basis), x)
    own = replace(RECIPE, settings=replace(SETTINGS, transform=TransformSpec(axes=axes)))
    assert read(own.to_dict()).to_dict() == own.to_dict()
    with pytest.raises(InputError, match="the basis along y is for 4 vertices, the tile has 5"):
        read({**own.to_dict(), "tile": [2, 4, 5, 4]})


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
