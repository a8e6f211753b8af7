"""Mutations of what version 1.2 of the format added: tiles of labels, clipped values, fill values.

All checksums are correct, and so are the digests of labels, unless the digest itself is changed. A
file without what a kind changes is passed over.
"""

from __future__ import annotations

import random
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
from containers import Parts, with_crc
from documents import DOCUMENT, FLOATS, OTHERS, dumped, header_of, path_of
from mutated_payload import (
    NothingFitsError,
    configuration_of,
    damaged,
    documents_of,
    inner_chunks,
    is_coded,
    labelled_body,
    replaced,
    shard_of,
)

from fhash_formats.container.header import TABLE
from fhash_formats.support.number_types import DTYPES
from fhash_formats.transform.entropy.labels import MAX_LABELS, MAX_NARROW
from fhash_formats.transform.tile.sections import (
    EXACT,
    LABELS,
    LABELS_MASKED,
    MANY,
    MISSING,
    OWN,
    RESIDUAL,
    parse_stream,
    section,
)

Bytes = bytes | memoryview


def _labelled(parts: Parts) -> list[tuple[str, int]]:
    """Return the shards and numbers of all tiles of labels."""
    found, documents = [], documents_of(parts)
    for member, data in parts:
        document = documents.get(member.partition("/c/")[0])
        if "/c/" not in member or document is None or not is_coded(document):
            continue
        _, _, chunks = inner_chunks(document, member, data)
        found += [
            (member, number)
            for number, chunk in enumerate(chunks)
            if chunk[0] & 0xE0 in (LABELS, LABELS_MASKED)
        ]
    return found


def _labels(chance: random.Random, parts: Parts) -> Parts:
    """Change the palette, the labels, the digest or the flags of a tile of labels."""
    found = _labelled(parts)
    if not found:
        raise NothingFitsError
    member, number = chance.choice(found)
    document = documents_of(parts)[member.partition("/c/")[0]]
    sharding, present, chunks = inner_chunks(document, member, dict(parts)[member])
    dtype = np.dtype(document["data_type"])
    stream = _labels_changed(chance, chunks[number][:-4], dtype, sharding.chunk_shape)
    chunks[number] = with_crc(stream)
    return replaced(parts, {member: shard_of(sharding, present, chunks)})


def _labels_changed(
    chance: random.Random, stream: bytes, dtype: np.dtype[Any], shape: tuple[int, ...]
) -> bytes:
    """Return another stream of labels: a valid one, unless a decoder refuses it."""
    sections, flags = parse_stream(stream).sections(), stream[0]
    masked, body = flags & 0xE0 == LABELS_MASKED, sections[-1]
    size = int.from_bytes(body[4:8], "little")
    packed: bytes = body[8 : 8 + size]
    coded = body[8 + size :]
    plain = zlib.decompress(packed)
    bits = _unpacked(plain, dtype) if flags & MANY else np.frombuffer(plain, f"<u{dtype.itemsize}")
    turn = chance.randrange(10)
    if turn == 0:  # other values
        packed = _packed(_palette(chance, bits, dtype), flags)
    elif turn == 1:  # another number of values
        counts = (
            0,
            1,
            2,
            len(bits) - 1,
            len(bits) + 1,
            MAX_NARROW,
            MAX_LABELS - 1,
            MAX_LABELS,
            257,
            70_000,
        )
        most = 1 << min(8 * dtype.itemsize, 20)
        packed = _packed(np.arange(min(chance.choice(counts), most), dtype=bits.dtype), flags)
    elif turn == 2:  # values that do not ascend
        order = chance.choice((bits[::-1], np.repeat(bits, 2), np.roll(bits, 1), bits[:1] * 0))
        packed = _packed(order, flags)
    elif turn == 3:  # bytes that are no palette
        packed = chance.choice(
            (
                *(packed + b"x", packed[:-1], b"", damaged(chance, packed)),
                zlib.compress(bits.tobytes() + b"x"),
                zlib.compress(bytes(1 << 26)),
            )
        )
    elif turn in (4, 5):  # other labels
        coded = damaged(chance, coded)
    elif turn == 6:  # with a mask or without one
        masked = not masked
        flags ^= LABELS ^ LABELS_MASKED
    elif turn == 7:
        flags ^= chance.choice((OWN, MISSING, RESIDUAL, EXACT, MANY, MANY, 0xE0, 0x60))
    body = labelled_body(packed, coded, dtype, shape, masked=masked)
    if turn == 8:  # another digest, or another length of the palette
        at = chance.choice((0, 4))
        number = chance.choice((0, 1, len(body) - 8, len(body) - 7, len(body), 2**32 - 1))
        body = body[:at] + number.to_bytes(4, "little") + body[at + 4 :]
    sections = [*sections[:-1], body]
    if turn == 9:
        sections = chance.choice(
            ([], [b""], sections * 2, [*sections, b""], [body[:7]], [body[:8]], [b"", *sections])
        )
    return bytes([flags]) + b"".join(map(section, sections))


def _unpacked(plain: bytes, dtype: np.dtype[Any]) -> Any:
    """Return the palette of many labels, whose differences stand in planes of bytes."""
    planes = np.frombuffer(plain, np.uint8).reshape(dtype.itemsize, -1)
    steps = np.ascontiguousarray(planes.T).view(f"<u{dtype.itemsize}").reshape(-1)
    return np.cumsum(steps, dtype=steps.dtype)


