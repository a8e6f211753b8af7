"""Mutations of chunks, shards, plain arrays and tables of needed vertices."""

from __future__ import annotations

import base64
import json
import random
import struct
from collections.abc import Callable
from math import prod
from typing import Any

import numpy as np
from mutated_documents import (
    DOCUMENT,
    FLOATS,
    LARGE,
    OTHERS,
    Parts,
    dumped,
    header_of,
    hostile,
    path_of,
    places,
    with_crc,
)
from numcodecs.zstd import compress, decompress

from fhash_formats.container.array import ArrayMetadata, Sharding, pack_index, parse_index
from fhash_formats.container.header import KNOWN_FEATURES
from fhash_formats.native import crc32c
from fhash_formats.support.values import DTYPES
from fhash_formats.transform.tile_format import (
    KIND,
    MASKED,
    RESIDUAL,
    TRANSFORMED,
    TileSettings,
    TileStream,
    parse_stream,
    seal,
)

Change = Callable[[random.Random, bytes], bytes]


class NothingFitsError(LookupError):
    """Raised for a file without an array of the kind that a mutation changes."""


def documents_of(parts: Parts) -> dict[str, Any]:
    """Return the metadata of the arrays by name."""
    documents = {
        name.rpartition("/")[0]: json.loads(data) for name, data in parts if name.endswith(DOCUMENT)
    }
    return {name: values for name, values in documents.items() if values["node_type"] == "array"}


def chosen(
    chance: random.Random, parts: Parts, coded: bool | None = None
) -> tuple[str, dict[str, Any], str, bytes]:
    """Choose an array; return its name and metadata, and name and data of one of its members.

    `coded` says whether the array is coded by `fhash.transform`; None allows both.
    """
    documents = documents_of(parts)
    fitting = [
        (name, data)
        for name, data in parts
        if "/c/" in name and _fits(documents[_array_of(name)], coded)
    ]
    if not fitting:
        raise NothingFitsError
    name, data = chance.choice(fitting)
    return _array_of(name), documents[_array_of(name)], name, data


def _array_of(member: str) -> str:
    return member[: member.rindex("/c/")]


class OneTile(Sharding):
    """Stands for the sharding of an array of one tile, which has no shard and no index."""


def is_sharded(document: dict[str, Any]) -> bool:
    return bool(document["codecs"][0]["name"] == "sharding_indexed")


def coding(document: dict[str, Any]) -> str:
    """Return the name of the codec that makes bytes of a chunk, or of an inner chunk of a shard."""
    codecs = document["codecs"]
    return str(
        (codecs[0]["configuration"]["codecs"] if is_sharded(document) else codecs)[0]["name"]
    )


def is_coded(document: dict[str, Any]) -> bool:
    return coding(document) == "fhash.transform"


def _fits(document: dict[str, Any], coded: bool | None) -> bool:
    """Whether an array is coded by `fhash.transform`, or by ordinary codecs; None allows all."""
    return coded is None or coding(document) == ("fhash.transform" if coded else "bytes")


def replaced(parts: Parts, new: dict[str, bytes]) -> Parts:
    return [(name, new.get(name, data)) for name, data in parts]


def damaged(chance: random.Random, data: bytes) -> bytes:
    """Return the bytes of a stream changed a little or much."""
    if not data:
        return chance.randbytes(chance.randrange(9))
    changed = bytearray(data)
    turn = chance.random()
    if turn < 0.55:
        for _ in range(chance.choice((1, 1, 2, 8))):
            changed[chance.randrange(len(changed))] ^= 1 << chance.randrange(8)
    elif turn < 0.7:
        del changed[chance.randrange(len(changed)) :]
    elif turn < 0.8:
        at = chance.randrange(len(changed))
        changed[at:at] = chance.randbytes(chance.randrange(1, 20))
    elif turn < 0.9:
        changed = bytearray(chance.randbytes(chance.randrange(2 * len(data) + 1)))
    else:
        changed = bytearray(chance.choice((b"\xff", b"\x00", b"\x80")) * chance.randrange(1, 3000))
    return bytes(changed)


