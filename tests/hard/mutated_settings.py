"""Mutations of the settings of decoders.

They change flags of tiles, settings of codecs, heads, bases and predictors, and declare giant
volumes.
"""

from __future__ import annotations

import copy
import random
import struct
import types
from collections.abc import Callable
from dataclasses import replace
from math import prod
from typing import Any

import numpy as np
from containers import Parts
from documents import DOCUMENT, dumped, header_of, hostile, path_of
from mutated_payload import (
    bytes_changed,
    chosen,
    configuration_of,
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
    tile_of,
    values_changed,
)

from fhash_formats.container.array import Sharding
from fhash_formats.container.header import KNOWN_FEATURES, PLAIN_FEATURE, TABLE
from fhash_formats.errors import InputError
from fhash_formats.support.values import DTYPES
from fhash_formats.transform.chunk import NO_TRANSFORM
from fhash_formats.transform.head import Layer, NeighbourHead, layer_inputs
from fhash_formats.transform.predict import passes_of
from fhash_formats.transform.spec import Basis
from fhash_formats.transform.tile_format import (
    EMPTY,
    LABELS,
    MASKED,
    OWN,
    PREDICTED,
    TRANSFORMED,
    TileSettings,
    pack_planes,
    parse_stream,
    seal,
    varint,
)

PLAIN = TileSettings(transform=NO_TRANSFORM, step=1.0, center=0.5, low=0.0, high=1.0)
"""Settings of tiles that have none."""
CODED_FEATURES = sorted(KNOWN_FEATURES - {PLAIN_FEATURE})
"""Features of files with coded tiles: all but those of files whose headers differ."""


def _flags(chance: random.Random, parts: Parts) -> Parts:
    """Change the flags of a coded tile, or give it settings of its own."""
    if not any(is_coded(document) for document in documents_of(parts).values()):
        return bytes_changed(chance, parts)
    _, document, member, data = chosen(chance, parts, True)
    sharding, present, chunks = inner_chunks(document, member, data)
    at = chance.randrange(len(chunks))
    stream = chunks[at]
    if chance.random() < 0.5:
        chunks[at] = sealed(bytes([chance.randrange(256)]) + stream[5:])
    else:
        parsed = parse_stream(stream)
        own = parsed.settings
        settings = settings_of(document) if own is None else TileSettings.from_bytes(own)
        block = _changed_settings(chance, settings or PLAIN, sharding.chunk_shape)
        others = sections_of(parsed)[own is not None :]
        chunks[at] = seal(stream[4] | OWN, [block, *others])
    return replaced(parts, {member: shard_of(sharding, present, chunks)})


def _settings(chance: random.Random, parts: Parts) -> Parts:
    """Change settings of a codec, with the features that they require.

    The settings are steps, ranges, transforms, heads, masks and predictors.
    """
    documents = documents_of(parts)
    coded = [name for name, document in documents.items() if is_coded(document)]
    if not coded:
        return values_changed(chance, parts)
    name = chance.choice(coded)
    document = documents[name]
    settings = settings_of(document) or PLAIN
    put_settings(document, _changed_settings(chance, settings, tile_of(document)))
    if chance.random() < 0.1:
        configuration = configuration_of(document)
        configuration["settings"] = hostile(chance, configuration["settings"])
    root, top, _ = header_of(parts)
    top["required_features"] = CODED_FEATURES
    return replaced(parts, {f"{name}/{DOCUMENT}": dumped(document), DOCUMENT: dumped(root)})


class Packed:
    """Stands for a basis or head of some bytes."""

    def __init__(self, data: bytes) -> None:
        self.data = data

    def to_bytes(self) -> bytes:
        return self.data


def _changed_settings(
    chance: random.Random, settings: TileSettings, shape: tuple[int, ...]
) -> bytes:
    """Return a block of other settings, most of them not allowed."""
    if chance.random() < 0.2:
        return damaged(chance, settings.to_bytes())
    changed = copy.copy(settings)
    for name, value in _other(chance, settings, shape).items():  # without the checks of settings
        object.__setattr__(changed, name, value)
    try:
        return changed.to_bytes()
    except (InputError, OverflowError, ValueError, struct.error):  # no such block
        return damaged(chance, settings.to_bytes())


