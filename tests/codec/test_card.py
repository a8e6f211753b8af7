"""The parts of the model are those of the file, and make the values that `Volume` gives."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from untrained_heads import field, some_head, with_head

import fhash_codec
from fhash_codec import EncodeConfig, InputError, Volume
from fhash_codec.coreset.occupancy import morton_index, pack

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


@pytest.mark.parametrize("name", PAPER)
def test_the_paper_shows_the_arrays_of_its_file(name: str) -> None:
    with fhash_codec.open(GOLDEN / f"{name}.fhz") as volume:
        plain = arrays(volume)
        assert len(volume.tables) == len(volume.container.header["model"]["levels"])
        for table in volume.tables:
            path = f"tables/level_{table.level}"
            assert table.ndim == 5
            if name == "paper-transform":
                components = [plain[f"{path}/component_{n + 1}"] for n in range(table.shape[4])]
                mixed = sum(
                    values[..., None] * np.float32(attributes["mixing"])
                    for values, attributes in components
                )
                np.testing.assert_allclose(table[...], mixed, rtol=1e-6, atol=1e-6)
                continue
            numbers, attributes = plain[path]
            if numbers.dtype == np.uint8:
                scale, offset = (np.float32(attributes[key]) for key in ("scale", "offset"))
                numbers = numbers * scale + offset
            np.testing.assert_array_equal(table[...], numbers)
            assert table.dtype == numbers.dtype
        for number, (weights, biases) in enumerate(volume.mlp.layers, start=1):
            np.testing.assert_array_equal(weights, plain[f"mlp/weight_{number}"][0])
            np.testing.assert_array_equal(biases, plain[f"mlp/bias_{number}"][0])
        keys = volume.key_times.key_frames
        for key, step in enumerate(keys):
            bits = volume.occupancy_bits(step)
            if name != "paper-transform":  # its occupancy is coded
                grids = plain["occupancy/bits"][0][:, key]
                np.testing.assert_array_equal(bits, np.bitwise_or.reduce(grids))


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


def test_settings_are_complete(golden: Volume) -> None:
    names = EncodeConfig().to_dict().keys()
    assert golden.config.keys() >= names
    assert golden.config["profile"] == golden.profile
    stored = golden.container.header["config"]
    assert {name: golden.config[name] for name in stored} == stored
    assert golden.info["config"] == golden.config


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
