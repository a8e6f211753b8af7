"""Mutations of metadata documents, with correct checksums.

They put in hostile numbers and other types, remove keys, and give codecs strange settings.
"""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from copy import deepcopy
from typing import Any

from containers import Parts
from documents import DOCUMENT, FLOATS, LARGE, OTHERS, dumped, header_of, hostile, places

from fhash_formats.container.header import KNOWN_FEATURES


def _changed(
    chance: random.Random, parts: Parts, change: Callable[[dict[str, Any]], None], name: str = ""
) -> Parts:
    """Change one document: the one that is named, else the root or, as often, any other one."""
    documents = [other for other, _ in parts if other.endswith(DOCUMENT)]
    name = name or (DOCUMENT if chance.random() < 0.4 else chance.choice(documents))
    result = []
    for other, data in parts:
        if other == name:
            values = json.loads(data)
            change(values)
            data = dumped(values)
        result.append((other, data))
    return result


def _value(chance: random.Random, parts: Parts) -> Parts:
    """Replace one value, or a few."""

    def change(values: dict[str, Any]) -> None:
        for _ in range(chance.choice((1, 1, 1, 2, 4))):
            holder, key = chance.choice(list(places(values)))
            holder[key] = hostile(chance, holder[key])

    return _changed(chance, parts, change)


def _key(chance: random.Random, parts: Parts) -> Parts:
    """Remove, rename or add a key."""

    def change(values: dict[str, Any]) -> None:
        objects = [
            values,
            *(holder[key] for holder, key in places(values) if isinstance(holder[key], dict)),
        ]
        chosen = chance.choice([value for value in objects if value])
        key, turn = chance.choice(list(chosen)), chance.random()
        if turn < 0.5:
            del chosen[key]
        elif turn < 0.75:
            chosen[key + chance.choice(("x", "_", " "))] = chosen.pop(key)
        else:
            chosen[
                chance.choice(
                    ("novelty", "storage_transformers", "consolidated_metadata", "must_understand")
                )
            ] = chance.choice(OTHERS)

    return _changed(chance, parts, change)


def _length(chance: random.Random, parts: Parts) -> Parts:
    """Replace one length of the volume in all documents, so that they agree."""
    _, _, header = header_of(parts)
    old = chance.choice(header["domain"]["shape"])
    new = chance.choice((1, 2, old - 1, old + 1, old + 3, 2 * old, 100, 1000, *LARGE[:10]))
    result = []
    for name, data in parts:
        if name.endswith(DOCUMENT):
            values = json.loads(data)
            if name == DOCUMENT:
                values["attributes"]["fhash"]["variables"][0]["quality"].pop("steps", None)
            for holder, key in list(places(values)):
                if type(holder[key]) is int and holder[key] == old and isinstance(holder, list):
                    holder[key] = new
            data = dumped(values)
        result.append((name, data))
    return result


def _lengths(chance: random.Random, parts: Parts) -> Parts:
    """Make the domain larger than the box, with positions by rule."""

    def change(values: dict[str, Any]) -> None:
        header = chance.choice(values["attributes"]["fhash"]["variables"])
        shape = header["domain"]["shape"]
        for axis in chance.sample(range(4), chance.choice((1, 2, 4))):
            shape[axis] = max(shape[axis], chance.choice((100, 2**10, 2**20, 2**40)))
        if "coordinates" in header:
            header["coordinates"] = {name: _rule(chance) for name in ("time", "z", "y", "x")}

    return _changed(chance, parts, change, DOCUMENT)


def _rule(chance: random.Random) -> dict[str, Any]:
    numbers = (0, 1, -1, 1e308, -1e308, 1e-308, 5e-324, 1e-12, 3.5e5, 3.4e38, -0.0, 2**53, 1e16)
    rule: dict[str, Any] = {
        key: chance.choice(numbers) for key in ("start", "step") if chance.random() < 0.5
    }
    if chance.random() < 0.4:
        rule["dtype"] = chance.choice(("float32", "float32", "float64", "float16"))
    if chance.random() < 0.3:
        farthest = 2**52 - 1
        rule["ulps"] = chance.choices(
            (0, 1, -1, farthest, -farthest, 2**53), k=chance.choice((1, 2))
        )
    return rule


def _coordinates(chance: random.Random, parts: Parts) -> Parts:
    """Replace positions by absurd ones: all equal, beyond their type, descending, with vanishing
    steps."""

    def change(values: dict[str, Any]) -> None:
        header = chance.choice(values["attributes"]["fhash"]["variables"])
        for axis in chance.sample(("time", "z", "y", "x"), chance.choice((1, 1, 2, 4))):
            length = header["domain"]["shape"][("time", "z", "y", "x").index(axis)]
            listed = {
                "values": [
                    chance.choice((0, 1, -1, 1e308, -1e308, 5e-324, 2.5)) for _ in range(length)
                ]
            }
            header.setdefault("coordinates", {})[axis] = (
                listed if chance.random() < 0.4 else _rule(chance)
            )

    return _changed(chance, parts, change, DOCUMENT)


