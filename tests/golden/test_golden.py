"""Golden containers decode to the values beside them."""

from __future__ import annotations

import hashlib
import json
import warnings
from math import prod
from pathlib import Path

import numpy as np
import pytest
import xarray
import zarr
from reference import rounding
from zarr.storage import ZipStore

import fhash_codec
from fhash_codec.header import history_line
from fhash_formats.container.reader import Container
from fhash_formats.transform.tile_format import (
    BLOCKS,
    DIFFERENCES,
    LABELS,
    PREDICTED,
    TRANSFORMED,
    parse_stream,
)

HERE = Path(__file__).parent
COMPACT = [
    "compact-blocks",
    "compact-bound",
    "compact-mask",
    "compact-predictor",
    "compact-psnr",
    "compact-fast",
    "compact-fast-bound",
    "compact-classes",
    "compact-clip",
    "compact-counts",
    "compact-labels",
    "compact-head",
    "compact-many-labels",
    "compact-one-tile",
    "compact-plain-bound",
    "compact-plain-head",
    "compact-plain-labels",
    "compact-linear",
    "compact-signs",
    "compact-trellis",
    "compact-source",
    "compact-axes",
    "compact-named",
    "compact-origin",
    "compact-cubic",
    "compact-plain-cubic",
]
NAMES = [
    "paper-plain",
    "paper-feature",
    "paper-linear-uint8",
    "paper-transform",
    "paper-coded-occupancy",
    "paper-features",
    "paper-plain-coded",
    "paper-sparse",
    "paper-sparse-untrained",
    *COMPACT,
]
SEVERAL = {
    "compact-variables": ["u", "v", "surface/rain rate", "basin", "tracer"],
    "compact-curvilinear": ["u", "v"],
}
"""Variables of the goldens of several."""
APPENDED = ["compact-grown", "compact-part-1", "compact-part-2"]
"""A file that grew, and the two parts of a series."""


@pytest.mark.parametrize("name", NAMES)
def test_golden_containers_decode_to_their_values(name: str) -> None:
    with (
        np.load(HERE / f"{name}.npz") as expected,
        fhash_codec.open(HERE / f"{name}.fhz") as volume,
    ):
        tolerance = rounding(volume)
        np.testing.assert_allclose(volume[...], expected["whole"], atol=tolerance, rtol=0)
        if volume.dtype.kind in "iu":  # as floats, neighbouring integers beyond 2^53 are equal
            assert (volume[...] == expected["whole"]).all()
        between = np.stack([volume.read(t) for t in (0.5, volume.shape[0] - 1.25)])
        np.testing.assert_allclose(between, expected["between"], atol=tolerance, rtol=0)
        assert (volume.name, volume.units) == ("density", "kg m-3")
        assert volume.step_of_time(2.25) == 3
        volume.verify()


@pytest.mark.parametrize("name", COMPACT)
def test_compact_goldens_decode_to_the_same_bits(name: str) -> None:
    with (
        np.load(HERE / f"{name}.npz") as expected,
        fhash_codec.open(HERE / f"{name}.fhz") as volume,
    ):
        np.testing.assert_array_equal(volume[...], expected["whole"])


@pytest.mark.parametrize(
    ("name", "variable"),
    [
        *((name, variable) for name, variables in SEVERAL.items() for variable in variables),
        *((name, None) for name in APPENDED),
    ],
)
def test_variables_files_that_grew_and_parts_decode_to_their_values(
    name: str, variable: str | None
) -> None:
    start = f"{variable}:" if variable else ""
    with (
        np.load(HERE / f"{name}.npz") as expected,
        fhash_codec.open(HERE / f"{name}.fhz", variable=variable) as volume,
    ):
        same = {"atol": rounding(volume), "rtol": 0}
        whole, between = volume[...], [volume.read(t) for t in (0.5, volume.shape[0] - 1.25)]
        np.testing.assert_allclose(np.stack(between), expected[f"{start}between"], **same)
        if volume.profile == "compact":
            np.testing.assert_array_equal(whole, expected[f"{start}whole"])
        np.testing.assert_allclose(whole, expected[f"{start}whole"], **same)


@pytest.mark.parametrize(
    ("name", "preset"),
    [("paper-plain", "published"), ("compact-fast", "fast"), ("compact-psnr", "default")],
)
def test_settings_of_goldens_say_the_preset(name: str, preset: str) -> None:
    with fhash_codec.open(HERE / f"{name}.fhz") as volume:
        settings = {name: value for name, value in volume.config.items() if name != "engine"}
        assert fhash_codec.EncodeConfig.from_dict(settings).preset == preset  # "engine" is gone
        assert (f" --preset {preset}" in history_line(volume.container.header)) == (
            preset != "default"
        )


@pytest.mark.parametrize("name", SEVERAL)
def test_a_golden_of_several_variables_has_them_in_order(name: str) -> None:
    with fhash_codec.open(HERE / f"{name}.fhz") as dataset:
        assert list(dataset) == SEVERAL[name]
        dataset.verify()
        shown = {dataset[variable].name: dataset[variable][...] for variable in dataset}
    with xarray.open_dataset(HERE / f"{name}.fhz", engine="fhash", mask_and_scale=False) as opened:
        assert set(opened.data_vars) >= set(shown)
        for variable, values in shown.items():
            np.testing.assert_array_equal(opened[variable].values.reshape(values.shape), values)


def test_variables_of_a_golden_share_coordinates_of_two_dimensions() -> None:
    y, x = np.meshgrid(np.arange(18.0), np.arange(20.0), indexing="ij")
    with fhash_codec.open(HERE / "compact-curvilinear.fhz") as dataset:
        for volume in dataset.values():
            found = {each.name: each for each in volume.metadata.variables}
            np.testing.assert_array_equal(found["lat"].values, 50 + y + x * y / 99)
            assert found["lon"].values.dtype == np.float32
            assert found["lon"].attributes == {"units": "degrees_east"}
            assert volume.metadata.variable_attributes["grid_mapping"] == "crs"


