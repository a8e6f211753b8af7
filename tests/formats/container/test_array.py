"""Metadata of an array: what a container may hold, and nothing else."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest
from hostile_files import DOCUMENT, edited, read_everything, refused

from fhash_formats.container.array import ArrayMetadata
from fhash_formats.container.coding import plain_codecs
from fhash_formats.errors import DamagedFileError, UnsupportedFileError

ARRAYS = {
    "huge shape": (lambda v: v.update(shape=[2**60]), "chunks; .* are declared", DamagedFileError),
    "huge chunk": (
        lambda v: v["chunk_grid"].update(configuration={"chunk_shape": [2**60]}),
        "limit",
        DamagedFileError,
    ),
    "both huge": (
        lambda v: v.update(
            shape=[2**60], chunk_grid={"name": "regular", "configuration": {"chunk_shape": [2**60]}}
        ),
        "limit",
        DamagedFileError,
    ),
    "larger chunk": (
        lambda v: v["chunk_grid"].update(configuration={"chunk_shape": [2**20]}),
        "zstd declares",
        DamagedFileError,
    ),
    "beyond": (lambda v: v.update(shape=[2**80]), "shape", DamagedFileError),
    "negative": (lambda v: v.update(shape=[-4]), "shape", DamagedFileError),
    "bool length": (lambda v: v.update(shape=[True]), "shape", DamagedFileError),
    "float length": (lambda v: v.update(shape=[4.0]), "shape", DamagedFileError),
    "many axes": (lambda v: v.update(shape=[1] * 99), "axes", DamagedFileError),
    "other rank": (lambda v: v.update(shape=[4, 1]), "axes", DamagedFileError),
    "wrong dtype": (
        lambda v: v.update(data_type="float32"),
        "zstd declares|asks for float64",
        DamagedFileError,
    ),
    "unknown dtype": (
        lambda v: v.update(data_type="complex128"),
        "data_type",
        UnsupportedFileError,
    ),
    "dtype object": (
        lambda v: v.update(data_type={"name": "object"}),
        "data_type",
        UnsupportedFileError,
    ),
    "unknown codec": (
        lambda v: v["codecs"].insert(1, {"name": "pickle"}),
        "codecs",
        UnsupportedFileError,
    ),
    "first codec": (
        lambda v: v["codecs"].__setitem__(0, {"name": "vlen-utf8"}),
        "codecs",
        UnsupportedFileError,
    ),
    "big endian": (
        lambda v: v["codecs"][0]["configuration"].update(endian="big"),
        "codecs",
        UnsupportedFileError,
    ),
    "no checksum": (lambda v: v["codecs"].pop(), "codecs", UnsupportedFileError),
    "no codecs": (lambda v: v.update(codecs=[]), "codecs", UnsupportedFileError),
    "codecs no list": (lambda v: v.update(codecs={"a": 1}), "codecs", DamagedFileError),
    "codec no object": (lambda v: v.update(codecs=["bytes", 5]), "codecs", DamagedFileError),
    "fill value": (lambda v: v.update(fill_value=1.0), "fill_value", UnsupportedFileError),
    "chunk keys": (
        lambda v: v["chunk_key_encoding"].update(name="v2"),
        "chunk_key_encoding",
        UnsupportedFileError,
    ),
    "chunk grid": (
        lambda v: v["chunk_grid"].update(name="rectangular"),
        "chunk_grid",
        UnsupportedFileError,
    ),
    "transformers": (
        lambda v: v.update(storage_transformers=[{"name": "x"}]),
        "storage_transformers",
        UnsupportedFileError,
    ),
    "unknown key": (
        lambda v: v.update(surprise={"must_understand": True}),
        "surprise",
        UnsupportedFileError,
    ),
    "attributes": (lambda v: v.update(attributes=[1]), "attributes", DamagedFileError),
    "missing key": (lambda v: v.pop("codecs"), "codecs is missing", DamagedFileError),
    "zarr 2": (lambda v: v.update(zarr_format=2), "Zarr v3", UnsupportedFileError),
    "node type": (lambda v: v.update(node_type="table"), "Zarr v3", UnsupportedFileError),
    "dimension names": (
        lambda v: v.update(dimension_names=[1]),
        "dimension_names",
        DamagedFileError,
    ),
}


@pytest.mark.parametrize("case", ARRAYS)
def test_array_metadata(sample, samples, case) -> None:
    change, message, kind = ARRAYS[case]
    refused(sample, edited(sample, samples, DOCUMENT, change), message, kind)


def test_key_that_need_not_be_understood(sample, samples) -> None:
    sample.write_bytes(
        edited(sample, samples, DOCUMENT, lambda v: v.update(surprise={"must_understand": False}))
    )
    read_everything(sample)


def metadata(**changes: Any) -> ArrayMetadata:
    fields = {
        "shape": (5, 7),
        "dtype": np.dtype("int16"),
        "chunk_shape": (2, 3),
        "codecs": plain_codecs(np.dtype("int16")),
    }
    return ArrayMetadata(**{**fields, **changes})


def test_metadata_come_back_from_their_document() -> None:
    array = metadata(dimension_names=("y", None), attributes={"units": "m"})
    assert ArrayMetadata.from_dict(array.to_dict()) == array


def test_every_chunk_has_its_name_and_its_region() -> None:
    array, values = metadata(), np.zeros((5, 7), int)
    assert array.grid == array.inner_grid == (3, 3)
    for index in product(*map(range, array.grid)):
        assert array.parse_key(array.chunk_key(index)) == index
        values[array.inner_region(index)] += 1
    assert np.all(values == 1)


@pytest.mark.parametrize("key", ["c/3/0", "c/0", "c/0/0/0", "c/00/0", "c/-1/0", "d/0/0", "c/0/x"])
def test_names_of_no_chunk(key) -> None:
    with pytest.raises(DamagedFileError, match="no chunk of the array's grid"):
        metadata().parse_key(key)
