"""FORMAT.md: the code accepts its examples, and it names all keys, arrays and existing files."""

from __future__ import annotations

import json
import re
from importlib.resources import files
from typing import Any

import numpy as np
import pytest

from fhash_formats.container import (
    Container,
    ContainerWriter,
    SeveralWriter,
    read_metadata,
    validate_header,
)
from fhash_formats.container.array import ArrayMetadata
from fhash_formats.container.coding import ARRAY_CODECS, PlainCoder, plain_codecs
from fhash_formats.container.header import FORMAT_VERSION
from fhash_formats.container.sharding import sharding_codecs
from fhash_formats.errors import DamagedFileError
from fhash_formats.series import AXIS_NAMES
from fhash_formats.support.number_types import DTYPES
from fhash_formats.transform.tile.settings import TileSettings

DOCUMENT = files("fhash_formats").joinpath("FORMAT.md").read_text(encoding="utf-8")


def example(name: str) -> dict[str, Any]:
    (text,) = re.findall(rf"^```json {name}\n(.*?)^```", DOCUMENT, re.MULTILINE | re.DOTALL)
    return json.loads(text)


def test_header_is_valid_and_can_be_written(tmp_path, samples) -> None:
    header = example("header")
    validate_header(header)
    assert tuple(header["format_version"]) == FORMAT_VERSION
    arrays = samples.arrays(header)
    samples.write(tmp_path / "a.fhz", header, arrays)
    with Container.open(tmp_path / "a.fhz") as container:
        assert container.header == header
        container.verify()
    for name in arrays:
        assert re.sub("_[0-9]$", "_1", name) in DOCUMENT


def test_compact_header_is_valid_and_can_be_written(tmp_path, samples) -> None:
    header = example("compact-header")
    validate_header(header)
    with ContainerWriter(tmp_path / "a.fhz") as writer:
        writer.add_whole("tables/level_1", np.zeros(header["model"]["levels"][0], dtype=np.float32))
        writer.add_whole("auxiliary/area", np.ones((5, 6), dtype=np.float32))
        writer.commit(header)
    with Container.open(tmp_path / "a.fhz") as container:
        assert container.header == header
        assert container.coordinate("x").name == "lon"
        coords = {axis: container.coordinate(name) for axis, name in AXIS_NAMES.items()}
        metadata = read_metadata(header, container.arrays, coords)
    assert list(metadata.dimensions) == ["time", "level", "y", "lon", "member"]
    assert [each.name for each in metadata.variables][:2] == ["time", "lon"]
    assert metadata.named("lon").values.dtype == np.float32
    assert metadata.variable_attributes["missing_value"] == np.float32(1e20)
    for key in (
        "coordinates",
        *header["model"],
        *header["coordinates"]["x"],
        *header["source"],
        *(key for each in header["source"]["variables"] for key in each),
        "values",
        "attributes",
    ):
        assert f"`{key}`" in DOCUMENT
    assert "`auxiliary/" in DOCUMENT
    for name in ("occupancy/bits", "occupancy/mask", "tables/level_1"):
        assert f"`{name}`" in DOCUMENT


def test_variables_are_valid_and_can_be_written(tmp_path) -> None:
    root = example("variables")
    with ContainerWriter(tmp_path / "a.fhz") as writer:
        several = SeveralWriter(writer, [header["name"] for header in root["variables"]])
        for header in root["variables"]:
            variable = several.variable(header["name"])
            axes, lengths = ("time", "z", "y", "x"), header["domain"]["shape"]
            for axis, name, length in zip(axes, header["dimensions"], lengths, strict=True):
                variable.add_whole(f"coords/{axis}", np.zeros(length), attributes={"name": name})
            levels = header["model"]["levels"][0]
            variable.add_whole("tables/level_1", np.zeros(levels, dtype=np.float32))
            variable.finish(header)
        several.commit()
    with Container.open(tmp_path / "a.fhz") as container:
        assert container.header == root
        assert list(container.variables) == ["u", "surface/rain rate"]
        # Tables of plain numbers need not be values: they lie with the parts.
        assert "parts/surface_rain_rate.tables.level_1" in container.arrays
    for key in ("variables", "name", "array", "dimensions"):
        assert f"`{key}`" in DOCUMENT


def test_sharded_array_is_what_the_writer_writes(monkeypatch) -> None:
    monkeypatch.setitem(
        ARRAY_CODECS,
        "fhash.transform",
        lambda codecs, dtype, shape: PlainCoder(plain_codecs(dtype)[:2], dtype, shape),
    )
    values = example("sharded-array")
    metadata = ArrayMetadata.from_dict(values)
    assert metadata.to_dict() == values
    assert metadata.grid == (1, 1, 1, 1)
    assert metadata.inner_grid == (2, 2, 2, 2)
    inner = values["codecs"][0]["configuration"]
    assert sharding_codecs(inner["chunk_shape"], inner["codecs"]) == values["codecs"]


def test_no_key_of_the_example_can_be_left_out() -> None:
    header = example("header")
    for key in header:
        with pytest.raises(DamagedFileError, match=key):
            validate_header({k: v for k, v in header.items() if k != key})
        assert f"| `{key}` |" in DOCUMENT


def test_array_is_what_the_writer_writes() -> None:
    values = example("array")
    metadata = ArrayMetadata.from_dict(values)
    assert metadata.to_dict() == values
    assert metadata.dtype == np.float16
    assert list(metadata.codecs) == plain_codecs(metadata.dtype)


def test_the_settings_of_the_example_are_those_of_a_tile() -> None:
    settings = example("fhash.transform")
    assert TileSettings.from_dict(settings).to_dict() == settings


def test_every_file_that_is_named_exists() -> None:
    named = re.findall(r"`((?:transform|native)/[^`]+)`", DOCUMENT)
    assert named
    for path in named:
        assert files("fhash_formats").joinpath(path).is_file(), path


def test_every_data_type_is_named() -> None:
    assert all(name in DOCUMENT for name in DTYPES)
    assert f"version {FORMAT_VERSION[0]}.{FORMAT_VERSION[1]}" in DOCUMENT.splitlines()[0]
