"""Mutations of the contents of chunks: streams of coders, indices and values.

All checksums are correct, so the contents reach the decoders.
"""

from __future__ import annotations

import contextlib
import json
import random
import struct
import zlib
from collections.abc import Callable
from math import prod
from typing import Any

import numpy as np
from containers import Parts, with_crc
from documents import DOCUMENT
from numcodecs.zstd import compress, decompress

from fhash_formats.container.array import ArrayMetadata
from fhash_formats.container.sharding import Sharding, pack_index, parse_index
from fhash_formats.errors import FhashError
from fhash_formats.transform.array_axes import take_axes
from fhash_formats.transform.axes.bands import band_table
from fhash_formats.transform.entropy.coder import decode_integers
from fhash_formats.transform.entropy.labels import MAX_LABELS, decode_labels
from fhash_formats.transform.entropy.mask import decode_mask
from fhash_formats.transform.entropy.predict import decode_predicted
from fhash_formats.transform.entropy.table import single_band
from fhash_formats.transform.tile.decoding import linear_values, predicted_values, transform_for
from fhash_formats.transform.tile.sections import (
    MISSING,
    OWN,
    RESIDUAL,
    little_endian,
    parse_stream,
    section,
    unpack_settings,
)
from fhash_formats.transform.tile.settings import TileSettings

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
    """Return the sharding of an array, which inner chunks a shard has, and these with their
    CRC-32C."""
    metadata = ArrayMetadata.from_dict(document)
    sharding = metadata.sharding
    if sharding is None:
        tile = metadata.chunk_shape
        return OneTile(shard_shape=tile, chunk_shape=tile, codecs=()), np.ones(1, bool), [data]
    shard = tuple(int(i) for i in member[member.rindex("/c/") + 3 :].split("/"))
    present = sharding.present(shard, metadata.shape)
    index = parse_index(data[-sharding.index_bytes :], present, len(data) - sharding.index_bytes)
    return sharding, present, [data[offset : offset + size] for offset, size in index[present]]


def shard_of(sharding: Sharding, present: np.ndarray[Any, Any], chunks: list[bytes]) -> bytes:
    if isinstance(sharding, OneTile):
        return b"".join(chunks)
    return b"".join(chunks) + pack_index([len(chunk) for chunk in chunks], present)


def bytes_changed(chance: random.Random, parts: Parts) -> Parts:
    """Change bytes of a chunk as stored, with a correct CRC-32C."""
    _, document, member, data = chosen(chance, parts)
    if not is_coded(document):
        return replaced(parts, {member: with_crc(damaged(chance, data[:-4]))})
    sharding, present, chunks = inner_chunks(document, member, data)
    at = chance.randrange(len(chunks))
    chunks[at] = with_crc(damaged(chance, chunks[at][:-4]))
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


def _stream(chance: random.Random, parts: Parts) -> Parts:
    """Change sections of a coded tile, with correct digests of what they decode to.

    The result is another valid tile, unless a decoder refuses it.
    """
    if not any(is_coded(document) for document in documents_of(parts).values()):
        return values_changed(chance, parts)
    _, document, member, data = chosen(chance, parts, True)
    sharding, present, chunks = inner_chunks(document, member, data)
    at = chance.randrange(len(chunks))
    whole, axes = take_axes(configuration_of(document))
    shape = sharding.chunk_shape if axes is None else axes.tile_shape(sharding.chunk_shape)
    dtype = np.dtype(document["data_type"])
    stream = chunks[at][:-4]
    if "transform" in whole:
        settings = TileSettings.from_dict(whole)
    else:  # tiles have settings of their own, or need none
        own = parse_stream(stream).settings
        if own is None:
            raise NothingFitsError
        settings = unpack_settings(own)
    chunks[at] = with_crc(_restreamed(chance, stream, settings, shape, dtype))
    return replaced(parts, {member: shard_of(sharding, present, chunks)})


def _restreamed(
    chance: random.Random,
    stream: bytes,
    settings: TileSettings,
    shape: tuple[int, ...],
    dtype: np.dtype[Any],
) -> bytes:
    parts = parse_stream(stream)
    flags, sections = parts.flags, parts.sections()
    if parts.labelled:
        body = sections[-1]
        start = 8 + int.from_bytes(body[4:8], "little")
        sections[-1] = labelled_body(
            body[8:start], damaged(chance, body[start:]), dtype, shape, masked=parts.masked
        )
        return stream[:1] + b"".join(map(section, sections))
    if not parts.coded:
        return stream[:1] + b"".join(section(damaged(chance, data)) for data in sections)
    first = bool(flags & OWN) + bool(flags & MISSING)
    at = chance.randrange(first, len(sections))
    sections[at] = damaged(chance, sections[at])
    if (
        chance.random() < 0.15 and not flags & RESIDUAL and not parts.predicted
    ):  # a residual where none was
        flags |= RESIDUAL
        sections.insert(first + 1, chance.randbytes(chance.randrange(200)))
    try:
        if parts.predicted and settings.predictor is not None:
            integers = decode_predicted(sections[first], shape, settings.predictor)
        else:
            table = band_table(settings.transform, shape)
            integers = decode_integers(sections[first], shape, table, trellis=settings.trellis)
        digest = zlib.crc32(little_endian(integers))
        if flags & RESIDUAL:
            residual = decode_integers(sections[first + 1], shape, single_band(shape))
            digest = zlib.crc32(little_endian(residual), digest)
        if parts.masked and settings.mask is not None and sections[-1]:
            sections[-1] = _mask_section(
                sections[-1][2:], integers, settings, shape, parts.predicted
            )
    except FhashError:
        digest = chance.getrandbits(32)
    return bytes([flags]) + digest.to_bytes(4, "little") + b"".join(map(section, sections))


def labelled_body(
    packed: bytes, coded: bytes, dtype: np.dtype[Any], shape: tuple[int, ...], *, masked: bool
) -> bytes:
    """Return the section of a tile of labels, with the digest of the labels to which it decodes.

    packed: the deflated palette. If its length is not that of a palette, the digest is 0.
    """
    with contextlib.suppress(zlib.error):
        plain = zlib.decompressobj().decompress(packed, 1 << 20)
        count = len(plain) // dtype.itemsize + masked
        if 1 <= count <= MAX_LABELS:
            digest = zlib.crc32(decode_labels(coded, count, shape).data)
            return struct.pack("<II", digest, len(packed)) + packed + coded
    return struct.pack("<II", 0, len(packed)) + packed + coded


def _mask_section(
    coded: bytes, integers: Any, settings: TileSettings, shape: tuple[int, ...], predicted: bool
) -> bytes:
    """Return a coded mask after the digest of the mask to which it decodes."""
    assert settings.mask is not None
    with np.errstate(all="ignore"):
        if predicted and settings.predictor is not None:
            linear = predicted_values(integers, settings.predictor, settings)
        else:
            linear = linear_values(integers, transform_for(settings, shape), settings)  # type: ignore[arg-type]
        mask = decode_mask(coded, settings.mask.levels(linear.astype(settings.dtype)))
    return (zlib.crc32(np.packbits(mask).data) & 0xFFFF).to_bytes(2, "little") + coded


KINDS: dict[str, Callable[[random.Random, Parts], Parts]] = {
    "bytes": bytes_changed,
    "stream": _stream,
    "index": _index,
    "values": values_changed,
}