def _other(chance: random.Random, settings: TileSettings, shape: tuple[int, ...]) -> dict[str, Any]:
    """Return some other values of settings."""
    turn = chance.randrange(8)
    numbers = (1e-300, 1e-38, 1.2e-38, 1e-12, 1.0, 1e12, 3.3e38, 1e300, 1.7e308)
    signed = (*numbers, *(-n for n in numbers), 0.0, np.nan, np.inf)
    if turn == 0:
        return {"step": chance.choice((*numbers, 0.0, -1.0)), "double": chance.random() < 0.5}
    if turn == 1:
        low, high = sorted(chance.choices(signed, k=2))
        return {"low": low, "high": high, "center": chance.choice(signed)}
    if turn == 2:
        count = len(settings.offsets)
        offsets = tuple(chance.choice((-128, 127, 0)) for _ in range(count))
        return {"quantum": chance.choice((*numbers, 0.0)), "offsets": offsets}
    if turn == 3:
        axes = list(settings.transform.axes)
        kind, depth = chance.choice(
            (("none", 0), ("haar", 1), ("haar", 10), ("5/3", 10), ("9/7", 10), ("9/7", 0))
        )
        axis = types.SimpleNamespace(kind=kind, depth=depth, basis=None)
        if chance.random() < 0.5:
            axis.kind, axis.depth, axis.basis = "klt", 0, _basis(chance, shape)
        axes[chance.randrange(4)] = axis
        return {"transform": types.SimpleNamespace(axes=tuple(axes))}
    if turn == 4:
        return {"head": _head(chance)}
    if turn == 5:
        edges = sorted(
            chance.choices((*numbers, -1.0, 0.0, 0.25, 0.5, 0.75), k=chance.randrange(16))
        )
        scores, others = (
            tuple(chance.choice((0, 1, 2048, 4095, 4096)) for _ in range(len(edges) + 1))
            for _ in range(2)
        )
        mask = {"edges": tuple(edges), "scores": scores, "reach": chance.choice((0, 1, 64, 65))}
        mask["others"] = chance.choice(((), others))
        return {"mask": types.SimpleNamespace(**mask)}
    if turn == 6:
        return {"predictor": _predictor(chance)}
    whole = (0, 1, -(1 << 63), (1 << 63) - 1, (1 << 53) + 1)
    low, high = sorted(chance.choices(whole, k=2))
    origin = chance.choice((*whole, (1 << 64) - 1, 1 << 64, -(1 << 71)))
    return {
        **{"low": low, "high": high, "origin": origin},
        **{name: chance.random() < 0.5 for name in ("clip", "labels")},
    }


def _basis(chance: random.Random, shape: tuple[int, ...]) -> Packed:
    """Return a packed basis, mostly of a wrong length."""
    n = min(chance.choice((*shape, 1, 2, 512)), 512)  # longer ones cannot be packed
    rank = chance.randrange(n + 1) if n < 40 else 3
    integers = np.zeros((rank, n), np.int32)
    integers[:, 0] = 1
    packed = Basis(integers=integers, exponents=(0,) * rank).to_bytes()
    if chance.random() < 0.5:
        packed = (
            struct.pack("<HH", chance.choice((n, 0, 513, 65535)), chance.choice((rank, 0, 65535)))
            + packed[4:]
        )
    return Packed(damaged(chance, packed) if chance.random() < 0.3 else packed)


def _head(chance: random.Random) -> Packed:
    """Return a packed head with extreme numbers."""
    cross = chance.random() < 0.4
    hidden = [chance.choice((1, 3, 14)) for _ in range(2 if cross else chance.randrange(1, 4))]
    inputs = layer_inputs(hidden, cross)
    rng = np.random.default_rng(chance.getrandbits(32))
    scales = (6.0e-8, 0.001, 1.0, 65504.0)
    layers = tuple(
        Layer(
            weights=rng.integers(-31, 32, (width, columns)).astype(np.int8),
            biases=rng.integers(-127, 128, width).astype(np.int8),
            weight_scale=float(np.float16(chance.choice(scales))),
            bias_scale=float(np.float16(chance.choice(scales))),
        )
        for width, columns in zip([*hidden, 1], inputs, strict=True)
    )
    ends = sorted(
        float(np.float32(value))
        for value in chance.choices((-3.4e38, -1.0, 0.0, 1e-45, 1.0, 2.0, 3.4e38), k=2)
    )
    sigma = float(np.float32(chance.choice((2.0**-100, 1e-6, 1.0, 2.0**100))))
    packed = NeighbourHead(
        layers=layers, sigma=sigma, low=ends[0], high=ends[1], cross=cross
    ).to_bytes()
    return Packed(damaged(chance, packed) if chance.random() < 0.3 else packed)


