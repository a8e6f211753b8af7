"""Mutations of metadata documents, with correct checksums: mostly rules for what stands where.

A file without what a kind changes is passed over.
"""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from copy import deepcopy
from math import prod
from types import SimpleNamespace
from typing import Any

from containers import Parts
from documents import (
    DOCUMENT,
    FLOATS,
    GONE,
    LARGE,
    OTHERS,
    SPECIAL,
    Documents,
    NothingFitsError,
    Rule,
    added,
    array_of_zeros,
    dumped,
    hostile,
    is_plain,
    places,
    put,
    replaced,
)
from mutated_tiles import head_of, is_coded, put_settings, settings_of, tile_of, unchecked

from fhash_formats.container.header import KNOWN_FEATURES, TABLE
from fhash_formats.container.hierarchy import path_of
from fhash_formats.support.values import DTYPES

AXES = ("time", "z", "y", "x")
KINDS_OF_NUMBERS = (*DTYPES, "bool", "complex64")
FEATURES = sorted(KNOWN_FEATURES)
NODES = (
    *("u", "v", "time", "x", "v0", "v1", "v9", "v00", "v0/", "table_1", "zarr.json", "", "a.b"),
    *("a/b", "__u", "x" * 101, "t", "c", "t/0", "mlp", "auxiliary", "V0", "v\x000", "v0\x00"),
)
"""Names of groups and arrays: of others, and those that are not allowed."""


def _named(chance: random.Random, parts: Parts) -> str:
    """Return the name of a document: the root's or, as often, any other one."""
    names = [name for name, _ in parts if name.endswith(DOCUMENT)]
    return DOCUMENT if chance.random() < 0.4 else chance.choice(names)


def _text(chance: random.Random, parts: Parts) -> Parts:
    """Change bytes of a document."""
    name = _named(chance, parts)
    data = dict(parts)[name]
    snippets = (
        *(b"NaN", b"1e999", b'"a":1,"a":2,', b"\xff", b"\x00", b"[" * 70, b"[" * 200_000),
        *(b'{"a":' * 100_000, b"9" * 5000, b'"\\ud800"', b"-", b"//"),
    )
    at, turn = chance.randrange(len(data)), chance.random()
    new = bytes([data[at] ^ 1 << chance.randrange(8)]) if turn < 0.4 else chance.choice(snippets)
    rest = b"" if 0.4 <= turn < 0.6 else new + data[at + (turn < 0.4 or chance.random() < 0.5) :]
    return replaced(parts, {name: data[:at] + rest})


def _value(chance: random.Random, parts: Parts) -> Parts:
    """Replace one value, or a few."""
    name = _named(chance, parts)
    values = json.loads(dict(parts)[name])
    for _ in range(chance.choice((1, 1, 1, 2, 4))):
        put(chance, values, [("**", hostile)])
    return replaced(parts, {name: dumped(values)})


def _renamed(chance: random.Random, parts: Parts) -> Parts:
    """Remove, rename or add a key."""
    name = _named(chance, parts)
    values = json.loads(dict(parts)[name])
    found = [values, *(holder[key] for holder, key in places(values))]
    chosen = chance.choice([value for value in found if isinstance(value, dict) and value])
    key, turn = chance.choice(list(chosen)), chance.random()
    if turn < 0.5:
        del chosen[key]
    elif turn < 0.75:
        chosen[key + chance.choice(("x", "_", " "))] = chosen.pop(key)
    else:
        new = ("novelty", "storage_transformers", "consolidated_metadata", "must_understand")
        chosen[chance.choice(new)] = chance.choice(OTHERS)
    return replaced(parts, {name: dumped(values)})


def _length(chance: random.Random, parts: Parts) -> Parts:
    """Replace one length of the volume in all documents, so that they agree."""
    file = Documents(parts)
    old = chance.choice(chance.choice(file.headers)["domain"]["shape"])
    new = chance.choice((1, 2, old - 1, old + 1, old + 3, 2 * old, 100, 1000, *LARGE[:10]))
    for header in file.headers:
        header["quality"].pop("steps", None)
    for holder, key in list(places([file.root, *file.arrays.values()])):
        if type(holder[key]) is int and holder[key] == old and isinstance(holder, list):
            holder[key] = new
    return file.packed()


