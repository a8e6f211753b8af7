"""Mutations of the settings of decoders.

They change flags of tiles, settings of codecs, heads, bases and predictors, and declare giant
volumes.
"""

from __future__ import annotations

import base64
import json
import random
import struct
import zlib
from collections.abc import Callable
from math import prod
from typing import Any

import numpy as np
from containers import Parts, with_crc
from documents import DOCUMENT, dumped, header_of, hostile, path_of, places
from mutated_payload import (
    bytes_changed,
    chosen,
    configuration_of,
    damaged,
    documents_of,
    inner_chunks,
    is_coded,
    replaced,
    section,
    shard_of,
    tile_of,
    values_changed,
)

from fhash_formats.container.header import KNOWN_FEATURES, PLAIN_FEATURE, TABLE
from fhash_formats.container.sharding import Sharding
from fhash_formats.support.number_types import DTYPES
from fhash_formats.transform.axes.basis import Basis
from fhash_formats.transform.entropy.coder import encode_block
from fhash_formats.transform.entropy.predictor import passes_of
from fhash_formats.transform.head.head import Layer, NeighbourHead, layer_inputs
from fhash_formats.transform.stream import MAX_TILE_VERTICES
from fhash_formats.transform.tile.sections import (
    EMPTY,
    EXACT,
    FORMAT,
    LABELS,
    LABELS_MASKED,
    MASKED,
    OWN,
    PREDICTED,
)

CODED_FEATURES = sorted(KNOWN_FEATURES - {PLAIN_FEATURE})
"""Features of files with coded tiles: all but those of files whose headers differ."""


def _flags(chance: random.Random, parts: Parts) -> Parts:
    """Change the flags of a coded tile, or give it settings of its own."""
    if not any(is_coded(document) for document in documents_of(parts).values()):
        return bytes_changed(chance, parts)
    _, document, member, data = chosen(chance, parts, True)
    sharding, present, chunks = inner_chunks(document, member, data)
    at = chance.randrange(len(chunks))
    stream = chunks[at][:-4]
    if chance.random() < 0.5:
        stream = bytes([chance.randrange(256)]) + stream[1:]
    else:
        configuration = json.loads(json.dumps(configuration_of(document)))
        _settings_changed(chance, configuration, sharding.chunk_shape)
        text = zlib.compress(
            chance.choice((dumped(configuration), b"[" * 100_000, b" " * (1 << 24), b"{}", b"3"))
        )
        head = 1 if stream[0] & (EXACT | EMPTY) else 5
        stream = bytes([stream[0] | OWN]) + stream[1:head] + section(text) + stream[head:]
    chunks[at] = with_crc(stream)
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
    _settings_changed(
        chance,
        configuration_of(document),
        tile_of(document),
    )
    root, top, _ = header_of(parts)
    top["required_features"] = CODED_FEATURES
    return replaced(parts, {f"{name}/{DOCUMENT}": dumped(document), DOCUMENT: dumped(root)})


def _settings_changed(
    chance: random.Random, settings: dict[str, Any], shape: tuple[int, ...]
) -> None:
    turn = chance.randrange(10)
    numbers = (1e-300, 1e-38, 1.2e-38, 1e-12, 1.0, 1e12, 3.3e38, 1e300, 1.7e308)
    if turn == 0:
        settings["step"] = chance.choice(numbers)
        settings["double"] = chance.random() < 0.5
    elif turn == 1:
        settings["range"] = sorted(chance.choices((*numbers, *(-n for n in numbers), 0.0), k=2))
        settings["center"] = chance.choice((*numbers, *(-n for n in numbers), 0.0))
    elif turn == 2:
        settings["quantum"] = chance.choice((*numbers, 0.0))
        settings["offsets"] = [chance.choice((-128, 128, 0, 129)) for _ in range(3)]
    elif turn == 3:
        axis = chance.choice("tzyx")
        kinds = (
            "none",
            ["haar", 1],
            ["haar", 10],
            ["5/3", 10],
            ["9/7", 10],
            ["9/7", 0],
            ["9/7", 11],
            ["klt", 1],
        )
        settings["transform"][axis] = chance.choice(kinds)
    elif turn == 4:
        settings["transform"][chance.choice("tzyx")] = {"klt": _basis(chance, shape)}
    elif turn == 5:
        settings["head"] = _head(chance)
    elif turn == 6:
        edges = sorted(
            chance.choices((*numbers, -1.0, 0.0, 0.25, 0.5, 0.75), k=chance.randrange(16))
        )
        scores = [chance.choice((0, 1, 2048, 4095, 4096)) for _ in range(len(edges) + 1)]
        settings["mask"] = {
            "edges": edges,
            "scores": scores,
            "reach": chance.choice((0, 1, 64, 65)),
        }
    elif turn == 7:
        settings["predictor"] = _predictor(chance)
    elif turn == 8:
        for name in ("clip", "labels", "many_labels"):
            settings[name] = chance.choice((True, True, False, 1, None))
        settings["origin"] = chance.choice((0, 1, -(1 << 63), (1 << 64) - 1, 1 << 64, 10**400, 2.0))
    else:
        holder, key = chance.choice(list(places(settings)))
        holder[key] = hostile(chance, holder[key])


