"""Containers as members, and mutations of their metadata documents, with correct checksums."""

from __future__ import annotations

import json
import math
import random
import zlib
from collections.abc import Callable, Iterable, Iterator
from copy import deepcopy
from typing import Any

from fhash_formats.container.header import KNOWN_FEATURES, POSITIONS, TABLE
from fhash_formats.container.hierarchy import part_place
from fhash_formats.container.zip_file import (
    END,
    Member,
    Source,
    comment,
    ending,
    local_header,
    read_member,
    read_members,
)
from fhash_formats.native import crc32c

Parts = list[tuple[str, bytes]]
"""Name and inflated data of each member, in the order of the file."""


class BytesSource(Source):
    """A file in memory, as a source of a reader."""

    def __init__(self, data: bytes) -> None:
        self.data, self.size = data, len(data)

    def read(self, offset: int, size: int) -> bytes:
        """Return `size` bytes from `offset` on."""
        return self.data[offset : offset + size]

    def close(self) -> None:
        """Do nothing: there is no file to close."""


def unpack(data: bytes) -> Parts:
    """Return the members of a sound container, with documents inflated."""
    source = BytesSource(data)
    return [
        (name, bytes(read_member(source, member))) for name, member in read_members(source).items()
    ]


def pack(parts: Iterable[tuple[str, bytes]]) -> bytes:
    """Return a file of any members, with correct checksums."""
    return pack_members([(name, data, None, zlib.crc32(data)) for name, data in parts])


def pack_members(given: Iterable[tuple[str, bytes, int | None, int]]) -> bytes:
    """Return a file of members as they are given.

    A member is (name, data as stored, declared full size if deflated, declared CRC-32).
    """
    members, chunks, position = [], [], 0
    for name, data, full_size, crc in given:
        member = Member(name=name, offset=position, size=len(data), crc=crc, full_size=full_size)
        members.append(member)
        chunks += [local_header(member), data]
        position = member.end
    return b"".join([*chunks, ending(members)])


def directory_of(data: bytes) -> int:
    """Return the offset of the directory of a sound file."""
    return int(END.unpack_from(data, len(data) - len(comment(b"")) - END.size)[6])


def resealed(data: bytes, start: int) -> bytes:
    """Return the file with a correct digest of its directory, which begins at `start`."""
    directory = data[start : -len(comment(b""))]
    return data[:start] + directory + comment(directory)


def with_crc(data: bytes) -> bytes:
    """Return the data of a chunk with their CRC-32C."""
    return data + crc32c(data).to_bytes(4, "little")


DOCUMENT = "zarr.json"
"""End of the names of metadata documents; alone, the name of the root's."""
LARGE = (
    *(
        2**16,
        2**20,
        2**24,
        2**28,
        2**31 - 1,
        2**31,
        2**32,
        2**40,
        2**53 + 1,
        2**60,
        2**62,
        2**63 - 1,
        2**63,
        2**64 - 1,
        2**64,
    ),
    *(10**30, 10**400),
)
NUMBERS: tuple[Any, ...] = (0, 1, 2, 3, 5, 7, 10, 11, 64, -1, -(2**60), -(2**63), *LARGE)
FLOATS = (
    0.5,
    -0.5,
    -0.0,
    1.5,
    1e-12,
    1e308,
    -1e308,
    1.7976931348623157e308,
    2.3e-308,
    5e-324,
    3.4e38,
    -3.4e38,
    1e-45,
    1e39,
    1e16,
)
SPECIAL = (math.nan, math.inf, -math.inf)
OTHERS: tuple[Any, ...] = (
    *(
        True,
        False,
        None,
        "",
        "x",
        "9/7",
        "klt",
        "\x00",
        "../x",
        "1",
        "\ud7ff",
        "\n",
        "NaN",
        "x" * 70_000,
        [],
        [0],
        [[]],
        {},
        {"a": 1},
    ),
    *([1] * 70_000, [None] * 5, {"must_understand": False}, {str(n): n for n in range(3000)}),
)


def _nest(depth: int) -> Any:
    """Return dicts and lists that are nested in turns."""
    value: Any = 1
    for level in range(depth):
        value = [value] if level % 2 else {"a": value}
    return value


def hostile(chance: random.Random, old: Any) -> Any:
    """Return a value in place of another one.

    It mostly has the same type, because other types are refused at once.
    """
    turn = chance.random()
    if isinstance(old, int) and not isinstance(old, bool) and turn < 0.6:
        return chance.choice(
            (
                *NUMBERS,
                old + 1,
                old - 1,
                -old,
                2 * old,
                old * old + 1 if old < 2**80 else 0,
                float(old) if old < 2**80 else 1e300,
            )
        )
    if isinstance(old, float) and turn < 0.6:
        return chance.choice(
            (
                *FLOATS,
                *SPECIAL,
                -old,
                old * 1e6,
                old * 1e-6,
                old * 1e30,
                int(old) if math.isfinite(old) else 0,
            )
        )
    if isinstance(old, list) and old and turn < 0.6:
        return chance.choice(
            (
                old[:-1],
                [*old, old[-1]],
                old[::-1],
                [*old] * 2,
                [old],
                [old[0]] * len(old),
                [],
                sorted(old, key=str),
            )
        )
    if isinstance(old, str) and turn < 0.4:
        return chance.choice((old[:-1], old + "x", old.upper(), old * 2, old[::-1]))
    return chance.choice(
        (*OTHERS, *NUMBERS, *FLOATS, *SPECIAL, _nest(chance.choice((10, 60, 70, 400))))
    )


Place = tuple[Any, Any]
"""A dict or list, and a key or index in it."""


def places(value: Any) -> Iterator[Place]:
    """Yield the place of every value of a document."""
    for key in (
        value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    ):
        yield value, key
        yield from places(value[key])


def dumped(values: Any) -> bytes:
    """Return the values as JSON."""
    return json.dumps(values).encode()


def header_of(parts: list[tuple[str, bytes]]) -> tuple[dict[str, Any], dict[str, Any], Any]:
    """Return the root document, its attribute `fhash`, and the header of the first variable."""
    root = json.loads(dict(parts)[DOCUMENT])
    top = root["attributes"]["fhash"]
    return root, top, top["variables"][0]


def path_of(header: dict[str, Any], name: str) -> str:
    """Return the path of an array of the first variable in a sound file."""
    if name == TABLE:
        return str(header.get("array", part_place(0, name)))
    if name.startswith("coords/"):
        return str(header["dimensions"][POSITIONS.index(name.removeprefix("coords/"))])
    return part_place(0, name)


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


JSON_KINDS: dict[str, Callable[[random.Random, Parts], Parts]] = {
    "text": _text,
    "value": _value,
    "key": _key,
    "length": _length,
    "domain": _lengths,
    "coordinates": _coordinates,
    "header": _header,
    "array": _array,
}
