"""Mutations of files of several variables, of metadata of a source, and of parts of a series."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from copy import deepcopy
from math import prod
from typing import Any

import numpy as np
from mutated_arrays import (
    SPECIAL,
    NothingFitsError,
    array_of_zeros,
    coding,
    documents_of,
    replaced,
    tile_of,
)
from mutated_documents import (
    DOCUMENT,
    FLOATS,
    LARGE,
    OTHERS,
    Parts,
    dumped,
    header_of,
    hostile,
    path_of,
    places,
    with_crc,
)
from numcodecs.zstd import compress, decompress

from fhash_formats.container.hierarchy import part_place

NODES = (
    *(
        "u",
        "v",
        "time",
        "x",
        "parts",
        "tables",
        "zarr.json",
        "",
        "a.b",
        "a/b",
        "__u",
        "x" * 101,
    ),
    *("consolidated_metadata", "coords", "auxiliary", "U"),
)
"""Names of arrays: of others, of groups, and those that are not allowed."""
SHARED = (
    *("auxiliary/lat", "auxiliary/lon", "auxiliary/none", "tables/level_1", "coords/x", "../u"),
    *("auxiliary/", "", "occupancy/bits"),
)
"""Internal names of arrays that a variable may say to share."""
Root = dict[str, Any]


def root_of(parts: Parts) -> tuple[Root, list[dict[str, Any]]]:
    """Return the root document, and the headers of its variables."""
    root = json.loads(dict(parts)[DOCUMENT])
    listed: list[dict[str, Any]] = root["attributes"]["fhash"]["variables"]
    return root, listed


def is_several(parts: Parts) -> bool:
    """Whether a sound file holds several variables."""
    return len(root_of(parts)[1]) > 1


def consolidated(parts: Parts) -> Parts:
    """Return the file with the documents as they are in its consolidated metadata."""
    documents = {
        name.removesuffix(f"/{DOCUMENT}"): json.loads(data)
        for name, data in parts
        if name.endswith(f"/{DOCUMENT}")
    }
    root = json.loads(dict(parts)[DOCUMENT])
    if not isinstance(root, dict) or "consolidated_metadata" not in root:
        return parts
    root["consolidated_metadata"] = {
        "kind": "inline",
        "must_understand": False,
        "metadata": documents,
    }
    return replaced(parts, {DOCUMENT: dumped(root)})


def _variables(chance: random.Random, parts: Parts) -> Parts:
    """Change the list of variables: keys of one, their number and order, those of the root."""
    root, listed = root_of(parts)
    header, turn = chance.choice(listed), chance.randrange(9)
    top = root["attributes"]["fhash"]
    if turn == 0:
        key = chance.choice(("name", "array"))
        header[key] = chance.choice(
            (*NODES, *(other.get(key) for other in listed), hostile(chance, "u"))
        )
    elif turn == 1:
        names = chance.choice(listed)["dimensions"]
        header["dimensions"] = chance.choice(
            (
                names,
                names[::-1],
                names[:3],
                [*names, "w"],
                [names[0]] * 4,
                chance.choices(NODES, k=4),
            )
        )
    elif turn == 2:
        chance.shuffle(listed)
        del listed[chance.randrange(1, len(listed) + 1) :]
    elif turn == 3:
        listed.append(deepcopy(header))
        for key in ("name", "array"):
            listed[-1][key] = chance.choice(("again", header.get(key)))
    elif turn == 4:
        features = top["required_features"]
        top["required_features"] = chance.choice(
            ([], features[1:], features[:1], [*features, "novelty"], features * 9, ["plain"], 3)
        )
    elif turn == 5:
        other = chance.choice(listed)
        key = chance.choice(list(header))
        header[key] = deepcopy(other.get(key))
    elif turn == 6:
        holder, key = chance.choice(list(places(header)))
        holder[key] = hostile(chance, holder[key])
    elif turn == 7:
        top["variables"] = chance.choice(([], {}, None, listed[0], [[]], [None], listed * 2))
    else:
        key = chance.choice(list(top))
        top[key] = hostile(chance, top[key])
    return replaced(parts, {DOCUMENT: dumped(root)})


def _shares(chance: random.Random, parts: Parts) -> Parts:
    """Change which arrays a variable shares, or the shared array."""
    root, listed = root_of(parts)
    header = chance.choice(listed)
    numbers = range(-1, len(listed) + 1)
    if chance.random() < 0.6:
        header["shares"] = {
            chance.choice(SHARED): chance.choice((*[*numbers] * 20, *NODES, None, 1.0, True, []))
            for _ in range(chance.choice((1, 1, 2)))
        }
    else:
        header["shares"] = chance.choice(OTHERS)
    if chance.random() < 0.3:
        source = chance.choice([other.get("source") for other in listed])
        header["source"] = deepcopy(source)
    return replaced(parts, {DOCUMENT: dumped(root)})


def _places(chance: random.Random, parts: Parts) -> Parts:
    """Put an array at another place: among the parts, at the root, to another variable."""
    _, listed = root_of(parts)
    names = [name for name in documents_of(parts) if name]
    name, number = chance.choice(names), chance.randrange(len(listed) + 1)
    node = str(listed[0].get("array", "u"))
    other = chance.choice(
        (
            *(
                f"parts/{number}.{end}"
                for end in ("tables.level_1", "coords.x", "key_frames", "", "..")
            ),
            *(
                f"parts/{chance.choice(NODES)}.mlp.bias_1",
                f"{node}_2",
                f"parts/{number}",
                "extra/a",
            ),
            *(chance.choice(names), chance.choice(NODES)),
        )
    )
    copied = chance.random() < 0.4
    changed: dict[str, bytes] = {}
    for member, data in parts:
        mine = member.startswith(f"{name}/")
        if mine:
            changed[f"{other}{member[len(name) :]}"] = data
        if copied or not mine:
            changed.setdefault(member, data)
    root_document = changed.pop(DOCUMENT)
    return [*changed.items(), (DOCUMENT, root_document)]


def _consolidated(chance: random.Random, parts: Parts) -> Parts:
    """Change the copies of the documents in the root, or the original of one."""
    root, _ = root_of(parts)
    if "consolidated_metadata" not in root:
        raise NothingFitsError
    turn = chance.randrange(4)
    if turn == 0:
        holder, key = chance.choice(list(places(root["consolidated_metadata"])))
        holder[key] = hostile(chance, holder[key])
    elif turn == 1:
        metadata = root["consolidated_metadata"]["metadata"]
        metadata[chance.choice((*NODES, "parts/u.a"))] = chance.choice(list(metadata.values()))
    elif turn == 2:
        root["consolidated_metadata"] = chance.choice(OTHERS)
    else:
        del root["consolidated_metadata"]
    return replaced(parts, {DOCUMENT: dumped(root)})


def _many(chance: random.Random, parts: Parts) -> Parts:
    """Declare hundreds of variables, on one grid or each on its own, and long lists."""
    root, listed = root_of(parts)
    header = min(listed, key=lambda one: len(json.dumps(one)))
    own = listed.index(header)
    count, own_grid = chance.choice((30, 200, 700)), chance.random() < 0.4
    axis = chance.randrange(4)
    grid, table = header["dimensions"][axis], header.get("array", "u")
    below = [
        (name, data)
        for name, data in parts
        if name.startswith((f"{table}/", f"parts/{own}.")) and name != DOCUMENT
    ]
    positions = [(name, data) for name, data in parts if name.startswith(f"{grid}/")]
    added: Parts = []
    for number in range(count):
        node = f"n{number}"
        copy = {**header, "name": node, **({"array": node} if "array" in header else {})}
        if own_grid:
            copy["dimensions"] = [*header["dimensions"]]
            copy["dimensions"][axis] = f"g{number}"
            added += [(name.replace(grid, f"g{number}", 1), data) for name, data in positions]
        listed.append(copy)
        added += [
            (
                name.replace(f"/{own}.", f"/{len(listed) - 1}.", 1)
                if name.startswith("parts/")
                else name.replace(f"{table}/", f"{node}/", 1),
                data,
            )
            for name, data in below
        ]
    if chance.random() < 0.3:
        features = root["attributes"]["fhash"]["required_features"]
        features[:0] = ["transform"] * chance.choice((1000, 200_000))
    if chance.random() < 0.3:
        group = b'{"zarr_format":3,"node_type":"group"}'
        added = [*((f"e{number}/{DOCUMENT}", group) for number in range(3000)), *added]
    kept = [(name, data) for name, data in parts if name != DOCUMENT]
    return [*dict([*added, *kept]).items(), (DOCUMENT, dumped(root))]


def _large(chance: random.Random, parts: Parts) -> Parts:
    """Change a length in all documents of a file, so that they agree."""
    root, listed = root_of(parts)
    axis = chance.randrange(4)
    old = chance.choice(listed)["domain"]["shape"][axis]
    new = chance.choice((1, old + 1, 2 * old, 100, *LARGE[:8]))
    for header in listed:
        header["quality"].pop("steps", None)
    changed = {}
    for name, data in parts:
        values = root if name == DOCUMENT else json.loads(data) if name.endswith(DOCUMENT) else None
        if values is None:
            continue
        for holder, key in list(places(values)):
            if type(holder[key]) is int and holder[key] == old and isinstance(holder, list):
                holder[key] = new
        changed[name] = dumped(values)
    return replaced(parts, changed)


VARIABLES_KINDS: dict[str, Callable[[random.Random, Parts], Parts]] = {
    "variables": _variables,
    "shares": _shares,
    "places": _places,
    "consolidated": _consolidated,
    "many variables": _many,
    "variables length": _large,
}


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


SOURCE_KINDS: dict[str, Callable[[random.Random, Parts], Parts]] = {
    "source": _source,
    "source giant": _giant,
}


ERRORS = "parts/0.steps.errors"
TABLE = "tables/level_1"
WHOLE = (
    *(
        "tables/level_1",
        "coords/x",
        "coords/time",
        "missing/bits",
        "steps/errors",
        "auxiliary/wide",
    ),
    *("auxiliary/other", "occupancy/mask", "x", "whole/x"),
)
"""Names of arrays that the whole is said to have."""
PARTS_NUMBERS = (*FLOATS, *SPECIAL, 1.7e308, -1.0, 2.0**63, 0.0)


def _part(chance: random.Random, parts: Parts) -> Parts:
    """Change what a part says of itself and of the whole."""
    root, _, header = header_of(parts)
    if "part" not in header:
        raise NothingFitsError
    part, turn = header["part"], chance.randrange(9)
    if turn == 0:
        key = chance.choice(("number", "of", "first", "steps", "size", "nonzero"))
        part[key] = chance.choice((0, 1, 2, 3, 5, 7, *LARGE, -1, part[key] + 1, part[key] - 1))
    elif turn == 1:
        part["ssim_steps"] = chance.choice(([], [0], [4, 4], [5], [-1], [0] * 70_000, 3, *OTHERS))
    elif turn == 2:
        part["source"] = chance.choice(({}, {"dimensions": []}, {"dimensions": ["t"]}, *OTHERS))
    elif turn == 3 and "source" in part:
        holder, key = chance.choice(list(places(part["source"])))
        holder[key] = hostile(chance, holder[key])
    elif turn == 4:
        header["model"]["gains"] = chance.choice(
            ([], [[]], [["a", 1]], [["a", 1, 2]] * 3, [{"what": "a", "bytes": 1}], *OTHERS)
        )
    elif turn == 5:
        bulk = chance.choice(({"range": [0, 1]}, {"range": []}, {"range": None}, {}, [1], "x", 3))
        header["quality"]["bulk"] = bulk
    elif turn == 6:
        header["model"]["parameters"] = chance.choice((1, 2, *LARGE[:12]))
    elif turn == 7:
        return _whole(chance, parts)
    else:
        holder, key = chance.choice(list(places(part)))
        holder[key] = hostile(chance, holder[key])
    return replaced(parts, {DOCUMENT: dumped(root)})


def _whole(chance: random.Random, parts: Parts) -> Parts:
    """Give a part arrays that the whole is said to have, small and large."""
    length = chance.choice((1, 3, 1 << 20, 1 << 22))
    name = f"whole/{chance.choice(WHOLE)}"
    kind = chance.choice(("float64", "uint8", "int64"))
    added = array_of_zeros(name, [length], kind, part_place(0, name))
    kept = [item for item in parts if item[0] != DOCUMENT]
    return [*dict([*added, *kept]).items(), (DOCUMENT, dict(parts)[DOCUMENT])]


def _errors(chance: random.Random, parts: Parts) -> Parts:
    """Change the sums of errors of a part, or the form of their array."""
    documents = documents_of(parts)
    if ERRORS not in documents:
        raise NothingFitsError
    document = documents[ERRORS]
    if chance.random() < 0.15:
        document["shape"] = chance.choice(([1, 10], [3, 10], [2, 9], [20], [2, 10, 1]))
        return replaced(parts, {f"{ERRORS}/{DOCUMENT}": dumped(document)})
    changed = {}
    for member, data in parts:
        if member.startswith(f"{ERRORS}/c/"):
            values = np.frombuffer(decompress(data[:-4]), document["data_type"]).copy()
            for _ in range(chance.choice((1, 1, 3, values.size))):
                values[chance.randrange(values.size)] = chance.choice(PARTS_NUMBERS)
            changed[member] = with_crc(compress(values.tobytes(), 1))
    return replaced(parts, changed)


def _grown(chance: random.Random, parts: Parts) -> Parts:
    """Change what the next layers depend on: promise, range, figures, tiles, times, history."""
    root, _, header = header_of(parts)
    table = path_of(header, TABLE)
    document = documents_of(parts).get(table)
    growing = document is not None and coding(document) == "fhash.transform"
    if not growing or "max_error" not in header.get("config", {}) or "part" in header:
        raise NothingFitsError
    turn, quality = chance.randrange(10), header["quality"]
    if turn == 0:
        key = chance.choice(("max_error", "max_error_rel", "effort", "tile", "psnr", "seed"))
        header["config"][key] = chance.choice((*FLOATS, *OTHERS, 0, 1, 10**30, "1x1x1x1"))
    elif turn == 1:
        header["value_range"] = sorted(chance.choices((*FLOATS, 0.0, 1.0), k=2))
    elif turn == 2 and "steps" in quality:
        errors = quality["steps"]
        key = chance.choice(list(errors))
        errors[key] = chance.choice(
            ([], errors[key][:-1], [0] * 8, [None] * 8, [10**9] * 8, [-(10**9)] * 8, *OTHERS)
        )
    elif turn == 3:
        steps = header["domain"]["shape"][0]
        figures = chance.choices((0, 1, -1, -2, 30_000, -(2**31) + 1, 2**31 - 1), k=steps + 1)
        quality["steps"] = {"rmse": figures, "max_abs_error": figures[::-1]}
    elif turn == 4:
        shape = header["domain"]["shape"]
        shape[0] = chance.choice((1, 2, 3, 5, 6, 8))
        assert document is not None
        document["shape"][0] = shape[0]
        header["model"]["levels"][0][0] = shape[0]
    elif turn == 5:
        steps = header["domain"]["shape"][0]
        header.setdefault("coordinates", {})["time"] = chance.choice(
            (
                {"values": chance.choices((*FLOATS, 0, 1), k=steps)},
                {"values": [0] * steps},
                {"start": 1e308, "step": 1e308},
                {"start": 0, "step": -1},
                {"dtype": "float32", "start": 3e38, "step": 1e38},
            )
        )
    elif turn == 6:
        header["encoder"] = chance.choice(({}, {"version": "9"}, {"version": "9", "seed": 10**30}))
    elif turn == 7:
        header["model"]["parameters"] = chance.choice((1, *LARGE[:12]))
        header["model"]["gains"] = chance.choice(OTHERS)
        header["history"] = chance.choice(([], {}, {"epoch": [1] * 70_000}))
    elif turn == 8:
        return _beside(chance, parts)
    else:
        holder, key = chance.choice(list(places(quality))) if quality else (header, "quality")
        holder[key] = hostile(chance, holder[key])
    return replaced(parts, {f"{table}/{DOCUMENT}": dumped(document), DOCUMENT: dumped(root)})


def _beside(chance: random.Random, parts: Parts) -> Parts:
    """Add an array that a growing file would have to carry on."""
    names = ("extra", "steps/errors", "steps/figures", "auxiliary/a", "occupancy/bits", "coords/x")
    name, (_, _, header) = chance.choice(names), header_of(parts)
    tile = tile_of(documents_of(parts)[path_of(header, TABLE)])
    length = chance.choice((1, 7, prod(tile), 1 << 22))
    kind = chance.choice(("float64", "uint8"))
    path = name if name == "extra" else path_of(header, name)
    added = array_of_zeros(name, [length], kind, path)
    if path.startswith("parts/"):
        added = [(f"parts/{DOCUMENT}", b'{"zarr_format":3,"node_type":"group"}'), *added]
    kept = [item for item in parts if item[0] != DOCUMENT]
    return [*dict([*added, *kept]).items(), (DOCUMENT, dict(parts)[DOCUMENT])]


PARTS_KINDS: dict[str, Callable[[random.Random, Parts], Parts]] = {
    "part": _part,
    "errors": _errors,
    "grown": _grown,
}
