"""Members become arrays and a header: every member has a place, every chunk is there."""

from __future__ import annotations

import json

import pytest
from hostile_files import DOCUMENT, ROOT, edited, refused, replaced

from fhash_formats.errors import UnsupportedFileError


def extra_array(shape):
    metadata = {
        "shape": shape,
        "data_type": "uint8",
        "fill_value": 0,
        "chunk_key_encoding": {"name": "default"},
        "zarr_format": 3,
        "node_type": "array",
    }
    grid = {"name": "regular", "configuration": {"chunk_shape": [1] * len(shape)}}
    codecs = [
        {"name": "bytes"},
        {"name": "zstd", "configuration": {"level": 1, "checksum": False}},
        {"name": "crc32c"},
    ]
    return json.dumps({**metadata, "chunk_grid": grid, "codecs": codecs}).encode()


PLACES = {
    "chunk missing": (
        lambda p: [part for part in p if part[0] != "time/c/0"],
        "time has 0 chunks",
    ),
    "all but the root missing": (lambda p: p[-1:], "array coords/time is missing"),
    "root missing": (lambda p: p[:-1], "zarr.json is missing"),
    "nothing": (lambda p: [], "zarr.json is missing"),
    "group missing": (
        lambda p: [part for part in p if part[0] != "parts/zarr.json"],
        "lies in no group",
    ),
    "chunk outside the grid": (lambda p: [("time/c/1", b"x"), *p], "member time/c/1"),
    "chunk of other rank": (
        lambda p: [("time/c/0/0", b"x"), *p],
        "member time/c/0/0",
    ),
    "chunk under another name": (
        lambda p: [("time/c/00", b"x"), *p],
        "member time/c/00",
    ),
    "chunk number too long": (
        lambda p: [("time/c/" + "9" * 400, b"x"), *p],
        "member time/c/999",
    ),
    "chunk of no array": (lambda p: [("none/c/0", b"x"), *p], "belongs to no array"),
    "file of no array": (lambda p: [("readme.txt", b"x"), *p], "belongs to no array"),
    "array in an array": (
        lambda p: [("time/a/zarr.json", extra_array([1])), *p],
        "lies in no group",
    ),
    "many chunks declared": (
        lambda p: [("more/zarr.json", extra_array([2**31, 2**31])), *p],
        "has 0 chunks",
    ),
    "table missing": (
        lambda p: [part for part in p if not part[0].startswith("parts/0.tables.level_2")],
        "tables/level_2 is missing",
    ),
}


@pytest.mark.parametrize("case", PLACES)
def test_members_and_arrays(sample, samples, case) -> None:
    change, message = PLACES[case]
    refused(sample, samples.pack(change(samples.unpack(sample.read_bytes()))), message)


TEXTS = {
    "NaN": (b'{"a": NaN}', "NaN"),
    "Infinity": (b'{"a": -Infinity}', "Infinity"),
    "beyond float64": (b'{"a": 1e999}', "beyond float64"),
    "many digits": (b'{"a": ' + b"9" * 5000 + b"}", "JSON"),
    "twice": (b'{"a": 1, "a": 2}', "twice"),
    "deep lists": (b'{"a": ' + b"[" * 100_000 + b"]" * 100_000 + b"}", "deep"),
    "deep objects": (b'{"a":' * 50_000 + b"1" + b"}" * 50_000, "deep"),
    "deep and cut": (b"[" * 1_000_000, "deep"),
    "no JSON": (b"zarr", "JSON"),
    "cut": (b'{"a": 1', "JSON"),
    "list": (b"[1]", "object"),
    "empty": (b"", "JSON"),
    "not UTF-8": (b'{"a": "\xff"}', "JSON"),
    "half a pair": (b'{"a": "\\ud800"}', "JSON"),
    "too long": (b" " * ((16 << 20) + 1), "limit"),
}


@pytest.mark.parametrize("case", TEXTS)
@pytest.mark.parametrize("name", [ROOT, DOCUMENT])
def test_metadata_text(sample, samples, case, name) -> None:
    text, message = TEXTS[case]
    refused(sample, replaced(sample, samples, name, text), f"member {name}: .*{message}")


def test_root_is_an_ordinary_zarr_group(sample, samples) -> None:
    refused(
        sample,
        edited(sample, samples, ROOT, lambda v: v.update(attributes={})),
        "not the group of an fhash container",
    )


def test_a_newer_format_is_named_before_its_unknown_codecs(tmp_path, sample, samples) -> None:
    def newer(root) -> None:
        root["attributes"]["fhash"]["required_features"] = ["teleport"]

    def unknown(document) -> None:
        document["codecs"][0] = {"name": "fhash.teleport"}

    path = tmp_path / "a.fhz"
    path.write_bytes(edited(sample, samples, ROOT, newer))
    refused(
        path, edited(path, samples, DOCUMENT, unknown), "feature 'teleport'", UnsupportedFileError
    )
