"""Mutations that declare far more than a file of a few kilobytes holds.

All checksums are correct. A file without what a kind changes is passed over.
"""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from dataclasses import replace
from math import prod
from typing import Any

import numpy as np
from containers import Parts
from documents import (
    DOCUMENT,
    GROUP,
    Documents,
    NothingFitsError,
    added,
    array_of_zeros,
    dumped,
    is_plain,
    without,
)
from mutated_tiles import CODED_FEATURES, PLAIN, Tiles, is_coded, settings_of
from reference.sections import pack_planes

from fhash_formats.container.array import ArrayMetadata, transform_codecs
from fhash_formats.container.hierarchy import path_of
from fhash_formats.support.values import DTYPES
from fhash_formats.transform.tile_format import (
    EMPTY,
    LABELS,
    MASKED,
    PREDICTED,
    TRANSFORMED,
    seal,
    varint,
)

AXES = ("time", "z", "y", "x")


def _declared(header: dict[str, Any], shape: list[int], domain: list[int] | None = None) -> None:
    """Give a header another shape of the volume."""
    header["quality"].pop("steps", None)
    header["domain"]["shape"] = domain or shape
    header["feature_bounding_box"] = [[0, n] for n in shape[1:]]
    header["model"]["levels"] = [shape]


def _tiles(chance: random.Random, parts: Parts) -> Parts:
    """Declare a volume of up to 2^60 vertices in tiles of up to 2^30 bytes, all of them empty."""
    file = Documents(parts)
    document = file.arrays.get(file.table, {})
    if file.header["model"]["profile"] != "compact" or not document or not is_coded(document):
        raise NothingFitsError
    file.top["required_features"] = CODED_FEATURES
    kind = chance.choice(list(DTYPES))
    shape, tile = _shapes(chance, file.header, kind)
    settings = settings_of(document)
    if settings is None or chance.random() < 0.7:
        settings = PLAIN
    elif chance.random() < 0.5:
        settings = replace(settings, transform=PLAIN.transform)
    settings = replace(settings, head=None)
    file.header["mlp"] = None
    metadata = ArrayMetadata(
        shape=tuple(shape),
        dtype=np.dtype(kind),
        chunk_shape=tuple(tile),
        codecs=transform_codecs(settings),
    )
    counts = [chance.choice((1, n, n, 2 * n)) for n in metadata.grid]
    if chance.random() < 0.1:  # an index of many tiles that are none
        counts[chance.randrange(4)] = chance.choice((1 << 12, 1 << 19, 1 << 30))
    file.arrays[file.table] = replace(metadata, together=tuple(counts)).to_dict()
    stream = _empty_stream(chance, np.dtype(kind).itemsize)
    new: dict[str, bytes] = {}
    if prod(counts) <= 1 << 20:  # others are refused before a member is looked for
        tiles = Tiles(file, file.table)
        for member in tiles.members:
            streams = [stream] * len(list(tiles.metadata.chunks_of(member)))
            new |= tiles.packed(member, streams)
    kept = without(file.packed(), f"{file.table}/c/", f"{file.table}/t/", "missing/", "occupancy/")
    return [*new.items(), *kept]