def inner_chunks(
    document: dict[str, Any], member: str, data: bytes
) -> tuple[Sharding, np.ndarray[Any, Any], list[bytes]]:
    """Return the sharding of an array, which inner chunks a shard has, and these."""
    metadata = ArrayMetadata.from_dict(document)
    sharding = metadata.sharding
    if sharding is None:
        tile = metadata.chunk_shape
        return OneTile(shard_shape=tile, chunk_shape=tile, codecs=()), np.ones(1, bool), [data]
    shard = tuple(int(i) for i in member[member.rindex("/c/") + 3 :].split("/"))
    present = sharding.present(shard, metadata.shape)
    index = parse_index(data[-sharding.index_bytes :], present, len(data) - sharding.index_bytes)
    return sharding, present, [data[offset : offset + size] for offset, size in index[present]]


def sealed(rest: bytes) -> bytes:
    """Return the stream of bytes that follow its checksum."""
    return crc32c(rest).to_bytes(4, "little") + rest


def shard_of(sharding: Sharding, present: np.ndarray[Any, Any], chunks: list[bytes]) -> bytes:
    if isinstance(sharding, OneTile):
        return b"".join(chunks)
    return b"".join(chunks) + pack_index([len(chunk) for chunk in chunks], present)


def bytes_changed(chance: random.Random, parts: Parts) -> Parts:
    """Change bytes of a chunk as stored, with a correct checksum."""
    _, document, member, data = chosen(chance, parts)
    if not is_coded(document):
        return replaced(parts, {member: with_crc(damaged(chance, data[:-4]))})
    sharding, present, chunks = inner_chunks(document, member, data)
    at = chance.randrange(len(chunks))
    chunks[at] = sealed(damaged(chance, chunks[at][4:]))
    return replaced(parts, {member: shard_of(sharding, present, chunks)})


def _index(chance: random.Random, parts: Parts) -> Parts:
    """Change the index of a shard: entries overlap, point into the index, or lie outside or are
    missing."""
    if not any(is_coded(document) for document in documents_of(parts).values()):
        return bytes_changed(chance, parts)
    _, document, member, data = chosen(chance, parts, True)
    if not is_sharded(document):
        return bytes_changed(chance, parts)
    sharding, _, _ = inner_chunks(document, member, data)
    start = len(data) - sharding.index_bytes
    table = list(struct.unpack(f"<{2 * prod(sharding.counts)}Q", data[start:-4]))
    for _ in range(chance.choice((1, 1, 2))):
        at = chance.randrange(len(table))
        table[at] = chance.choice(
            (
                0,
                1,
                start,
                start + 1,
                2**64 - 1,
                2**63,
                2**32,
                max(table[at], 1) - 1,
                chance.choice(table),
            )
        )
    return replaced(
        parts, {member: data[:start] + with_crc(struct.pack(f"<{len(table)}Q", *table))}
    )


SPECIAL = (np.nan, np.inf, -np.inf, 0.0, -0.0, 1e-45, 1e38, -3.4e38, 1e300, -1e308, 5e-324)


def values_changed(chance: random.Random, parts: Parts) -> Parts:
    """Change values of an ordinary array: coordinates, weights, tables, occupancy, key frames."""
    _, document, member, data = chosen(chance, parts, False)
    dtype = np.dtype(document["data_type"])
    values = np.frombuffer(decompress(data[:-4]), dtype).copy()
    with np.errstate(all="ignore"):
        for _ in range(chance.choice((1, 2, len(values)))):
            at = chance.randrange(len(values))
            if dtype.kind == "f":
                values[at] = chance.choice(
                    (*SPECIAL, float(values[at]) * 1e6, -float(values[at]), float(values[0]))
                )
            else:
                values[at] = chance.choice(
                    (
                        0,
                        1,
                        np.iinfo(dtype).min,
                        np.iinfo(dtype).max,
                        int(values[at]) ^ 1,
                        255 & int(values[at]) + 1,
                    )
                )
    if chance.random() < 0.2:
        # The largest float64 is infinite in float32.
        with np.errstate(over="ignore"):
            values[:] = chance.choice(SPECIAL) if dtype.kind == "f" else chance.choice((0, 255))
    return replaced(parts, {member: with_crc(compress(values.tobytes(), 1))})


def configuration_of(document: dict[str, Any]) -> dict[str, Any]:
    first = document["codecs"][0]["configuration"]
    configuration: dict[str, Any] = (
        first["codecs"][0]["configuration"] if is_sharded(document) else first
    )
    return configuration


def tile_of(document: dict[str, Any]) -> tuple[int, ...]:
    """Return the shape of a coded tile."""
    place = document["codecs"][0] if is_sharded(document) else document["chunk_grid"]
    return tuple(place["configuration"]["chunk_shape"])