def _domain(chance: random.Random, parts: Parts) -> Parts:
    """Make the domain larger than the box, with positions by rule."""
    file = Documents(parts)
    header = chance.choice(file.headers)
    shape = header["domain"]["shape"]
    for axis in chance.sample(range(4), chance.choice((1, 2, 4))):
        shape[axis] = max(shape[axis], chance.choice((100, 2**10, 2**20, 2**26, 2**40)))
    header["coordinates"] = {name: _rule(chance) for name in AXES}
    return file.packed()


def _rule(chance: random.Random, old: Any = None) -> dict[str, Any]:
    """Return positions by rule."""
    numbers = (0, 1, -1, 1e308, -1e308, 1e-308, 5e-324, 1e-12, 3.5e5, 3.4e38, -0.0, 2**53, 1e16)
    rule: dict[str, Any] = {
        key: chance.choice(numbers) for key in ("start", "step") if chance.random() < 0.5
    }
    if chance.random() < 0.4:
        rule["dtype"] = chance.choice((*["float32", "float64"] * 4, "float16"))
    if chance.random() < 0.3:
        ulps = (0, 1, -1, 5, -9, 2**52 - 1, 1 - 2**52, 2**53)
        rule["ulps"] = chance.choices(ulps, k=chance.choice((1, 2)))
    return rule


def _coordinates(chance: random.Random, parts: Parts) -> Parts:
    """Replace positions by absurd ones: all equal, beyond their type, descending, with vanishing
    steps, not finite, those of other variables; or positions of other axes."""
    file = Documents(parts)
    header = chance.choice(file.headers)
    numbers = (0, 1, -1, 1e308, -1e308, 5e-324, 2.5, *TEXTS)
    for number in chance.sample(range(4), chance.choice((1, 1, 2, 4))):
        length, turn = header["domain"]["shape"][number], chance.random()
        listed = {"values": chance.choices(numbers, k=length)}
        chosen = listed if turn < 0.3 else _rule(chance) if turn < 0.6 else chance.choice(POSITIONS)
        axis = AXES[number] if chance.random() < 0.9 else chance.choice(NODES)
        header.setdefault("coordinates", {})[axis] = chosen
    if chance.random() < 0.1:  # of each variable those of the next one
        for number, each in enumerate(file.headers, start=1):
            each.setdefault("coordinates", {})[chance.choice(AXES)] = number % len(file.headers)
    return file.packed()


TEXTS = ("NaN", "Infinity", "-Infinity", "nan", "inf", "1")
POSITIONS: tuple[Any, ...] = (
    *[number for number in range(5) for _ in range(5)],
    *(-1, True, False, 0.0, 2**31, 2**63, 2**64, 10**30, "0", "NaN", None, [], [0], {"values": 0}),
    *({"values": []}, {"values": [0] * (1 << 20)}, {"values": ["NaN"] * ((1 << 20) + 1)}),
    *({"ulps": [0] * (1 << 20)}, {"values": [10**30, 2**64, 2**63 - 1]}, {"values": [[0]]}),
    *({"name": "x"}, {"name": ""}, {"name": 0}, {"attributes": []}, {"attributes": {"units": 0}}),
)
"""Values in place of an axis' object: numbers of variables, and objects."""


def _pair(chance: random.Random, old: Any) -> list[float]:
    return sorted(chance.choices((*FLOATS, 0.0, 1.0), k=2))


def _box(chance: random.Random, old: Any) -> Any:
    """Return a bounding box in another one."""
    low = [chance.randrange(start, stop) for start, stop in old]
    return [[a, chance.randrange(a + 1, n + 1)] for a, (_, n) in zip(low, old, strict=True)]


def _some(*words: Any) -> Callable[[random.Random, Any], Any]:
    """Return a function that draws some words, or that changes a list of them."""

    def drawn(chance: random.Random, old: Any) -> Any:
        listed = list(old) if isinstance(old, list) else []
        others = ([], listed[1:], listed[:1], [*listed, *words[:1]], listed * 2, listed * 9)
        every = chance.sample(words, chance.randrange(len(words) + 1))
        return chance.choice((*others, every, every))

    return drawn