def _header(chance: random.Random, parts: Parts) -> Parts:
    """Replace numbers of the header on which decoding depends; each is allowed by itself."""

    def change(values: dict[str, Any]) -> None:
        top = values["attributes"]["fhash"]
        header = chance.choice(top["variables"])
        shape = header["domain"]["shape"]
        turn = chance.randrange(8)
        if turn == 0:
            header["value_range"] = sorted(chance.choices((*FLOATS, 0.0, 1.0), k=2))
        elif turn == 1:
            header["background"] = chance.choice(FLOATS)
        elif turn == 2:
            header["variable"]["dtype"] = chance.choice(
                ("int8", "uint8", "int64", "uint64", "float16", "float64", "int32")
            )
        elif turn == 3:
            low = [chance.randrange(n) for n in shape[1:]]
            header["feature_bounding_box"] = [
                [a, chance.randrange(a + 1, n + 1)] for a, n in zip(low, shape[1:], strict=True)
            ]
        elif turn == 4:
            top["format_version"] = chance.choice(
                ([2, 0], [2, 1], [2, 9999], [1, 8], [3, 0], [0, 1], [2, -1], [10**9, 0], [2])
            )
        elif turn == 5:
            names = (*sorted(KNOWN_FEATURES), "novelty", "")
            top["required_features"] = chance.sample(names, chance.randrange(len(names)))
        elif turn == 6:
            header["features"] = chance.choice(
                (
                    [],
                    ["all"],
                    ["interval:2:0.5"],
                    ["isosurface:nan"],
                    ["isosurface:1e300"],
                    ["x"] * 9,
                    ["\n"],
                )
            )
        else:
            header["history"] = chance.choice(
                (
                    [],
                    {},
                    {"epoch": []},
                    {"epoch": [1] * 70_000},
                    {"epoch": [None] * 9, "psnr": [1]},
                    {"epoch": [1], "psnr": [None]},
                )
            )
            header["quality"] = chance.choice(
                (
                    {},
                    {"psnr": None},
                    {"psnr": 1e308, "rmse": 0},
                    {"steps": []},
                    {"steps": {"rmse": [0] * (shape[0] + 1), "max_abs_error": 3}},
                )
            )

    return _changed(chance, parts, change, DOCUMENT)


def _array(chance: random.Random, parts: Parts) -> Parts:
    """Change the type, shapes or codecs of one array."""
    arrays = [
        name
        for name, data in parts
        if name.endswith(f"/{DOCUMENT}") and b'"node_type":"array"' in data
    ]

    def change(values: dict[str, Any]) -> None:
        grid = values["chunk_grid"]["configuration"]["chunk_shape"]
        codec = values["codecs"][0]
        lists = [
            values["shape"],
            grid,
            *(
                [codec["configuration"]["chunk_shape"]]
                if codec["name"] == "sharding_indexed"
                else []
            ),
        ]
        turn = chance.random()
        if turn < 0.25:
            values["data_type"] = chance.choice(
                (
                    "int8",
                    "uint8",
                    "int16",
                    "int64",
                    "uint64",
                    "float16",
                    "float32",
                    "float64",
                    "bool",
                    "complex64",
                )
            )
        elif turn < 0.75:
            for chosen in chance.sample(lists, chance.randrange(1, len(lists) + 1)):
                axis = chance.randrange(len(chosen))
                chosen[axis] = chance.choice(
                    (
                        1,
                        2,
                        chosen[axis] + 1,
                        chosen[axis] - 1,
                        2 * chosen[axis],
                        3 * chosen[axis],
                        *LARGE,
                    )
                )
        else:
            codecs = values["codecs"]
            codecs.insert(chance.randrange(len(codecs) + 1), deepcopy(chance.choice(codecs)))
            if chance.random() < 0.5:
                codecs.pop(chance.randrange(len(codecs)))

    return _changed(chance, parts, change, chance.choice(arrays))


def _text(chance: random.Random, parts: Parts) -> Parts:
    """Change bytes of a document."""
    documents = [name for name, _ in parts if name.endswith(DOCUMENT)]
    name = DOCUMENT if chance.random() < 0.4 else chance.choice(documents)
    snippets = (
        *(
            b"NaN",
            b"1e999",
            b'"a":1,"a":2,',
            b"\xff",
            b"\x00",
            b"[" * 70,
            b"[" * 200_000,
            b'{"a":' * 100_000,
            b"9" * 5000,
        ),
        *(b'"\\ud800"', b"-", b"//"),
    )

    def change(data: bytes) -> bytes:
        at = chance.randrange(len(data))
        turn = chance.random()
        if turn < 0.4:
            return data[:at] + bytes([data[at] ^ 1 << chance.randrange(8)]) + data[at + 1 :]
        if turn < 0.6:
            return data[:at]
        return data[:at] + chance.choice(snippets) + data[at + (chance.random() < 0.5) :]

    return [(other, change(data) if other == name else data) for other, data in parts]


KINDS: dict[str, Callable[[random.Random, Parts], Parts]] = {
    "text": _text,
    "value": _value,
    "key": _key,
    "length": _length,
    "domain": _lengths,
    "coordinates": _coordinates,
    "header": _header,
    "array": _array,
}