def settings_of(document: dict[str, Any]) -> TileSettings | None:
    """Return the settings that all tiles of an array share; None where each has its own."""
    text = configuration_of(document).get("settings")
    return None if text is None else TileSettings.from_text(text)


def put_settings(document: dict[str, Any], data: bytes) -> None:
    configuration_of(document)["settings"] = base64.b64encode(data).decode()


def sections_of(stream: TileStream) -> list[bytes]:
    parts = (stream.settings, stream.missing, stream.body, stream.residual, stream.mask)
    return [bytes(part) for part in parts if part is not None]


def _stream(chance: random.Random, parts: Parts) -> Parts:
    """Change sections of a coded tile: another valid tile, unless a decoder refuses it."""
    if not any(is_coded(document) for document in documents_of(parts).values()):
        return values_changed(chance, parts)
    _, document, member, data = chosen(chance, parts, True)
    sharding, present, chunks = inner_chunks(document, member, data)
    at = chance.randrange(len(chunks))
    flags, sections = chunks[at][4], sections_of(parse_stream(chunks[at]))
    if sections:
        number = chance.randrange(len(sections))
        sections[number] = damaged(chance, sections[number])
    if chance.random() < 0.15 and flags & KIND == TRANSFORMED and not flags & RESIDUAL:
        flags |= RESIDUAL  # a residual where none was
        sections.insert(
            len(sections) - bool(flags & MASKED), chance.randbytes(chance.randrange(200))
        )
    chunks[at] = seal(flags, sections)
    return replaced(parts, {member: shard_of(sharding, present, chunks)})


PAYLOAD_KINDS: dict[str, Callable[[random.Random, Parts], Parts]] = {
    "bytes": bytes_changed,
    "stream": _stream,
    "index": _index,
    "values": values_changed,
}


CORRECTIONS = "parts/0.corrections"
"""Path of the corrections."""
NUMBERS = ("parts/0.mlp.", "parts/0.tables.", CORRECTIONS)
"""Beginnings of the paths of arrays of numbers."""
OCCUPANCY = "parts/0.occupancy."
"""Beginning of the paths of arrays of occupancy."""
GIANT_BYTES = 1 << 28
"""Largest decoded bytes of a chunk of zeros in a file of some kilobytes."""


def _is_plain(parts: Parts) -> bool:
    return "plain" in header_of(parts)[1]["required_features"]


def _members(parts: Parts, name: str) -> list[str]:
    return [member for member, _ in parts if member.startswith(f"{name}/c/")]


def _values(parts: Parts, member: str, document: dict[str, Any]) -> np.ndarray[Any, Any]:
    """Return the values of a chunk of an ordinary array."""
    return np.frombuffer(decompress(dict(parts)[member][:-4]), document["data_type"]).copy()


def _stored(values: np.ndarray[Any, Any]) -> bytes:
    return with_crc(compress(values.tobytes(), 1))


def _plain(chance: random.Random, parts: Parts) -> Parts:
    """Change what the header of a plain file says: tiles, levels, types, head, features."""
    if not _is_plain(parts):
        raise NothingFitsError
    root, top, header = header_of(parts)
    model, turn = header["model"], chance.randrange(8)
    if turn == 0:
        sizes = (1, 1, 2, 5, 64, *LARGE[:8], 0, -1)
        model["tile"] = [chance.choice(sizes) for _ in range(4)]
    elif turn == 1:
        kind = chance.choice(list(DTYPES))
        model["values"] = kind
        if chance.random() < 0.7:
            header["variable"]["dtype"] = kind
    elif turn == 2:
        model["tables"] = chance.choice(("float32", "float64", "float16", "uint8", "transform"))
    elif turn == 3:
        levels = model["levels"]
        turned = [level[::-1] for level in levels]
        model["levels"] = chance.choice(
            (levels[:1], levels[:-1], [*levels, levels[-1]], levels[::-1], turned, levels[:1] * 3)
        )
    elif turn == 4:
        names = sorted(KNOWN_FEATURES)
        top["required_features"] = chance.choice(
            ([], names, ["plain"] * 2, ["plain", "transform"], ["transform"], ["plain", "mask"])
        )
    elif turn == 5 and model["head"] is not None:
        _head_changed(chance, model)
    elif turn == 6:
        holder, key = chance.choice(list(places(model)))
        holder[key] = hostile(chance, holder[key])
    else:
        header["coordinates"] = chance.choice(({}, {"z": {}}, {"time": {"values": [0]}}, []))
        model["gains"] = chance.choice(OTHERS)
    return replaced(parts, {DOCUMENT: dumped(root)})