def _turned(chance: random.Random, levels: Any) -> Any:
    """Return another list of levels."""
    turned = [level[::-1] for level in levels]
    others = (levels[:1], levels[:-1], [*levels, levels[-1]], levels[::-1], turned, levels[:1] * 3)
    return chance.choice(others)


def _figures(chance: random.Random, steps: Any) -> Any:
    """Return other figures of steps."""
    figures = chance.choices((0, 1, -1, -2, 30_000, 1 - 2**31, 2**31 - 1), k=chance.randrange(9))
    return {"rmse": figures, "max_abs_error": chance.choice((figures[::-1], figures[1:], 3))}


HISTORIES = (
    *([], {}, {"epoch": []}, {"epoch": [1] * 70_000}, {"epoch": [None] * 9, "psnr": [1]}),
    {"epoch": [1], "psnr": [None]},
)
GAINS = ([], [[]], [["a", 1]], [["a", 1, 2]] * 3, [{"what": "a", "bytes": 1}], *OTHERS)
LEVELS_OF_TABLES = ("float16", "float32", "float64", "uint8", "transform")
VERSIONS = ([2, 0], [2, 1], [2, 9999], [1, 8], [3, 0], [0, 1], [2, -1], [10**9, 0], [2])
HEADER: tuple[Rule, ...] = (
    ("variables.*.value_range", _pair),
    ("variables.*.background", FLOATS),
    ("variables.*.variable.dtype", KINDS_OF_NUMBERS),
    ("variables.*.feature_bounding_box", _box),
    ("format_version", VERSIONS),
    ("required_features", _some(*FEATURES, "novelty", "")),
    (
        "variables.*.features",
        ([], ["all"], ["interval:2:0.5"], ["isosurface:nan"], ["isosurface:1e300"], ["x"] * 9),
    ),
    ("variables.*.features", (["\n"], ["all"] * 2, ["interval:1:2"] * 40)),
    ("variables.*.history", HISTORIES),
    ("variables.*.quality", ({}, {"psnr": None}, {"psnr": 1e308, "rmse": 0}, {"steps": []})),
    ("variables.*.quality.steps", _figures),
)
"""Numbers of the header on which decoding depends; each is allowed by itself."""
VARIABLES: tuple[Rule, ...] = (
    *[("variables.*.name|group", (*NODES, "wind", "again", *OTHERS[:4], GONE))] * 2,
    ("variables.*.coordinates", (*OTHERS, {"time": 0}, {"time": 1}, dict.fromkeys(AXES, 0))),
    ("variables.*.coordinates.*", POSITIONS),
    ("variables", lambda chance, old: chance.sample(old, chance.randrange(len(old) + 1))),
    ("variables", lambda chance, old: [*old, {**deepcopy(chance.choice(old)), "name": "again"}]),
    (
        "variables",
        lambda chance, old: [*old[1:], {**old[0], **dict([chance.choice([*old[-1].items()])])}],
    ),
    ("variables", lambda chance, old: chance.choice(([], {}, None, old[0], [[]], [None], old * 2))),
    ("required_features", _some("novelty", "plain", 3)),
    ("variables.*.**", hostile),
    ("*", hostile),
)
"""Keys that say how many variables there are, their names and order, and the root's keys."""
SHARED = (
    *("auxiliary/lat", "auxiliary/lon", "auxiliary/none", "table_1", "x", "../u"),
    *("auxiliary/", "", "occupancy", "v0/table_1", "missing"),
)
"""Names of arrays that a variable may say to share."""


def _sharing(chance: random.Random, old: Any) -> dict[str, Any]:
    others = (*[*range(-1, 4)] * 20, *NODES, None, 1.0, True, [], [0, "auxiliary/lat"], [0, "lat"])
    return {chance.choice(SHARED): chance.choice(others) for _ in range(chance.choice((1, 1, 2)))}