def _basis(chance: random.Random, shape: tuple[int, ...]) -> str:
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
    return base64.b64encode(damaged(chance, packed) if chance.random() < 0.3 else packed).decode()


def _head(chance: random.Random) -> str:
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
    return base64.b64encode(damaged(chance, packed) if chance.random() < 0.3 else packed).decode()


def _predictor(chance: random.Random) -> dict[str, Any]:
    """Return a predictor with extreme weights."""
    levels = [chance.choice((0, 1, 3, 8)) for _ in range(4)]
    order = chance.sample(range(4), 4)
    reach = chance.randrange(3)
    l0, l1, l2, l3 = levels
    o0, o1, o2, o3 = order
    count = sum(len(a_pass.taps) for a_pass in passes_of((l0, l1, l2, l3), (o0, o1, o2, o3), reach))
    weights = np.array([chance.choice((-32767, 32767, 0, 4096)) for _ in range(count)], np.int32)
    packed = encode_block(weights.reshape(1, 1, 1, -1))
    packed = damaged(chance, packed) if chance.random() < 0.3 else packed
    return {
        "step": chance.choice((1e-300, 1.0, 1e300, 0.0)),
        "origin": chance.choice((0.0, 1e308, -1e308)),
        "levels": levels,
        "order": order,
        "reach": chance.choice((reach, reach, 3)),
        "weights": base64.b64encode(packed).decode(),
    }


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
    settings = configuration_of(document)
    plain = dict.fromkeys("tzyx", "none")
    if chance.random() < 0.7:
        settings = {"transform": plain, "step": 1.0, "center": 0.5, "range": [0.0, 1.0]}
    elif chance.random() < 0.5:
        settings["transform"] = plain
    document.update(shape=shape, data_type=kind, fill_value=0)
    document["chunk_grid"]["configuration"]["chunk_shape"] = shard
    checked = {"name": "crc32c"}
    inner = [{"name": "fhash.transform", "configuration": settings}, checked]
    index = [{"name": "bytes", "configuration": {"endian": "little"}}, checked]
    sharded = {"chunk_shape": chunk, "codecs": inner, "index_codecs": index}
    document["codecs"] = [
        {"name": "sharding_indexed", "configuration": {**sharded, "index_location": "end"}}
    ]
    sharding = Sharding(shard_shape=tuple(shard), chunk_shape=tuple(chunk), codecs=())
    stream = _empty_stream(chance, prod(chunk), np.dtype(kind).itemsize)
    present = sharding.present((0, 0, 0, 0), shape)
    chunks = [with_crc(stream)] * int(present.sum())
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


def _empty_stream(chance: random.Random, vertices: int, itemsize: int) -> bytes:
    """Return the stream of a tile of few bytes: empty, with empty sections, or of labels.

    vertices: of the tile.
    itemsize: bytes of a value.
    """
    stream = bytes([chance.choice((FORMAT, MASKED)) | EMPTY])
    turn = chance.random()
    if turn < 0.3:  # labels of one value: no byte is needed for any number of them
        packed = zlib.compress(bytes(itemsize))
        digest = 0
        for start in range(0, min(vertices, MAX_TILE_VERTICES), 1 << 20):
            digest = zlib.crc32(bytes(min(1 << 20, vertices - start)), digest)
        body = struct.pack("<II", digest, len(packed)) + packed
        stream = bytes([chance.choice((LABELS, LABELS, LABELS_MASKED))]) + section(body)
    elif turn < 0.6:
        sections = [b""] * chance.choice((1, 2, 3))
        stream = (
            bytes([chance.choice((FORMAT, MASKED, PREDICTED))])
            + zlib.crc32(b"").to_bytes(4, "little")
            + b"".join(map(section, sections))
        )
    return stream


KINDS: dict[str, Callable[[random.Random, Parts], Parts]] = {
    "flags": _flags,
    "settings": _settings,
    "giant": _giant,
}
