"""The models of both profiles answer alike to what `Volume` asks."""

from __future__ import annotations

import inspect

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig, InputError
from fhash_codec.compact.model import CompactModel
from fhash_codec.coreset.boxes import Box
from fhash_codec.paper.model import PaperModel
from fhash_codec.volume_model import VolumeModel, open_model
from fhash_formats.container import Container

REGIONS = [
    Box.of_shape((5, 6, 7)),
    Box((1, 4), (2, 3), (0, 7)),
    Box((4, 5), (5, 6), (6, 7)),
]
SETTINGS = {
    "compact": {"effort": 1, "tile": "2x3x4x4"},
    "paper": {"profile": "paper", "epochs": 2, "width": 8, "key_frames": "0,1,3"},
    "coded": {"profile": "paper", "epochs": 2, "width": 8, "tables": "transform"},
}


@pytest.fixture(scope="module", params=SETTINGS)
def named_model(request, tmp_path_factory):
    """A model whose box is 5 x 6 x 7, with vertices outside the coreset."""
    field = np.random.default_rng(0).random((4, 7, 8, 9))
    field[:, [0, -1]], field[:, :, [0, -1]], field[..., [0, -1]] = -1, -1, -1
    path = tmp_path_factory.mktemp("model") / "a.fhz"
    fhash_codec.encode(
        field,
        path,
        EncodeConfig(features=("interval:0.2:1",), dilation=0, **SETTINGS[request.param]),
    )
    with Container.open(path) as container:
        yield request.param, open_model(container)


def test_each_profile_has_its_model(named_model) -> None:
    name, model = named_model
    assert isinstance(model, CompactModel if name == "compact" else PaperModel)
    assert tuple(model.chunks) == ((2, 3, 4, 4) if name == "compact" else (1, 7, 8, 9))
    for method, declared in inspect.getmembers(VolumeModel, inspect.isfunction):
        if not method.startswith("_"):
            assert len(inspect.signature(getattr(type(model), method)).parameters) == len(
                inspect.signature(declared).parameters
            )


@pytest.mark.parametrize("region", REGIONS, ids=str)
def test_regions_are_parts_of_the_whole(named_model, region) -> None:
    _, model = named_model
    inner = region.slices()
    for first, last in ((0, 0), (1, 2)):
        occupied = model.occupied(first, last, REGIONS[0])
        assert 0 < occupied.mean() < 1
        np.testing.assert_array_equal(model.occupied(first, last, region), occupied[inner])
        key = (first + last) / 2
        values = model.read(key, REGIONS[0], occupied)
        assert values.dtype == np.float64
        part = model.read(key, region, occupied[inner])
        np.testing.assert_array_equal(part[occupied[inner]], values[inner][occupied[inner]])


def test_points_at_vertices_are_the_region_and_slopes_have_the_same_values(named_model) -> None:
    _, model = named_model
    occupied = model.occupied(1, 1, REGIONS[0])
    places = np.argwhere(occupied).T.astype(np.float64)
    keys = np.ones(places.shape[1])
    values = model.sample(keys, list(places))
    np.testing.assert_allclose(values, model.read(1, REGIONS[0], occupied)[occupied], atol=1e-5)
    again, slopes = model.sample_with_gradient(keys, list(places))
    np.testing.assert_allclose(again, values, atol=1e-6)
    assert slopes.shape == (len(values), 4)
    assert slopes.dtype == np.float64


def test_levels_of_detail_are_given_or_refused(named_model) -> None:
    name, model = named_model
    if name == "compact":
        values = model.read_lod(1, 1, Box.of_shape((3, 3, 4)))
        np.testing.assert_array_equal(
            model.read_lod(1, 1, Box((1, 3), (2, 3), (0, 2))), values[1:3, 2:3, 0:2]
        )
    else:
        with pytest.raises(InputError, match="no levels of detail"):
            model.read_lod(1, 1, Box.of_shape((3, 3, 4)))