SHARES: tuple[Rule, ...] = (
    *[("variables.*.shares", _sharing)] * 2,
    ("variables.*.shares", OTHERS),
    ("variables.*.source", ({}, {"dimensions": []}, None, GONE)),
)

TYPES = (
    *("int8", "int16", "uint64", "float16", "float32", "float64", "text", "bytes1", "bytes65536"),
    *("bytes65537", "bytes0", "json", "bool", "complex64", "", 3, None),
)
NAMES = (
    *("t", "z", "y", "x", "time", "lat", "n", "crs", "", ".", "..", "a/b", "__a", " a", "\x07"),
    *("x" * 257, "density", "u", None, 3),
)
TYPED = ("NaN", "Infinity", "-Infinity", "nan", "1", 0, 1, -1, 1.5, 1e300, *LARGE, None, [], {})


def _attribute(chance: random.Random, old: Any = None) -> Any:
    """Return a typed attribute, sound or not."""
    plain = chance.choice((*TYPED, *OTHERS, "lat lon", "days since 2000-01-01", "a: b c: d"))
    if chance.random() < 0.3:
        return plain
    return {str(chance.choice(TYPES)): chance.choice((plain, [plain], [plain] * 3, [0.5, "NaN"]))}


def _attributes(chance: random.Random, old: Any) -> dict[str, Any]:
    names = ("units", "coordinates", "grid_mapping", "_FillValue", "a", "", "__b")
    return {chance.choice(names): _attribute(chance) for _ in range(chance.choice((1, 2, 3)))}


def _dimensions(chance: random.Random, old: Any) -> Any:
    pairs = [[chance.choice(NAMES), chance.choice(("", *"tzyx", "w"))] for _ in range(2)]
    return chance.sample([*old, *pairs], chance.randrange(len(old) + 3))


def _lengths(chance: random.Random, old: Any) -> dict[str, int]:
    return {str(chance.choice(NAMES)): chance.choice((0, 1, 2, 5, 300, *LARGE)) for _ in range(2)}


def _typed(chance: random.Random, old: Any) -> Any:
    one = [chance.choice(TYPED)] * 5
    return chance.choice(([], one, chance.choices(TYPED, k=5), ["a"] * 5, [""], [1]))


SOURCE: tuple[Rule, ...] = (
    ("dimensions", _dimensions),
    ("lengths", _lengths),
    ("variables.*.dtype", TYPES),
    ("variables.*.values", _typed),
    ("variables.*.dimensions", lambda chance, old: chance.choices(NAMES, k=chance.randrange(4))),
    ("variables.*.name", NAMES),
    ("variables.*.axis", (*"tzyx", "", "w", None)),
    ("variables.*.array", ("wide", "lat", "lon", "none", "../u", "")),
    ("variables.*.attributes", _attributes),
    ("variable|attributes", _attributes),
    ("stored", TYPES),
    *[("**", hostile)] * 2,
)
"""Metadata of the source: dimensions, lengths, arrays, attributes."""


def _source(chance: random.Random, parts: Parts) -> Parts:
    file = Documents(parts)
    found = [header for header in file.headers if "source" in header]
    if not found:
        raise NothingFitsError
    header = chance.choice(found)
    put(chance, header["source"], SOURCE)
    if chance.random() < 0.1:
        scale = chance.choice((0.5, 0, *OTHERS[:9]))
        header["variable"]["attributes"] = {"scale_factor": scale}
    return file.packed()


PART: tuple[Rule, ...] = (
    *[
        (
            "part.number|of|first|steps|size|nonzero",
            lambda chance, old: chance.choice((0, 1, 2, 3, 5, 7, *LARGE, -1, old + 1, old - 1)),
        )
    ]
    * 2,
    ("part.ssim_steps", ([], [0], [4, 4], [5], [-1], [0] * 70_000, 3, *OTHERS)),
    ("part.source", ({}, {"dimensions": []}, {"dimensions": ["t"]}, *OTHERS)),
    ("part.source.**", hostile),
    ("part.**", hostile),
    ("model.gains", GAINS),
    ("quality.bulk", ({"range": [0, 1]}, {"range": []}, {"range": None}, {}, [1], "x", 3)),
    ("model.parameters", (1, 2, *LARGE[:12])),
)
WHOLE = (
    *("table_1", "key_frames", "missing", "step_errors", "step_figures"),
    *("auxiliary/wide", "auxiliary/other", "occupancy", "x", "whole/x"),
)
"""Names of arrays that the whole is said to have."""


