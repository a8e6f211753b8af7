"""Mutations of the contents of chunks: streams of coders, indices and values.

All checksums are correct, so the contents reach the decoders.
"""

from __future__ import annotations

import base64
import json
import random
import struct
from collections.abc import Callable
from math import prod
from typing import Any

import numpy as np
from containers import Parts, with_crc
from documents import DOCUMENT
from numcodecs.zstd import compress, decompress

from fhash_formats.container.array import ArrayMetadata, Sharding, pack_index, parse_index
from fhash_formats.native import crc32c
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


KINDS: dict[str, Callable[[random.Random, Parts], Parts]] = {
    "bytes": bytes_changed,
    "stream": _stream,
    "index": _index,
    "values": values_changed,
}
