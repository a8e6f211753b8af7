"""The parts of the model are those of the file, and make the values that `Volume` gives."""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import zarr
from untrained_heads import field, some_head, with_head

import fhash_codec
from fhash_codec import EncodeConfig, InputError, Volume
from fhash_codec.boxes import Box
from fhash_codec.compact.model import CompactModel
from fhash_codec.features.occupancy import morton_index, pack
from fhash_codec.paper.model import PaperModel
from fhash_codec.volume_model import VolumeModel, interpolable, open_model
from fhash_formats.container import Container

GOLDEN = Path(__file__).resolve().parents[1] / "golden"
PAPER = ["paper-feature", "paper-linear-uint8", "paper-transform"]
COMPACT = ["compact-psnr", "compact-mask", "compact-clip", "compact-labels"]


@pytest.fixture(params=[*PAPER, *COMPACT])
def golden(request: Any) -> Iterator[Volume]:
    with fhash_codec.open(GOLDEN / f"{request.param}.fhz") as volume:
        yield volume


def arrays(volume: Volume) -> dict[str, Any]:
    """Every array of a file as zarr reads it: (values, attributes)."""
    with zarr.storage.ZipStore(volume.path, mode="r") as store:
        members = zarr.open_group(store, mode="r").members(max_depth=None)
        names = {array.name: name for name, array in volume.container.arrays.items()}
        return {
            names[path]: (array[...], dict(array.attrs))
            for path, array in members
            if isinstance(array, zarr.Array)
        }


def test_bits_are_the_mask_in_ragged_morton_order(golden: Volume) -> None:
    step = 1
    mask = golden.container.arrays and golden._model.occupied(  # without missing values
        int(golden.key_times.key_index(step)),
        int(np.ceil(golden.key_times.key_index(step))),
        fhash_codec.volume.Box.of_shape(golden.box.shape),
    )
    bits = golden.occupancy_bits(step)
    assert bits.dtype == np.uint8
    np.testing.assert_array_equal(bits, pack(mask))
    z, y, x = np.indices(golden.box.shape)
    number = morton_index(z, y, x, golden.box.shape)
    np.testing.assert_array_equal(bits[number >> 3] >> (7 - (number & 7)) & 1, mask)


def test_points_have_the_values_of_sample(golden: Volume) -> None:
    points = np.array([[0, 1, 2, 3], [1.5, 2.25, 3, 4.5], [4, 0, 0, 0]], dtype=np.float64)
    t, z, y, x = points.T
    expected = golden.sample(t=t, z=z, y=y, x=x)
    np.testing.assert_array_equal(golden.model(points), expected)
    np.testing.assert_array_equal(golden.model(points[None]), expected[None])
    for shape in ((), (3,), (2, 3)):
        with pytest.raises(InputError, match="t, z, y and x"):
            golden.model(np.zeros(shape))


def test_a_lattice_is_the_table_and_its_low_passes(tmp_path: Path) -> None:
    values = field()
    config = EncodeConfig(effort=2, psnr=60.0, tile="2x9x15x14")
    fhash_codec.encode(values, tmp_path / "a.fhz", config)
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert volume.mlp.layers == ()
        assert volume.mlp.activation == ""
        shapes = [table.shape for table in volume.tables]
        assert shapes == [
            (2, 9, 30, 28, 1), (2, 5, 15, 14, 1), (2, 3, 8, 7, 1), (2, 2, 4, 4, 1), (2, 1, 2, 2, 1),
        ]  # fmt: skip
        np.testing.assert_array_equal(volume.tables[0][..., 0], volume[...])
        for lod, table in enumerate(volume.tables[1:], start=1):
            np.testing.assert_array_equal(table[1, ..., 0], volume.read_lod(1, lod))


def test_a_head_makes_the_values_of_the_table(tmp_path: Path) -> None:
    head = some_head()
    path = with_head(tmp_path / "a.fhz", head)
    with fhash_codec.open(path) as volume:
        mlp = volume.mlp
        assert mlp.activation == "leaky"
        assert mlp.constants == {"sigma": 0.125, "low": -1.5, "high": 1.25, "cross": 1}
        for layer, (weights, biases) in zip(head.layers, mlp.layers, strict=True):
            np.testing.assert_array_equal(weights, layer.weights * np.float64(layer.weight_scale))
            np.testing.assert_array_equal(biases, layer.biases * np.float64(layer.bias_scale))
            assert weights.dtype == biases.dtype == np.float32
        table = volume.tables[0][..., 0]
        assert not np.array_equal(table, volume[...])
        for start in (0, 15):  # two tiles along y: a head looks at its own tile
            tile = np.ascontiguousarray(table[:, :, start : start + 15])
            np.testing.assert_array_equal(head.apply(tile), volume[:, :, start : start + 15])


BOX = Box((1, 5), (0, 4), (2, 6))


def occupied_at(step: float, region: Box) -> npt.NDArray[np.bool_]:
    """A coreset that differs from step to step; between two steps a vertex must be in both."""
    steps = {math.floor(step), math.ceil(step)}
    masks = [np.random.default_rng(number).random((6, 6, 7)) < 0.9 for number in steps]
    return np.logical_and.reduce(masks)[region.slices()]


def test_a_point_needs_the_vertices_of_its_cell_that_have_weight() -> None:
    random = np.random.default_rng(5)
    steps = np.concatenate([random.integers(0, 3, 150), random.random(150) * 2])
    space = [np.round(2 * random.uniform(-0.5, 6.5, steps.size)) / 2 for _ in range(3)]
    inside = interpolable(BOX, steps, steps, space, occupied_at)
    expected = []
    for step, *point in zip(steps, *space, strict=True):
        in_box = all(first <= p <= end - 1 for p, (first, end) in zip(point, BOX, strict=True))
        corners = product(*({math.floor(p), math.ceil(p)} for p in point))
        expected.append(
            in_box
            and all(
                occupied_at(step, Box.of((vertex, vertex + 1) for vertex in corner)).all()
                for corner in corners
            )
        )
    assert 10 < sum(expected) < steps.size - 100
    np.testing.assert_array_equal(inside, expected)


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