def _shapes(
    chance: random.Random, header: dict[str, Any], kind: str
) -> tuple[list[int], list[int]]:
    """Declare a giant volume in a header, and return the shapes of the box and of a tile."""
    room = (1 << chance.choice((20, 24, 28, 30, 31))) // np.dtype(kind).itemsize
    chunk = [1, 1, 1, 1]
    for axis in chance.sample(range(4), 4):
        chunk[axis] = 1 << chance.randrange(21)
        while prod(chunk) > min(room, 1 << 27):
            chunk[axis] //= 2
    counts = [chance.choice((1, 1, 1, 2)) for _ in range(4)]
    shape = [
        max(1, min(1 << 20, n * count - chance.choice((0, 0, n // 3))))
        for n, count in zip(chunk, counts, strict=True)
    ]
    domain = [shape[0], *(max(n, chance.choice((1, n, 2**20))) for n in shape[1:])]
    _declared(header, shape, domain)
    header["model"]["tables"] = kind
    header["coordinates"] = {name: {} for name in AXES}
    return shape, chunk


def _empty_stream(chance: random.Random, itemsize: int) -> bytes:
    """Return the stream of a tile of few bytes: empty, with empty sections, or of labels."""
    turn = chance.random()
    if turn < 0.3:  # labels of one value: no byte is needed for any number of them
        packed = pack_planes(np.zeros(1, f"u{itemsize}"))
        body = varint(1) + varint(len(packed)) + packed
        return seal(chance.choice((LABELS, LABELS, LABELS | MASKED)), [body])
    if turn < 0.6:
        sections = [b""] * chance.choice((1, 2, 3))
        return seal(chance.choice((TRANSFORMED, TRANSFORMED | MASKED, PREDICTED)), sections)
    return seal(chance.choice((EMPTY, EMPTY | MASKED)), [])


def _rebuilt(file: Documents, arrays: list[tuple[str, list[int], str]]) -> Parts:
    """Return a file whose only variable has these arrays of zeros alone."""
    file.header.pop("coordinates", None)  # 0, 1, 2...
    new: Parts = []
    for name, lengths, dtype in arrays:
        new += array_of_zeros(name, lengths, dtype)
    return added([(DOCUMENT, dumped(file.root))], new)


def _shape(chance: random.Random, axes: range) -> list[int]:
    """Return the shape of a volume of 2^16 to 2^24 vertices."""
    shape, vertices = [1, 1, 1, 1], 1 << chance.choice((16, 18, 20, 22, 24))
    while prod(shape) < vertices:
        shape[chance.choice(axes)] *= 2
    return shape


def _plain(chance: random.Random, parts: Parts) -> Parts:
    """Declare a giant volume of zeros in a plain file, with one tile."""
    file = Documents(parts)
    if not is_plain(file):
        raise NothingFitsError
    header, shape = file.header, _shape(chance, range(4))
    model = header["model"]
    _declared(header, shape)
    header["variable"]["dtype"] = model["values"] = kind = chance.choice(list(DTYPES))
    wide = np.dtype(kind).itemsize > 2 and kind != "float32"
    model["tables"] = chance.choice(("float64" if wide else "float32", "float32"))
    model["tile"] = chance.choice((shape, [64] * 4, [2**20] * 4, [1] * 4))
    # A head is applied tile by tile, which takes some 50 us for the smallest tile.
    if chance.random() < 0.5 or (model["tile"] == [1] * 4 and prod(shape) > 1 << 16):
        header.pop("mlp", None)
    bits = -(-prod(1 << (n - 1).bit_length() for n in shape[1:]) // 8)
    arrays: list[tuple[str, list[int], str]] = [
        ("table_1", [*shape, 1], model["tables"]),
        ("key_frames", shape[:1], "int64"),
        ("occupancy", [1, shape[0], bits], "uint8"),
        *([("corrections", shape, "float32")] if chance.random() < 0.5 else []),
    ]
    return _rebuilt(file, arrays)


def _sparse(chance: random.Random, parts: Parts) -> Parts:
    """Declare a giant volume in a file that has few or all of its vertices."""
    file = Documents(parts)
    header, shape = file.header, _shape(chance, range(1, 4))
    if "sparse" not in header["model"]:
        raise NothingFitsError
    _declared(header, shape)
    header["model"].update(embedding_size=1, hidden_layers=0, tables="float16")
    rows = chance.choice((1, 8, prod(shape)))
    arrays: list[tuple[str, list[int], str]] = [
        ("table_1", [rows, 1], "float16"),
        ("mlp/weight_1", [1, 1], "float32"),
        ("mlp/bias_1", [1], "float32"),
        ("key_frames", [1], "int64"),
        ("occupancy", [len(header["features"]), 1, -(-prod(shape) // 8)], "uint8"),
    ]
    rebuilt = Documents(_rebuilt(file, arrays))
    rebuilt.arrays["table_1"]["attributes"] = {"counts": [rows]}
    return rebuilt.packed()


def _source(chance: random.Random, parts: Parts) -> Parts:
    """Declare far more metadata than the file has bytes: long texts, many arrays, large arrays."""
    file = Documents(parts)
    headers = [header for header in file.headers if "source" in header]
    if not headers:
        raise NothingFitsError
    source, turn = chance.choice(headers)["source"], chance.randrange(5)
    count = chance.choice((1000, 100_000, 1_000_000))
    texts = [""] * count  # each of 64 KiB has two bytes in the file
    if turn == 0:
        source["attributes"] = {"a": {"bytes65536": texts}}
    elif turn == 1:
        source["lengths"] = {"long": count}
        entry = {"name": "a", "dimensions": ["long"], "dtype": "bytes65536", "values": texts}
        source["variables"] = [entry]
    elif turn == 2:
        kind = chance.choice(("float32", "float64", "int8", "text"))
        value: Any = "" if kind == "text" else 0
        source["attributes"] = {f"a{n}": {kind: [value] * (count // 9)} for n in range(9)}
    elif turn == 3:
        source["variables"] = [{"name": f"a{n}", "values": [n]} for n in range(min(count, 20_000))]
    else:  # arrays beside the values of up to 2^25 bytes of zeros, alone or many times
        length, times = 1 << chance.choice((16, 18, 20, 22)), chance.choice((1, 7, 500))
        number = file.headers.index(headers[0])
        for header in headers:
            header["source"]["lengths"] = {"long": length}
            header["source"]["variables"] = [
                {"name": f"a{n}", "dimensions": ["long"], "array": "long"} for n in range(times)
            ]
        for header in headers[1:]:
            header["shares"] = {"auxiliary/long": number}
        path = path_of(headers[0], "auxiliary/long")
        return added(parts, array_of_zeros("", [length], "float64", path), file.root)
    return file.packed()


def _variables(chance: random.Random, parts: Parts) -> Parts:
    """Declare hundreds of variables, with positions of their own or of others, and long lists."""
    file = Documents(parts)
    if "group" not in file.header:
        file.header["group"] = "v0"
        moved = [(f"v0/{name}", data) for name, data in parts if name != DOCUMENT]
        parts = added([parts[-1]], moved)
    header = min(file.headers, key=lambda one: len(json.dumps(one)))
    own, new = f"{header['group']}/", []
    others, listed = chance.random() < 0.5, chance.random() < 0.3
    for _ in range(chance.choice((30, 200, 700))):
        place = len(file.headers)
        coordinates = header.get("coordinates", {})
        if others:
            coordinates = dict.fromkeys(coordinates, file.headers.index(header))
        elif listed:
            shape = zip(AXES, header["domain"]["shape"], strict=True)
            coordinates = {axis: {"values": list(range(n))} for axis, n in shape}
        named = {"name": f"n{place}", "group": f"v{place}", "coordinates": coordinates}
        file.headers.append({**header, **named})
        new += [
            (f"v{place}/{name.removeprefix(own)}", data)
            for name, data in parts
            if name.startswith(own)
        ]
    if chance.random() < 0.3:
        file.top["required_features"][:0] = ["transform"] * chance.choice((1000, 200_000))
    if chance.random() < 0.3:
        new += [(f"e{number}/{DOCUMENT}", GROUP) for number in range(3000)]
    return added(parts, new, file.root)


KINDS: dict[str, Callable[[random.Random, Parts], Parts]] = {
    "giant": _tiles,
    "plain giant": _plain,
    "sparse giant": _sparse,
    "source giant": _source,
    "many variables": _variables,
}
