"""Mutations of plain files, and of occupancy in arrays.

All checksums are correct. A file without what a kind changes is passed over.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from math import prod
from typing import Any

import numpy as np
from containers import Parts, with_crc
from documents import DOCUMENT, FLOATS, LARGE, OTHERS, dumped, header_of, hostile, path_of, places
from mutated_payload import SPECIAL, NothingFitsError, coding, documents_of, replaced
from numcodecs.zstd import compress, decompress

from fhash_formats.container.header import KNOWN_FEATURES
from fhash_formats.support.values import DTYPES

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


KINDS: dict[str, Callable[[random.Random, Parts], Parts]] = {
    "plain": _plain,
    "plain numbers": _numbers,
    "plain giant": _giant_plain,
    "occupancy": _occupancy,
}