def _head_changed(chance: random.Random, model: dict[str, Any]) -> None:
    """Change the description of a plain head."""
    head, turn = model["head"], chance.randrange(4)
    if turn == 0:
        model["head"] = None
    elif turn == 1:
        head["hidden"] = chance.choice(([], [4], [4, 3], [3, 4], [4, 3, 1], [64] * 3, [65], [0]))
    elif turn == 2:
        head["cross"] = chance.choice((not head["cross"], 1, None, "true"))
    else:
        numbers = (*FLOATS, 0.0, 1.0, 1e-38, 2.0**-100, 2.0**100, 2.0**127)
        head[chance.choice(("sigma", "low", "high"))] = chance.choice(numbers)


def _numbers(chance: random.Random, parts: Parts) -> Parts:
    """Change numbers of a plain file: tables, corrections, weights, biases and their units."""
    if not _is_plain(parts):
        raise NothingFitsError
    documents = documents_of(parts)
    names = [name for name in documents if name.startswith(NUMBERS)]
    name = chance.choice(names)
    document, turn = documents[name], chance.randrange(4)
    if turn == 0 and "scale" in document.get("attributes", {}):
        scale = document["attributes"]["scale"]
        document["attributes"]["scale"] = chance.choice(
            (*FLOATS, *OTHERS[:6], 0, scale / 2, scale * 2, scale / 3, -scale)
        )
        return replaced(parts, {f"{name}/{DOCUMENT}": dumped(document)})
    if turn == 1 and name == CORRECTIONS:
        gone = [(other, data) for other, data in parts if not other.startswith(f"{CORRECTIONS}/")]
        return gone if chance.random() < 0.5 else _retyped(chance, parts, name, document)
    member = chance.choice(_members(parts, name))
    values = _values(parts, member, document)
    with np.errstate(all="ignore"):
        for _ in range(chance.choice((1, 2, values.size))):
            at = chance.randrange(values.size)
            near = (float(values[at]) * 2, float(values[at]) / 3, -float(values[at]))
            values[at] = chance.choice((*SPECIAL, 2.0**63, 2.0**100, 0.5, 128.0, *near))
    return replaced(parts, {member: _stored(values)})


def _retyped(chance: random.Random, parts: Parts, name: str, document: dict[str, Any]) -> Parts:
    """Change the type of an array with all its chunks."""
    kind = chance.choice(("float32", "float64", "int32", "float16", "uint8"))
    new = {
        member: _stored(_values(parts, member, document).astype(kind))
        for member in _members(parts, name)
    }
    document["data_type"] = kind
    document["codecs"][0]["configuration"] = {} if kind == "uint8" else {"endian": "little"}
    return replaced(parts, {**new, f"{name}/{DOCUMENT}": dumped(document)})


