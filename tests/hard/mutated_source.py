"""Mutations of the metadata of a source.

All checksums are correct. A file without such metadata is passed over.
"""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from typing import Any

from containers import Parts
from documents import DOCUMENT, LARGE, OTHERS, dumped, hostile, places
from mutated_payload import NothingFitsError, replaced
from mutated_plain import array_of_zeros

from fhash_formats.container.hierarchy import part_place

TYPES = (
    *("int8", "int16", "uint64", "float16", "float32", "float64", "text", "bytes1", "bytes65536"),
    *("bytes65537", "bytes0", "json", "bool", "complex64", "", 3, None),
)
NAMES = (
    *("t", "z", "y", "x", "time", "lat", "n", "crs", "", ".", "..", "a/b", "__a", " a", "\x07"),
    *("x" * 257, "density", "u", None, 3),
)
NUMBERS = (
    *("NaN", "Infinity", "-Infinity", "nan", "1"),
    0,
    1,
    -1,
    1.5,
    1e300,
    *LARGE,
    None,
    [],
    {},
)


def _headers(parts: Parts) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the root document, and all headers with metadata of the source."""
    root = json.loads(dict(parts)[DOCUMENT])
    header = root["attributes"]["fhash"]
    found = [one for one in header["variables"] if "source" in one]
    if not found:
        raise NothingFitsError
    return root, found


def _source(chance: random.Random, parts: Parts) -> Parts:
    """Change one thing of the metadata: dimensions, lengths, arrays, attributes."""
    root, headers = _headers(parts)
    header = chance.choice(headers)
    source, turn = header["source"], chance.randrange(8)
    if turn == 0:
        pairs = [[chance.choice(NAMES), chance.choice(("", *"tzyx", "w"))] for _ in range(3)]
        dimensions = [*source["dimensions"], *pairs[: chance.randrange(3)]]
        chance.shuffle(dimensions)
        source["dimensions"] = dimensions[: chance.randrange(len(dimensions) + 1)]
    elif turn == 1:
        source["lengths"] = {
            str(chance.choice(NAMES)): chance.choice((0, 1, 2, 5, 300, *LARGE)) for _ in range(2)
        }
    elif turn < 4 and source.get("variables"):
        _entry(chance, chance.choice(source["variables"]))
    elif turn == 4:
        source[chance.choice(("variable", "attributes"))] = {
            chance.choice(("units", "coordinates", "grid_mapping", "_FillValue", "a", "", "__b")): (
                _attribute(chance)
            )
            for _ in range(chance.choice((1, 2, 3)))
        }
    elif turn == 5:
        source["stored"] = chance.choice(TYPES)
        header["variable"]["attributes"] = {"scale_factor": chance.choice((0.5, 0, *OTHERS[:9]))}
    else:
        holder, key = chance.choice(list(places(source)))
        holder[key] = hostile(chance, holder[key])
    return replaced(parts, {DOCUMENT: dumped(root)})


def _entry(chance: random.Random, entry: dict[str, Any]) -> None:
    """Change an array beside the values."""
    turn = chance.randrange(7)
    if turn == 0:
        entry["dtype"] = chance.choice(TYPES)
    elif turn == 1:
        entry["values"] = chance.choice(
            ([], [chance.choice(NUMBERS)] * 5, chance.choices(NUMBERS, k=5), ["a"] * 5, [""], [1])
        )
        entry.pop("array", None)
    elif turn == 2:
        entry["dimensions"] = chance.choices(NAMES, k=chance.randrange(4))
    elif turn == 3:
        entry["name"] = chance.choice(NAMES)
    elif turn == 4:
        entry["axis"] = chance.choice((*"tzyx", "", "w", None))
    elif turn == 5:
        entry["array"] = chance.choice(("wide", "lat", "lon", "none", "../u", ""))
    else:
        entry["attributes"] = {str(chance.choice(NAMES)): _attribute(chance)}


def _attribute(chance: random.Random) -> Any:
    """Return a typed attribute, sound or not."""
    plain = chance.choice((*NUMBERS, *OTHERS, "lat lon", "days since 2000-01-01", "a: b c: d"))
    if chance.random() < 0.3:
        return plain
    return {str(chance.choice(TYPES)): chance.choice((plain, [plain], [plain] * 3, [0.5, "NaN"]))}


def _giant(chance: random.Random, parts: Parts) -> Parts:
    """Declare far more metadata than the file has bytes: long texts, many arrays, large arrays."""
    root, headers = _headers(parts)
    source, turn = chance.choice(headers)["source"], chance.randrange(5)
    count = chance.choice((1000, 100_000, 1_000_000))
    if turn == 0:  # texts of 64 KiB of which each has two bytes in the file
        texts = {"bytes65536": [""] * count}
        chance.choice(headers)["source"]["attributes"] = {"a": texts}
    elif turn == 1:
        source["lengths"] = {"long": count}
        source["variables"] = [
            {"name": "a", "dimensions": ["long"], "dtype": "bytes65536", "values": [""] * count}
        ]
    elif turn == 2:
        kind = chance.choice(("float32", "float64", "int8", "text"))
        value: Any = "" if kind == "text" else 0
        source["attributes"] = {f"a{n}": {kind: [value] * (count // 9)} for n in range(9)}
    elif turn == 3:
        entries = min(count, 20_000)
        source["variables"] = [{"name": f"a{n}", "values": [n]} for n in range(entries)]
    else:
        return _zeros(chance, parts)
    return replaced(parts, {DOCUMENT: dumped(root)})


def _zeros(chance: random.Random, parts: Parts) -> Parts:
    """Declare arrays beside the values of up to 2^25 bytes of zeros, alone or many times."""
    root, headers = _headers(parts)
    length = 1 << chance.choice((16, 18, 20, 22))
    times = chance.choice((1, 7, 500))
    for header in headers:
        header["source"]["lengths"] = {"long": length}
        header["source"]["variables"] = [
            {"name": f"a{n}", "dimensions": ["long"], "array": "long"} for n in range(times)
        ]
    number = root["attributes"]["fhash"]["variables"].index(headers[0])
    for header in headers[1:]:
        header["shares"] = {"auxiliary/long": number}
    kept = [item for item in parts if item[0] != DOCUMENT]
    group = (f"parts/{DOCUMENT}", b'{"zarr_format":3,"node_type":"group"}')
    path = part_place(number, "auxiliary/long")
    added = [*array_of_zeros("auxiliary/long", [length], "float64", path), group]
    return [*dict([*added, *kept]).items(), (DOCUMENT, dumped(root))]


KINDS: dict[str, Callable[[random.Random, Parts], Parts]] = {
    "source": _source,
    "source giant": _giant,
}
