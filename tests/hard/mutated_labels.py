"""Mutations of tiles of labels, of clipped values and of fill values.

All checksums are correct. A file without what a kind changes is passed over.
"""

from __future__ import annotations

import copy
import random
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
from containers import Parts
from documents import DOCUMENT, FLOATS, OTHERS, dumped, header_of, path_of
from mutated_payload import (
    NothingFitsError,
    damaged,
    documents_of,
    inner_chunks,
    is_coded,
    put_settings,
    replaced,
    sealed,
    sections_of,
    settings_of,
    shard_of,
)

from fhash_formats.container.header import TABLE
from fhash_formats.errors import InputError
from fhash_formats.support.values import DTYPES
from fhash_formats.transform.coder import MAX_LABELS
from fhash_formats.transform.tile_format import (
    KIND,
    LABELS,
    MASKED,
    MISSING,
    OWN,
    RESIDUAL,
    pack_planes,
    parse_stream,
    read_varint,
    seal,
    varint,
)


def _labelled(parts: Parts) -> list[tuple[str, int]]:
    """Return the shards and numbers of all tiles of labels."""
    found, documents = [], documents_of(parts)
    for member, data in parts:
        document = documents.get(member.partition("/c/")[0])
        if "/c/" not in member or document is None or not is_coded(document):
            continue
        _, _, chunks = inner_chunks(document, member, data)
        found += [
            (member, number) for number, chunk in enumerate(chunks) if chunk[4] & KIND == LABELS
        ]
    return found


def _labels(chance: random.Random, parts: Parts) -> Parts:
    """Change the palette, the labels or the flags of a tile of labels."""
    found = _labelled(parts)
    if not found:
        raise NothingFitsError
    member, number = chance.choice(found)
    document = documents_of(parts)[member.partition("/c/")[0]]
    sharding, present, chunks = inner_chunks(document, member, dict(parts)[member])
    dtype = np.dtype(document["data_type"])
    chunks[number] = _labels_changed(chance, chunks[number], dtype)
    return replaced(parts, {member: shard_of(sharding, present, chunks)})


def _labels_changed(chance: random.Random, stream: bytes, dtype: np.dtype[Any]) -> bytes:
    """Return another stream of labels: a valid one, unless a decoder refuses it."""
    sections, flags = sections_of(parse_stream(stream)), stream[4]
    size, rest = read_varint(memoryview(sections[-1]))
    length, rest = read_varint(rest)
    packed, coded = bytes(rest[:length]), bytes(rest[length:])
    planes = np.frombuffer(zlib.decompress(packed), np.uint8).reshape(dtype.itemsize, -1)
    steps = np.ascontiguousarray(planes.T).view(f"<u{dtype.itemsize}").reshape(-1)
    bits = np.cumsum(steps, dtype=steps.dtype)
    turn = chance.randrange(10)
    if turn == 0:  # other values
        packed = _packed(_palette(chance, bits, dtype))
    elif turn == 1:  # another number of values
        counts = (0, 1, 2, size - 1, size + 1, 256, 257, MAX_LABELS - 1, MAX_LABELS, 70_000)
        most = 1 << min(8 * dtype.itemsize, 20)
        size = min(chance.choice(counts), most)
        packed = _packed(np.arange(size, dtype=bits.dtype))
    elif turn == 2:  # values that do not ascend
        order = chance.choice((bits[::-1], np.repeat(bits, 2), np.roll(bits, 1), bits[:1] * 0))
        size, packed = len(order), _packed(order)
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
        flags ^= MASKED
    elif turn == 7:
        flags ^= chance.choice((OWN, MISSING, RESIDUAL, MASKED, 1, 3, 4, 128))
    length = len(packed)
    if turn == 8:  # another number of values, or another length of the palette
        number = chance.choice((0, 1, len(coded), length - 1, length + 1, 2**32 - 1, 2**35 - 1))
        size, length = chance.choice(((number, length), (size, number)))
    sections[-1] = varint(size) + varint(length) + packed + coded
    if turn == 9:
        body = sections[-1]
        return sealed(
            bytes([flags]) + chance.choice((b"", body[:1], body[:2], body * 2, b"\xff" * 9))
        )
    return seal(flags, sections)


def _packed(palette: Any) -> bytes:
    """Return a packed palette."""
    return pack_planes(np.diff(palette, prepend=palette.dtype.type(0)))


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
    settings = settings_of(document) if document and is_coded(document) else None
    if settings is None or not settings.clip:
        raise NothingFitsError
    settings = copy.copy(settings)

    def put(**values: Any) -> None:  # without the checks of settings
        for name, value in values.items():
            object.__setattr__(settings, name, value)

    low, high = float(settings.low), float(settings.high)
    middle = (low + high) / 2
    turn = chance.randrange(6)
    if turn == 0:
        put(clip=False)
    elif turn in (1, 2):
        ends = chance.choice(
            (
                *([low, low], [high, high], [middle, middle], [middle, high], [low, middle]),
                *([high, low], [-0.0, 0.0], [low - 1, high + 1], [5e-324, 1e-323]),
                *([-1e300, 1e300], [-3.4e38, 3.4e38], [3.5e38, 3.6e38], [-1e39, -1e38]),
                *([1e308, 1.7e308], [low, float("inf")], [float("nan"), high]),
            )
        )
        put(low=ends[0], high=ends[1])
    elif turn == 3:  # residuals far beyond the range
        put(quantum=chance.choice((*FLOATS, 1e6, 1e30, 1e300, 2.0**1000)))
    elif turn == 4:
        header["value_range"] = chance.choice(
            ([low - 9, low - 8], [middle, middle], [high, high], [0, 0], [-3e38, 3e38])
        )
    else:
        top["format_version"] = chance.choice(([1, 8], [2, 1], [2, 2], [3, 0]))
        put(double=chance.random() < 0.5)
    try:
        put_settings(document, settings.to_bytes())
    except (InputError, OverflowError, ValueError) as error:  # whole ends have no fractions
        raise NothingFitsError from error
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