def _giant_plain(chance: random.Random, parts: Parts) -> Parts:
    """Declare a giant volume of zeros in a plain file of a few kilobytes, with one tile."""
    if not _is_plain(parts):
        raise NothingFitsError
    root, _, header = header_of(parts)
    vertices = 1 << chance.choice((16, 18, 20, 22, 24))
    shape = [1, 1, 1, 1]
    while prod(shape) < vertices:
        shape[chance.randrange(4)] *= 2
    header["quality"].pop("steps", None)
    header["domain"]["shape"] = shape
    header["feature_bounding_box"] = [[0, n] for n in shape[1:]]
    header["variable"]["dtype"] = header["model"]["values"] = kind = chance.choice(list(DTYPES))
    wide = np.dtype(kind).itemsize > 2 and kind != "float32"
    header["model"].update(
        levels=[shape],
        tables=chance.choice(("float64" if wide else "float32", "float32")),
        tile=chance.choice((shape, [64] * 4, [2**20] * 4, [1] * 4)),
    )
    # A head is applied tile by tile, which takes some 50 us for the smallest tile.
    if chance.random() < 0.5 or (header["model"]["tile"] == [1] * 4 and vertices > 1 << 16):
        header["model"]["head"] = None
    header.pop("missing", None)
    bits = -(-prod(1 << (n - 1).bit_length() for n in shape[1:]) // 8)
    new: list[tuple[str, list[int], str]] = [
        ("tables/level_1", [*shape, 1], header["model"]["tables"]),
        ("key_frames", shape[:1], "int64"),
        ("occupancy/bits", [1, shape[0], bits], "uint8"),
        *(
            (f"coords/{axis}", [n], "float64")
            for axis, n in zip(("time", "z", "y", "x"), shape, strict=True)
        ),
    ]
    if chance.random() < 0.5:
        new.append(("corrections", shape, "float32"))
    gone = ("parts/", *(f"{name}/" for name in header["dimensions"]))
    head = "parts/0.mlp."
    kept = [
        (name, data)
        for name, data in parts
        if name.startswith(head) or not (name.startswith(gone) or name == DOCUMENT)
    ]
    kept.append((f"parts/{DOCUMENT}", dumped({"zarr_format": 3, "node_type": "group"})))
    for name, lengths, dtype in new:
        kept += array_of_zeros(name, lengths, dtype, path_of(header, name))
    return [*kept, (DOCUMENT, dumped(root))]


def array_of_zeros(name: str, shape: list[int], dtype: str, path: str = "") -> Parts:
    """Return the members of an array of one chunk; key frames and positions ascend.

    path: in the file; the name by default.
    """
    size = prod(shape)
    ascending = name.startswith(("key_frames", "coords"))
    values = np.arange(size, dtype=dtype) if ascending else np.zeros(size, dtype)
    if name.startswith("occupancy"):
        values[:] = 255
    assert values.nbytes <= GIANT_BYTES
    document = {
        "zarr_format": 3,
        "node_type": "array",
        "shape": shape,
        "data_type": dtype,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": shape}},
        "chunk_key_encoding": {"name": "default"},
        "fill_value": 0 if np.dtype(dtype).kind in "iu" else 0.0,
        "codecs": [
            {"name": "bytes", **({} if dtype == "uint8" else _LITTLE)},
            {"name": "zstd", "configuration": {"level": 1, "checksum": False}},
            {"name": "crc32c"},
        ],
    }
    chunk = f"{path or name}/c/" + "/".join("0" * len(shape))
    return [(f"{path or name}/{DOCUMENT}", dumped(document)), (chunk, _stored(values))]


_LITTLE = {"configuration": {"endian": "little"}}


def _occupancy(chance: random.Random, parts: Parts) -> Parts:
    """Change which vertices are in the coreset, in any of the arrays that say so."""
    documents = documents_of(parts)
    names = [name for name in documents if name.startswith(OCCUPANCY)]
    if not names:
        raise NothingFitsError
    root, top, header = header_of(parts)
    name, turn = chance.choice(names), chance.randrange(7)
    document = documents[name]
    if turn == 0:  # under another name, or beside itself
        other = chance.choice(("bits", "mask", "feature_1", "feature_2", "feature_3", "feature_9"))
        renamed = [
            (f"{OCCUPANCY}{other}/{member.removeprefix(f'{name}/')}", data)
            for member, data in parts
            if member.startswith(f"{name}/")
        ]
        taken = {member for member, _ in renamed}
        keep = chance.random() < 0.5
        kept = [
            (member, data)
            for member, data in parts
            if member not in taken and (keep or not member.startswith(f"{name}/"))
        ]
        return [*kept[:-1], *renamed, kept[-1]]
    if turn == 1:  # gone
        return [(member, data) for member, data in parts if not member.startswith(f"{name}/")]
    if turn == 2:
        features = top["required_features"]
        top["required_features"] = chance.choice(
            (features * 2, [*features, "sparse-tables"], [*features, "transform"], [])
        )
        return replaced(parts, {DOCUMENT: dumped(root)})
    if turn == 3:
        header["features"] = chance.choice(
            ([], ["all"], ["all"] * 2, ["interval:1:2"], ["interval:1:2"] * 40)
        )
        return replaced(parts, {DOCUMENT: dumped(root)})
    if coding(document) != "bytes":
        raise NothingFitsError  # kind "stream" and its like
    member = chance.choice(_members(parts, name))
    values = _values(parts, member, document)
    if turn == 4:
        values[:] = chance.choice((0, 255, 1, 128))
    else:
        for _ in range(chance.choice((1, 4, values.size))):
            values[chance.randrange(values.size)] ^= 1 << chance.randrange(8)
    return replaced(parts, {member: _stored(values)})


PLAIN_KINDS: dict[str, Callable[[random.Random, Parts], Parts]] = {
    "plain": _plain,
    "plain numbers": _numbers,
    "plain giant": _giant_plain,
    "occupancy": _occupancy,
}


NAMES = ("parts/0.tables.level_1", "parts/0.tables.level_2")


def _header(parts: Parts) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """Return what `header_of` gives for a file of sparse tables."""
    root, top, header = header_of(parts)
    if "sparse" not in header["model"]:
        raise NothingFitsError
    return root, top, header


def _sparse(chance: random.Random, parts: Parts) -> Parts:
    """Change what says which vertices a table has: header, counts, levels, features."""
    root, top, header = _header(parts)
    model, turn = header["model"], chance.randrange(7)
    if turn < 3:
        return _counts(chance, parts)
    if turn == 3:
        kinds = ("coreset", "fringe", "all", *OTHERS)
        model["sparse"] = chance.choice(kinds)
        if chance.random() < 0.2:
            del model["sparse"]
    elif turn == 4:
        names = ([], ["sparse-tables"] * 2, ["sparse-tables", "transform"], ["transform"])
        top["required_features"] = chance.choice(names)
        model["tables"] = chance.choice(("float16", "float32", "uint8", "transform"))
    elif turn == 5:
        levels = model["levels"]
        turned = [level[::-1] for level in levels]
        model["levels"] = chance.choice(
            (levels[:1], levels[:-1], [*levels, levels[-1]], levels[::-1], turned, levels[:1] * 3)
        )
    else:
        holder, key = chance.choice(list(places(model)))
        holder[key] = hostile(chance, holder[key])
    return replaced(parts, {DOCUMENT: dumped(root)})


def _counts(chance: random.Random, parts: Parts) -> Parts:
    """Change the counts of a table, often so that their sum stays."""
    name = chance.choice(NAMES)
    document = documents_of(parts)[name]
    counts = document["attributes"]["counts"]
    turn = chance.randrange(6)
    if turn < 2:
        a, b = chance.randrange(len(counts)), chance.randrange(len(counts))
        moved = chance.choice((1, counts[a], -1))
        counts[a] -= moved
        counts[b] += moved
    elif turn == 2:
        counts[chance.randrange(len(counts))] = chance.choice((*LARGE, *OTHERS, -1, 0, 1.5))
    elif turn == 3:
        document["attributes"]["counts"] = chance.choice(
            ([], counts[1:], [*counts, 0], counts[::-1], *OTHERS)
        )
    elif turn == 4:
        del document["attributes"]["counts"]
    else:
        document["shape"] = [sum(counts) + chance.choice((-1, 1, 1 << 40)), document["shape"][1]]
    return replaced(parts, {f"{name}/{DOCUMENT}": dumped(document)})


def _giant_sparse(chance: random.Random, parts: Parts) -> Parts:
    """Declare a giant volume in a file of a few kilobytes that has few or all of its vertices."""
    root, _, header = _header(parts)
    shape = [1, 1, 1, 1]
    vertices = 1 << chance.choice((16, 18, 20, 22, 24))
    while prod(shape) < vertices:
        shape[chance.randrange(1, 4)] *= 2
    header["quality"].pop("steps", None)
    header["domain"]["shape"] = shape
    header["feature_bounding_box"] = [[0, n] for n in shape[1:]]
    header["model"].update(levels=[shape], embedding_size=1, hidden_layers=0, tables="float16")
    bits = -(-prod(shape) // 8)
    rows = chance.choice((1, 8, vertices))
    arrays: list[tuple[str, list[int], str]] = [
        ("tables/level_1", [rows, 1], "float16"),
        ("mlp/weight_1", [1, 1], "float32"),
        ("mlp/bias_1", [1], "float32"),
        ("key_frames", [1], "int64"),
        ("occupancy/bits", [len(header["features"]), 1, bits], "uint8"),
        *(
            (f"coords/{axis}", [n], "float64")
            for axis, n in zip(("time", "z", "y", "x"), shape, strict=True)
        ),
    ]
    gone = ("parts/", *(f"{name}/" for name in header["dimensions"]))
    kept = [(name, data) for name, data in parts if not name.startswith(gone) and name != DOCUMENT]
    kept.append((f"parts/{DOCUMENT}", dumped({"zarr_format": 3, "node_type": "group"})))
    for name, lengths, dtype in arrays:
        kept += array_of_zeros(name, lengths, dtype, path_of(header, name))
    table = documents_of(kept)[NAMES[0]]
    table["attributes"] = {"counts": [rows]}
    return replaced([*kept, (DOCUMENT, dumped(root))], {f"{NAMES[0]}/{DOCUMENT}": dumped(table)})


SPARSE_KINDS: dict[str, Callable[[random.Random, Parts], Parts]] = {
    "sparse": _sparse,
    "sparse giant": _giant_sparse,
}