def _predictor(chance: random.Random) -> types.SimpleNamespace:
    """Return a predictor with extreme weights."""
    levels = [chance.choice((0, 1, 3, 8)) for _ in range(4)]
    order = chance.sample(range(4), 4)
    reach = chance.randrange(3)
    l0, l1, l2, l3 = levels
    o0, o1, o2, o3 = order
    count = sum(len(a_pass.taps) for a_pass in passes_of((l0, l1, l2, l3), (o0, o1, o2, o3), reach))
    return types.SimpleNamespace(
        step=chance.choice((1e-300, 1.0, 1e300, 0.0)),
        origin=chance.choice((0.0, 1e308, -1e308)),
        levels=levels,
        order=order,
        reach=chance.choice((reach, reach, 3)),
        weights=[chance.choice((-32767, 32767, 0, 4096, 32768)) for _ in range(count)],
    )


def _giant(chance: random.Random, parts: Parts) -> Parts:
    """Declare, in a file of a few kilobytes, a volume of up to 2^60 vertices in tiles of up to 2^30
    bytes.

    All tiles are empty.
    """
    root, top, header = header_of(parts)
    table = path_of(header, TABLE)
    document = documents_of(parts).get(table, {})
    if header["model"]["profile"] != "compact" or not is_coded(document):
        return values_changed(chance, parts)
    top["required_features"] = CODED_FEATURES
    kind = chance.choice(list(DTYPES))
    shape, chunk, shard = _giant_shapes(chance, header, kind)
    settings = settings_of(document)
    if settings is None or chance.random() < 0.7:
        settings = PLAIN
    elif chance.random() < 0.5:
        settings = replace(settings, transform=PLAIN.transform)
    document.update(shape=shape, data_type=kind, fill_value=0)
    document["chunk_grid"]["configuration"]["chunk_shape"] = shard
    inner = [{"name": "fhash.transform", "configuration": {"settings": settings.to_text()}}]
    index = [{"name": "bytes", "configuration": {"endian": "little"}}, {"name": "crc32c"}]
    sharded = {"chunk_shape": chunk, "codecs": inner, "index_codecs": index}
    document["codecs"] = [
        {"name": "sharding_indexed", "configuration": {**sharded, "index_location": "end"}}
    ]
    sharding = Sharding(shard_shape=tuple(shard), chunk_shape=tuple(chunk), codecs=())
    stream = _empty_stream(chance, np.dtype(kind).itemsize)
    present = sharding.present((0, 0, 0, 0), shape)
    chunks = [stream] * int(present.sum())
    new = {f"{table}/{DOCUMENT}": dumped(document), DOCUMENT: dumped(root)}
    kept = [
        (name, data)
        for name, data in parts
        if not name.startswith((f"{table}/c", "parts/0.missing."))
    ]
    shards = (f"{table}/c/0/0/0/0", shard_of(sharding, present, chunks))
    return [*replaced(kept, new), shards]


def _giant_shapes(
    chance: random.Random, header: dict[str, Any], kind: str
) -> tuple[list[int], list[int], list[int]]:
    """Declare a giant volume in a header, and return the shapes of the box, a tile and a shard."""
    room = (1 << chance.choice((20, 24, 28, 30, 31))) // np.dtype(kind).itemsize
    chunk = [1, 1, 1, 1]
    for axis in chance.sample(range(4), 4):
        chunk[axis] = 1 << chance.randrange(21)
        while prod(chunk) > room:
            chunk[axis] //= 2
    counts = [chance.choice((1, 1, 1, 2)) for _ in range(4)]
    shape = [
        max(1, min(1 << 20, n * count - chance.choice((0, 0, n // 3))))
        for n, count in zip(chunk, counts, strict=True)
    ]
    domain = [max(n, chance.choice((1, n, 2**20))) for n in shape]
    domain[0] = shape[0]
    header["quality"].pop("steps", None)
    header["domain"]["shape"] = domain
    header["feature_bounding_box"] = [[0, n] for n in shape[1:]]
    header["model"]["levels"] = [shape]
    header["model"]["tables"] = kind
    header["coordinates"] = {name: {} for name in ("time", "z", "y", "x")}
    return shape, chunk, [n * count for n, count in zip(chunk, counts, strict=True)]


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


KINDS: dict[str, Callable[[random.Random, Parts], Parts]] = {
    "flags": _flags,
    "settings": _settings,
    "giant": _giant,
}
