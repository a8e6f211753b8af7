"""FORMAT.md: the code accepts its examples, and it names all keys, arrays and existing files."""

from __future__ import annotations

import json
import re
import zipfile
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fhash_formats.container import (
    Container,
    ContainerWriter,
    read_metadata,
)
from fhash_formats.container.header import DEFAULTS, LOWEST, MASK_ARRAY, MISSING_ARRAY, STEPS
from fhash_formats.container.hierarchy import (
    ARRAY,
    CONSOLIDATED,
    DIMENSIONS,
    NODE,
    SHARES,
    VARIABLES,
    part_place,
    read_variables,
)
from fhash_formats.container.zip_file import FORMAT_VERSION
from fhash_formats.errors import DamagedFileError
from fhash_formats.series import AXIS_NAMES
from fhash_formats.support.values import DTYPES

DOCUMENT = files("fhash_formats").joinpath("FORMAT.md").read_text(encoding="utf-8")


def example(name: str) -> dict[str, Any]:
    (text,) = re.findall(rf"^```json {name}\n(.*?)^```", DOCUMENT, re.MULTILINE | re.DOTALL)
    return json.loads(text)


def shown(path: Path) -> dict[str, Any]:
    """The attribute of the root of a file."""
    with zipfile.ZipFile(path) as file:
        return json.loads(file.read("zarr.json"))["attributes"]["fhash"]


def test_header_is_valid_and_can_be_written(tmp_path, samples) -> None:
    root = example("header")
    assert tuple(root["format_version"]) == FORMAT_VERSION
    (header,) = root["variables"]
    with ContainerWriter(tmp_path / "a.fhz") as writer:
        writer.name_axes(header["dimensions"], header["domain"]["shape"])
        writer.add_whole("tables/level_1", np.zeros(header["model"]["levels"][0], dtype=np.float32))
        writer.add_whole("auxiliary/area", np.ones((5, 6), dtype=np.float32))
        writer.commit({**header, "required_features": root["required_features"]})
    assert shown(tmp_path / "a.fhz") == root
    with Container.open(tmp_path / "a.fhz") as container:
        assert container.coordinate("x").name == "lon"
        coords = {axis: container.coordinate(name) for axis, name in AXIS_NAMES.items()}
        metadata = read_metadata(header, container.arrays, coords)
    assert list(metadata.dimensions) == ["time", "level", "y", "lon", "member"]
    assert [each.name for each in metadata.variables][:2] == ["time", "lon"]
    assert metadata.named("lon").values.dtype == np.float32
    assert metadata.variable_attributes["missing_value"] == np.float32(1e20)
    for key in (
        *header,
        *samples.header(),
        *header["model"],
        *samples.header()["model"],
        *header["coordinates"]["x"],
        *header["source"],
        *header["quality"],
        *(key for each in header["source"]["variables"] for key in each),
        *(ARRAY, DIMENSIONS, SHARES, VARIABLES, LOWEST, CONSOLIDATED),
    ):
        assert f"`{key}`" in DOCUMENT
    for name in (*samples.arrays(samples.header()), MASK_ARRAY, MISSING_ARRAY, STEPS):
        assert f"`{re.sub('_[0-9]$', '_1', name)}`" in DOCUMENT


def test_paths_are_those_of_the_document(tmp_path) -> None:
    assert f"`{part_place(0, 'mlp/weight_1')}` is `mlp/weight_1`" in DOCUMENT
    assert f"`{NODE.pattern}`" in DOCUMENT


def test_defaults_are_those_of_the_document() -> None:
    for key in DEFAULTS:
        assert f"| `{key}` |" in DOCUMENT


def test_no_key_of_the_example_can_be_left_out_but_defaults() -> None:
    (header,) = example("header")["variables"]
    for key in header:
        root = {**example("header"), "variables": [{k: v for k, v in header.items() if k != key}]}
        if key in (*DEFAULTS, "source"):
            read_variables(root, [])
        else:
            with pytest.raises(DamagedFileError, match=key):
                read_variables(root, [])
        assert f"| `{key}` |" in DOCUMENT


def test_every_file_that_is_named_exists() -> None:
    named = re.findall(r"`((?:container|transform|native)/[^`]+)`", DOCUMENT)
    assert named
    for path in named:
        assert files("fhash_formats").joinpath(path).is_file(), path


def test_every_data_type_is_named() -> None:
    assert all(name in DOCUMENT for name in DTYPES)
    assert f"version {FORMAT_VERSION[0]}.{FORMAT_VERSION[1]}" in DOCUMENT.splitlines()[0]