def _part(chance: random.Random, parts: Parts) -> Parts:
    """Change what a part says of itself and of the whole, or give it arrays of the whole."""
    file = Documents(parts)
    if "part" not in file.header:
        raise NothingFitsError
    if chance.random() < 0.15:
        name = f"whole/{chance.choice(WHOLE)}"
        shape = [chance.choice((1, 3, 1 << 20, 1 << 22))]
        kind = chance.choice(("float64", "uint8", "int64"))
        return added(parts, array_of_zeros(name, shape, kind))
    put(chance, file.header, PART)
    return file.packed()


GROWN: tuple[Rule, ...] = (
    (
        "config.max_error|max_error_rel|effort|tile|psnr|seed",
        (*FLOATS, *OTHERS, 0, 1, 10**30, "1x1x1x1"),
    ),
    ("value_range", _pair),
    ("quality.steps.*", ([], [0] * 8, [None] * 8, [10**9] * 8, [-(10**9)] * 8, *OTHERS)),
    ("quality.steps", _figures),
    (
        "coordinates",
        lambda chance, old: {
            **(old or {}),
            "time": chance.choice(
                (
                    *({"values": [0] * 5}, {"values": [*FLOATS[:5]]}, {"start": 0, "step": -1}),
                    *({"start": 1e308, "step": 1e308}, {"dtype": "float32", "start": 3e38}),
                )
            ),
        },
    ),
    ("encoder", ({}, {"version": "9"}, {"version": 9})),
    ("model.parameters", (1, *LARGE[:12])),
    ("model.gains", OTHERS),
    ("history", HISTORIES),
    ("quality.**", hostile),
)
"""Keys that the next layers depend on: promise, range, figures, times, history."""