def test_goldens_have_tiles_of_every_coder() -> None:
    found = set()
    for path in HERE.glob("compact-*.fhz"):
        with Container.open(path) as container:
            for array in container.arrays.values():
                if array.coding == "fhash.transform":
                    streams = (array.coded(index) for index in np.ndindex(*array.grid))
                    found |= {(s.kind, s.fast) for s in map(parse_stream, map(bytes, streams))}
    plain = {(kind, False) for kind in (TRANSFORMED, PREDICTED, LABELS, DIFFERENCES, BLOCKS)}
    assert found >= {*plain, (TRANSFORMED, True)}


def test_a_golden_that_grew_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "run.fhz"
    path.write_bytes((HERE / "compact-grown.fhz").read_bytes())
    with fhash_codec.open(path) as volume:
        before = volume[...]
    with fhash_codec.Writer.resume(path, steps=6) as writer:
        writer.append(before[6])
    with fhash_codec.open(path) as volume:
        np.testing.assert_array_equal(volume[:6], before[:6])
        np.testing.assert_allclose(volume[6], before[6], atol=0.02)
        assert (volume.name, volume.units, volume.shape) == ("density", "kg m-3", before.shape)


def test_golden_parts_become_one_file(tmp_path: Path) -> None:
    paths = [HERE / f"compact-part-{number}.fhz" for number in (2, 1)]
    fhash_codec.merge(paths, tmp_path / "whole.fhz")
    parts = [np.load(path.with_suffix(".npz"))["whole"] for path in reversed(paths)]
    with fhash_codec.open(tmp_path / "whole.fhz") as volume:
        np.testing.assert_array_equal(volume[...], np.concatenate(parts))
        assert volume.coords["t"].values.tolist() == [0.0, 0.5, 2.0, 2.25, 9.0]
        # A power is within 1 ulp of the true one, on the machine that wrote it and on this one.
        numbers = volume.metadata.variables[0].values
        np.testing.assert_array_max_ulp(numbers, np.arange(300.0) ** 1.5, maxulp=2)
        volume.verify()


def test_the_source_of_a_golden_comes_back() -> None:
    with fhash_codec.open(HERE / "compact-source.fhz") as volume:
        metadata = volume.metadata
    assert list(metadata.dimensions.items()) == [
        ("lon", "x"),
        ("time", "t"),
        ("member", ""),
        ("y", "y"),
        ("lev", "z"),
    ]
    found = {each.name: each for each in metadata.variables}
    assert list(found) == ["time", "y", "time_bnds", "member", "wide", "code", "crs"]
    assert found["time"].values.tolist() == [0, 0.5, 2, 2.25, 9]
    assert found["time"].attributes["bounds"] == "time_bnds"
    assert (found["y"].values.dtype, found["y"].values[6]) == (np.int32, 6)
    assert found["time_bnds"].values[1].tolist() == [0, 1]
    assert found["member"].values.tolist() == ["contrôle"]
    # float32 powers, within 1 ulp of the true ones: 301 ** 3 is no float32
    cubes = np.array([number**3 for number in range(2, 302)]).astype(np.float32)
    np.testing.assert_array_max_ulp(found["wide"].values, cubes, maxulp=1)
    assert found["code"].values == b"a\xff"
    assert np.isnan(found["crs"].values)
    assert [each for each in found if found[each].is_coordinate] == ["time", "member"]
    assert metadata.variable_attributes["level"] == np.int16(3)
    assert metadata.attributes["range"].dtype == np.float32
    assert metadata.attributes["range"].tolist() == [np.float32(0.1), np.inf]
    assert metadata.attributes["history"].endswith("encode golden.nc --psnr 50.0 --effort 1")
    assert (metadata.stored, metadata.file, metadata.digest) == ("int16", "golden.nc", "0123")


def test_no_golden_is_left_untested_and_none_has_changed() -> None:
    names = [*NAMES, *SEVERAL, *APPENDED]
    assert sorted(path.stem for path in HERE.glob("*.fhz")) == sorted(names)
    for name, digests in json.loads((HERE / "frozen.json").read_text()).items():
        for kind, digest in digests.items():
            content = (HERE / f"{name}.{kind}").read_bytes()
            assert hashlib.sha256(content).hexdigest() == digest, f"{name}.{kind} is frozen"
        names.remove(name)
    assert not names, "make.py freezes what it writes"


@pytest.mark.parametrize("name", NAMES)
def test_any_zarr_reader_lists_them_and_reads_what_is_no_tile(name: str) -> None:
    with warnings.catch_warnings(), fhash_codec.open(HERE / f"{name}.fhz") as volume:
        warnings.simplefilter("error")
        group = zarr.open_group(ZipStore(HERE / f"{name}.fhz", mode="r"), mode="r", zarr_format=3)
        assert group.attrs["fhash"]["format"] == "fhash"
        listed = {path: node for path, node in group.members(None) if isinstance(node, zarr.Array)}
        assert set(listed) == set(volume.container.arrays)
        for path, array in volume.container.arrays.items():
            if array.together is None:
                np.testing.assert_array_equal(listed[path][...], array.read())
                continue
            assert listed[path].attrs["tiles"]["package"] == "fhash"
            sizes = [len(array.coded(index)) for index in np.ndindex(*array.grid)]
            if prod(array.together) > 1:
                assert listed[path][...].ravel().tolist() == sizes
            assert not listed[path].nchunks_initialized or prod(array.together) > 1