def _packed(palette: Any, flags: int) -> bytes:
    """Return a deflated palette, in the form that the flags of its stream say."""
    if not flags & MANY:
        return zlib.compress(palette.tobytes())
    steps = np.diff(palette, prepend=palette.dtype.type(0))
    return zlib.compress(steps.view(np.uint8).reshape(-1, steps.itemsize).T.tobytes())


def _palette(chance: random.Random, bits: Any, dtype: np.dtype[Any]) -> Any:
    """Return the bits of as many other values: extreme ones, NaN among floats, or random ones."""
    most = (1 << 8 * dtype.itemsize) - 1
    chosen = {int(bit) for bit in bits}
    for bit in chance.sample(sorted(chosen), min(len(chosen), chance.choice((1, 2, 300)))):
        chosen.discard(bit)
        specials = [0, 1, most, most >> 1, (most >> 1) + 1, chance.randint(0, most)]
        if dtype.kind == "f":
            most_float = np.finfo(dtype).max
            numbers = np.array((np.nan, np.inf, -np.inf, most_float, -most_float, -0.0), dtype)
            specials += [int(special) for special in numbers.view(f"u{dtype.itemsize}")]
        free = [special for special in specials if special not in chosen]
        chosen.add(chance.choice(free) if free else bit)
    return np.array(sorted(chosen), bits.dtype)


def _clip(chance: random.Random, parts: Parts) -> Parts:
    """Change the range to which values are clipped, the switch, or the features of the header.

    Without an error all decoded values lie in the range (hostile_trial.py checks it).
    """
    root, top, header = header_of(parts)
    table = path_of(header, TABLE)
    document = documents_of(parts).get(table, {})
    settings = configuration_of(document) if document and is_coded(document) else {}
    if "clip" not in settings:
        raise NothingFitsError
    low, high = settings["range"]
    middle = (low + high) / 2
    turn = chance.randrange(7)
    if turn == 0:
        settings["clip"] = chance.choice((False, "true", 1, 0, None, [True], {}))
    elif turn in (1, 2):
        settings["range"] = chance.choice(
            (
                *([low, low], [high, high], [middle, middle], [middle, high], [low, middle]),
                *([high, low], [-0.0, 0.0], [low - 1, high + 1], [5e-324, 1e-323]),
                *([-1e300, 1e300], [-3.4e38, 3.4e38], [3.5e38, 3.6e38], [-1e39, -1e38]),
                *([1e308, 1.7e308], [low, 10**400], [low], [low, high, high], [None, high]),
            )
        )
    elif turn == 3:  # residuals far beyond the range
        settings["quantum"] = chance.choice((*FLOATS, 1e6, 1e30, 1e300, 2.0**1000))
    elif turn == 4:
        header["value_range"] = chance.choice(
            ([low - 9, low - 8], [middle, middle], [high, high], [0, 0], [-3e38, 3e38])
        )
    elif turn == 5:
        features = top["required_features"]
        top["required_features"] = chance.choice(([*features, "clip"], features * 2, []))
    else:
        top["format_version"] = chance.choice(([1, 8], [2, 1], [2, 2], [3, 0]))
        settings["double"] = chance.random() < 0.5
    return replaced(parts, {f"{table}/{DOCUMENT}": dumped(document), DOCUMENT: dumped(root)})


FILLS: tuple[Any, ...] = (
    *(0, 1, -1, 127, 128, -128, -129, 255, 256, 32767, 2**31, 2**53 + 1, 2**63 - 1, 2**63),
    *(-(2**63), 2**64, 10**30, 10**400, 0.5, -0.0, 1e300, 5e-324, float("nan"), float("inf")),
)
"""Fill values: within and beyond each integer type, and none of a whole number."""


def _integers(chance: random.Random, parts: Parts) -> Parts:
    """Change the type of integers, their fill value, and what stands for missing ones."""
    root, _, header = header_of(parts)
    table = path_of(header, TABLE)
    document = documents_of(parts).get(table, {})
    variable, model = header["variable"], header["model"]
    if not document or np.dtype(variable["dtype"]).kind not in "iu":
        raise NothingFitsError
    turn = chance.randrange(6)
    if turn == 0:
        variable["fill"] = chance.choice(FILLS)
    elif turn == 1:
        variable["fill"] = chance.choice(OTHERS)
    elif turn == 2:  # another type everywhere: in the header, the model and the array
        kind = chance.choice(list(DTYPES))
        variable["dtype"] = model["tables"] = document["data_type"] = kind
        variable["fill"] = chance.choice(FILLS)
    elif turn == 3:  # types that contradict each other
        holder, key = chance.choice(
            ((variable, "dtype"), (model, "tables"), (document, "data_type"))
        )
        holder[key] = chance.choice(list(DTYPES))
    elif turn == 4:
        document["fill_value"] = chance.choice((*FILLS, *OTHERS))
    else:
        header["features"] = chance.choice((["all"], ["isosurface:0"], [], None, 0))
        header["coreset_fraction"] = chance.choice((0, 0.5, 1, 1.5, -1, 1e300))
        header["background"] = chance.choice((*FLOATS, 127, 128, 1e30))
        if chance.random() < 0.5:
            variable.pop("fill", None)
    return replaced(parts, {f"{table}/{DOCUMENT}": dumped(document), DOCUMENT: dumped(root)})


KINDS: dict[str, Callable[[random.Random, Parts], Parts]] = {
    "labels": _labels,
    "clip": _clip,
    "integers": _integers,
}