def _grown(chance: random.Random, parts: Parts) -> Parts:
    file = Documents(parts)
    document, header = file.arrays.get(file.table), file.header
    tiled = document is not None and is_coded(document)
    if not tiled or "max_error" not in header.get("config", {}) or "part" in header:
        raise NothingFitsError
    assert document is not None
    turn = chance.random()
    if turn < 0.1:  # an array that a growing file would have to carry on
        names = ("extra", "step_errors", "step_figures", "auxiliary/a", "occupancy", "x")
        length = chance.choice((1, 7, prod(tile_of(document)), 1 << 22))
        kind = chance.choice(("float64", "uint8"))
        return added(parts, array_of_zeros(chance.choice(names), [length], kind))
    if turn < 0.2:
        steps, tiles = chance.choice((1, 2, 3, 5, 6, 8)), document["attributes"]["tiles"]
        header["domain"]["shape"][0] = tiles["shape"][0] = steps
        header["model"]["levels"][0][0] = steps
        document["shape"][0] = -(-steps // tiles["tile"][0])
    else:
        put(chance, header, GROWN)
    return file.packed()


PLAIN: tuple[Rule, ...] = (
    (
        "header.model.tile",
        lambda chance, old: chance.choices((1, 1, 2, 5, 64, *LARGE[:8], 0, -1), k=4),
    ),
    ("header.model.values", tuple(DTYPES)),
    ("header.variable.dtype", tuple(DTYPES)),
    ("header.model.tables", LEVELS_OF_TABLES),
    ("header.model.levels", _turned),
    ("top.required_features", _some("plain", "transform", "mask")),
    ("top.required_features", (FEATURES, ["plain"] * 2)),
    ("header.mlp", (None, GONE)),
    *[("header.model.**", hostile)] * 2,
    ("header.coordinates", ({}, {"z": {}}, {"time": {"values": [0]}}, [])),
    ("header.model.gains", OTHERS),
)
"""Header of a plain file: tiles, levels, types, head, features."""
SPARSE: tuple[Rule, ...] = (
    ("header.model.sparse", ("coreset", "fringe", "all", GONE, *OTHERS)),
    ("top.required_features", _some("sparse-tables", "transform")),
    ("header.model.tables", LEVELS_OF_TABLES),
    ("header.model.levels", _turned),
    ("header.model.**", hostile),
    *[
        (
            "tables.*.attributes.counts.*",
            lambda chance, old: chance.choice((*LARGE, *OTHERS, -1, 0, 1.5)),
        ),
        (
            "tables.*.attributes.counts",
            lambda chance, old: chance.choice(
                ([], old[1:], [*old, 0], old[::-1], [old[0] - 1, old[1] + 1, *old[2:]], *OTHERS)
            ),
        ),
        *[("tables.*.attributes.counts", lambda chance, old: _moved(chance, old))] * 2,
        ("tables.*.attributes", ({},)),
        (
            "tables.*.shape",
            lambda chance, old: [old[0] + chance.choice((-1, 1, 1 << 40)), *old[1:]],
        ),
    ],
)
"""Keys that say which vertices a table has: header, counts, levels, features."""


def _moved(chance: random.Random, counts: Any) -> Any:
    """Return other counts with the same sum."""
    counts, (a, b) = list(counts), chance.choices(range(len(counts)), k=2)
    moved = chance.choice((1, counts[a], -1))
    counts[a] -= moved
    counts[b] += moved
    return counts


FILLS: tuple[Any, ...] = (
    *(0, 1, -1, 127, 128, -128, -129, 255, 256, 32767, 2**31, 2**53 + 1, 2**63 - 1, 2**63),
    *(-(2**63), 2**64, 10**30, 10**400, 0.5, -0.0, 1e300, 5e-324, *SPECIAL[:2]),
)
"""Fill values: within and beyond each integer type, and none of a whole number."""
INTEGERS: tuple[Rule, ...] = (
    *[("header.variable.fill", FILLS)] * 2,
    ("header.variable.fill", OTHERS),
    ("header.variable.fill", (GONE,)),
    ("header.variable.dtype", tuple(DTYPES)),
    ("header.model.tables", tuple(DTYPES)),
    ("table.attributes.tiles.data_type", tuple(DTYPES)),
    ("table.data_type", tuple(DTYPES)),
    ("table.fill_value", (*FILLS, *OTHERS)),
    ("header.features", (["all"], ["isosurface:0"], [], None, 0)),
    ("header.coreset_fraction", (0, 0.5, 1, 1.5, -1, 1e300)),
    ("header.background", (*FLOATS, 127, 128, 1e30)),
)
"""Types of integers that contradict each other, fill values, and what is missing."""


def _integers(chance: random.Random, parts: Parts) -> Parts:
    file = Documents(parts)
    document, variable = file.arrays.get(file.table), file.header["variable"]
    if document is None or variable["dtype"] not in DTYPES or "int" not in variable["dtype"]:
        raise NothingFitsError
    if chance.random() < 0.2:  # another type everywhere
        kind = chance.choice(list(DTYPES))
        told = document["attributes"]["tiles"] if is_coded(document) else document
        variable["dtype"] = file.header["model"]["tables"] = told["data_type"] = kind
        variable["fill"] = chance.choice(FILLS)
    else:
        for _ in range(chance.choice((1, 1, 2, 3))):
            put(chance, {"header": file.header, "table": document}, INTEGERS)
    return file.packed()


LENGTHS = (1, 2, *LARGE)
ARRAY: tuple[Rule, ...] = (
    ("data_type", KINDS_OF_NUMBERS),
    *[
        (path, lambda chance, old: chance.choice((*LENGTHS, old + 1, old - 1, 2 * old, 3 * old)))
        for path in (
            "shape.*",
            "chunk_grid.configuration.chunk_shape.*",
            "attributes.tiles.shape.*",
            "attributes.tiles.tile.*",
        )
    ],
    ("codecs", lambda chance, old: chance.choice((old[1:], old[:-1], old * 2, old[::-1]))),
)
"""Type, shapes and codecs of an array."""


def _array(chance: random.Random, parts: Parts) -> Parts:
    file = Documents(parts)
    document = chance.choice(list(file.arrays.values()))
    for _ in range(chance.choice((1, 1, 2, 3))):
        put(chance, document, ARRAY)
    return file.packed()


def _rules(
    rules: tuple[Rule, ...], *, of: str = "top", fits: Callable[[Documents], bool] | None = None
) -> Callable[[random.Random, Parts], Parts]:
    """Return a mutation by rules of a document of a file, `every` for some together."""

    def changed(chance: random.Random, parts: Parts) -> Parts:
        file = Documents(parts)
        if fits is not None and not fits(file):
            raise NothingFitsError
        tables = {name: each for name, each in file.arrays.items() if name.startswith("table_")}
        every = {"header": file.header, "top": file.top, "tables": tables}
        put(chance, every if of == "every" else getattr(file, of), rules)
        return file.packed()

    return changed


def _places(chance: random.Random, parts: Parts) -> Parts:
    """Put an array at another place: at the root, to another variable, below an array."""
    file = Documents(parts)
    names = list(file.arrays)
    name, number = chance.choice(names), chance.randrange(len(file.headers) + 1)
    ends = ("table_1", "key_frames", "missing", "mlp/bias_1", "auxiliary/lat", "", "..")
    other = chance.choice(
        (
            *(f"v{number}/{end}" for end in ends),
            *(*ends, f"{file.table}_2", f"{file.table}/t", f"{file.table}/c/0", f"v{number}"),
            *("extra/a", "t/0", "c", chance.choice(names), chance.choice(NODES)),
        )
    )
    mine = [(f"{other}{m[len(name) :]}", data) for m, data in parts if m.startswith(f"{name}/")]
    copied = chance.random() < 0.4
    rest = [item for item in parts if copied or not item[0].startswith(f"{name}/")]
    return added(rest, mine) if chance.random() < 0.7 else [*mine, *rest]


def _grouped(chance: random.Random, parts: Parts) -> Parts:
    """Put the arrays of the only variable into a group, as those of several lie, or into none."""
    file = Documents(parts)
    group = chance.choice(("v0", "v0", "v1", "v00", "g", "table_1"))
    if "group" in file.header:
        moved = [(name.removeprefix("v0/"), data) for name, data in parts]
    else:
        moved = [(f"{group}/{name}", data) for name, data in parts if name != DOCUMENT]
        file.header["group"] = group
    return added([(DOCUMENT, dumped(file.root))], moved)


TILES: tuple[Rule, ...] = (
    ("codec", (GONE, "fhash.transform2", "zstd", "", *OTHERS)),
    ("package", (GONE, "", *OTHERS)),
    ("data_type", (GONE, *KINDS_OF_NUMBERS, *OTHERS)),
    *[("shape|tile.*", lambda chance, old: chance.choice((*LENGTHS, old + 1, old - 1)))] * 3,
    ("shape.*", lambda chance, old: chance.choice((*LENGTHS, old + 1, old - 1, 0, -1, 1.0))),
    ("tile.*", lambda chance, old: chance.choice((*LENGTHS, old + 1, old - 1, 0, -1, 1.0))),
    ("shape|tile", lambda chance, old: chance.choice((old[::-1], old[1:], [*old, 1], [1] * 9))),
    ("shape|tile", (GONE, *OTHERS)),
    (
        "axes",
        lambda chance, old: chance.choice(
            (["t", "z", "y", "x"], ["x", "y", "z", "t"], ["", "", "", ""], ["t"] * 4, None, GONE)
        ),
    ),
    ("axes", lambda chance, old: chance.choices(("t", "z", "y", "x", "", "w"), k=4)),
    (
        "settings",
        lambda chance, old: chance.choice(
            (
                *(GONE, "", "====", "A", "AA==", "AAA", old and old[:-4], old and old + "AAAA"),
                *(old and old + "=", old and f" {old}", old and f"{old}\n", "A" * 10**6),
            )
        ),
    ),
    ("unknown", (1, {"must_understand": False})),
    *[("**", hostile)] * 2,
)
"""Keys of the attribute `tiles`."""


def _tiles(chance: random.Random, parts: Parts) -> Parts:
    """Change what is said of the tiles of an array, mostly in agreement with its index."""
    file = Documents(parts)
    coded = [document for document in file.arrays.values() if is_coded(document)]
    if not coded:
        raise NothingFitsError
    document = chance.choice(coded)
    tiles, turn = document["attributes"]["tiles"], chance.random()
    if turn < 0.1:
        document["attributes"]["tiles"] = chance.choice((*OTHERS, [tiles], json.dumps(tiles)))
    elif turn < 0.2:
        ordinary = chance.choice(list(file.arrays.values()))
        ordinary.setdefault("attributes", {})["tiles"] = tiles
    elif turn < 0.35:  # tiles that the grid has room for
        axis = chance.randrange(len(tiles["tile"]))
        tiles["tile"][axis] = chance.choice((1, 2, 3, 5, 8, 2**20, 2**40, 2**60, 2**62))
        document["shape"][axis] = -(-tiles["shape"][axis] // tiles["tile"][axis])
    else:
        put(chance, tiles, TILES)
    return file.packed()


MLP: tuple[Rule, ...] = (
    ("mlp", (None, GONE, *OTHERS)),
    ("mlp.widths|sigma|range|scales|biases|weights", (GONE, *OTHERS)),
    ("mlp.widths", ([], [1], [4], [64] * 3, [64] * 4, [65], [0], [2**40], [1.0], [3, 1], [255])),
    ("mlp.sigma", (*FLOATS, 0, 0.0, 1, 2.0**-100, 2.0**-101, 2.0**100, 2.0**101, -1, *SPECIAL)),
    ("mlp.range", (*[[a, b] for a in FLOATS for b in FLOATS[::4]], [0], [0, 1, 2], [2, 1])),
    ("mlp.scales.*", (0, 0.0, -1, 65504, 65519.9, 65520, 1e300, 6e-8, 3e-8, 2.9e-8, 1e-300)),
    ("mlp.scales|biases", lambda chance, old: chance.choice((old[1:], [*old, 1], old[::-1]))),
    ("mlp.biases.*", (127, 128, -127, -128, 255, 256, 0.0, 1.5, *LARGE)),
    (
        "mlp.weights",
        lambda chance, old: chance.choice(
            (
                *(old[:-1], old + "A", old[1:], "", old * 2, old + "=", "A" * len(old)),
                *(old.replace(old[0], letter) for letter in ("/", "+", "=", "\0", "\xe9", " ")),
                *(f"{old}\0", "+" * len(old), "A" * 10**6),
            )
        ),
    ),
    *[("mlp.**", hostile)] * 2,
)
"""Keys of the MLP."""


def _mlp(chance: random.Random, parts: Parts) -> Parts:
    """Change the MLP of the header, or give tiles another one."""
    file = Documents(parts)
    header = chance.choice(file.headers)
    document = file.arrays.get(path_of(header, TABLE))
    if document is None or header["model"]["profile"] != "compact":
        raise NothingFitsError
    settings = settings_of(document) if is_coded(document) else None
    if header.get("mlp") is None or chance.random() < 0.3:
        header["mlp"] = head_of(chance).to_json()
        if settings is not None and chance.random() < 0.9:
            head = SimpleNamespace()  # its block is empty
            put_settings(document, unchecked(settings, head=head).to_bytes(apart=True))
    if chance.random() < 0.8:
        put(chance, header, MLP)
    return file.packed()


KINDS: dict[str, Callable[[random.Random, Parts], Parts]] = {
    "text": _text,
    "value": _value,
    "key": _renamed,
    "length": _length,
    "domain": _domain,
    "coordinates": _coordinates,
    "header": _rules(HEADER),
    "array": _array,
    "integers": _integers,
    "plain": _rules(PLAIN, of="every", fits=is_plain),
    "sparse": _rules(SPARSE, of="every", fits=lambda file: "sparse" in file.header["model"]),
    "variables": _rules(VARIABLES),
    "shares": _rules(SHARES),
    "places": _places,
    "grouped": _grouped,
    "tiles": _tiles,
    "mlp": _mlp,
    "variables length": _length,
    "source": _source,
    "part": _part,
    "grown": _grown,
}
