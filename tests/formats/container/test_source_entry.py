"""A hostile `source` is damage that names its key; an older file may hold anything there."""

from __future__ import annotations

import copy
import random
import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from fhash_formats.container.source_entry import MAX_BYTES, check_source, read_metadata
from fhash_formats.errors import DamagedFileError
from fhash_formats.series import index_coordinate

SHAPE = [2, 1, 3, 4]


class Array:
    """An array of a container."""

    def __init__(self, shape: tuple[int, ...], dtype: str) -> None:
        self.shape, self.dtype = shape, np.dtype(dtype)
        self.attributes: dict[str, Any] = {}


def header(source: Any) -> dict[str, Any]:
    return {
        "format_version": [2, 0],
        "variable": {"name": "u", "attributes": {"units": "K"}},
        "domain": {"shape": SHAPE},
        "coordinates": {"time": {"attributes": {"axis": "T"}}, "z": {}, "y": {}, "x": {}},
        "source": source,
    }


def sound() -> dict[str, Any]:
    return {
        "dimensions": ["t", "y", ["lon", "x"], ["one", ""]],
        "lengths": {"bnds": 2},
        "variable": {"units": None, "valid_min": {"int16": 3}},
        "variables": [
            {"axis": "t", "dtype": "int32"},
            {"axis": "x", "name": "lon"},
            {"name": "b", "dimensions": ["y", "bnds"], "values": [0, 1, 2, 3, 4, 5]},
            {"name": "a", "dimensions": ["y", "lon"], "dtype": "float32", "array": "a"},
        ],
        "attributes": {"title": "a"},
        "stored": "int16",
        "file": "run.nc",
        "digest": "00",
        "date": "2026-01-01T00:00:00Z",
    }


ARRAYS = {"auxiliary/a": Array((3, 4), "float32"), "auxiliary/huge": Array((1 << 30,), "int8")}


def test_a_sound_entry_is_taken() -> None:
    check_source(header(sound()), ARRAYS)
    assert read_metadata({"format_version": [2, 0]}, {}, {}) is None


def put(*path: Any, value: Any) -> Callable[[dict[str, Any]], None]:
    """A change of one place of an entry."""

    def change(source: dict[str, Any]) -> None:
        place: Any = source
        for key in path[:-1]:
            place = place[key]
        if path[-1] == "+":
            place.append(value)
        else:
            place[path[-1]] = value

    return change


HOSTILE = [
    put("dimensions", value="tzyx"),
    put("dimensions", value=["t", "y"]),
    put("dimensions", value=["t", "y", "x", "x"]),
    put("dimensions", "+", value=["../x", ""]),
    put("dimensions", "+", value=["lon", ""]),
    put("dimensions", "+", value=["a", "w"]),
    put("dimensions", "+", value=["a"]),
    put("dimensions", "+", value=7),
    put("dimensions", value=["t", "y", "x", *([f"d{n}", ""] for n in range(20))]),
    put("lengths", value=[2]),
    put("lengths", "bnds", value=0),
    put("lengths", "bnds", value=2.0),
    put("lengths", "bnds", value=3),
    put("lengths", "lon", value=4),
    put("lengths", "a/b", value=4),
    put("variable", value="text"),
    put("variable", "valid_min", value={"int16": 1 << 20}),
    put("attributes", value=[1]),
    put("attributes", "title", value={}),
    put("attributes", "a\0b", value=1),
    put("stored", value="int12"),
    put("file", value=3),
    put("digest", value=None),
    put("date", value=7),
    put("variables", value={}),
    put("variables", value=[{}] * 2000),
    put("variables", 0, "axis", value="w"),
    put("variables", 0, "dtype", value="text"),
    put("variables", 0, "dtype", value="object"),
    put("variables", 0, "dimensions", value=["y"]),
    put("variables", 1, "name", value="u"),
    put("variables", 1, "name", value="time"),
    put("variables", 1, "name", value="a/b"),
    put("variables", 1, "name", value="\n"),
    put("variables", 2, "name", value="__a"),
    put("variables", 2, "dimensions", value=["y", "other"]),
    put("variables", 2, "dimensions", value=["y", "y"]),
    put("variables", 2, "values", value=[0]),
    put("variables", 2, "values", value=None),
    put("variables", 2, "coordinate", value=1),
    put("variables", 2, "attributes", value=[]),
    put("variables", 3, "array", value="missing"),
    put("variables", 3, "array", value=4),
    put("variables", 3, "dtype", value="float64"),
    put("variables", 3, "dimensions", value=["lon", "y"]),
]


@pytest.mark.parametrize("number", range(len(HOSTILE)))
def test_a_hostile_entry_is_damage(number: int) -> None:
    source = copy.deepcopy(sound())
    HOSTILE[number](source)
    with pytest.raises(DamagedFileError):
        check_source(header(source), ARRAYS)


def test_arrays_of_too_many_bytes_are_damage() -> None:
    source = sound()
    source["lengths"]["n"] = MAX_BYTES * 4
    source["variables"].append({"name": "h", "dimensions": ["n"], "dtype": "int8", "array": "huge"})
    with pytest.raises(DamagedFileError, match=r"bytes|array"):
        check_source(header(source), ARRAYS)


def places(values: Any) -> list[tuple[Any, Any]]:
    """Every place in nested JSON values, as what holds it and its key."""
    found = []
    keys = values.keys() if isinstance(values, dict) else range(len(values))
    for key in list(keys):
        found.append((values, key))
        if isinstance(values[key], dict | list):
            found += places(values[key])
    return found


def test_mutations_are_damage_or_are_read() -> None:
    chance = random.Random(7)
    others = [None, True, 0, -1, 2**70, 0.5, "", "t", "lon", "NaN", [], [1], {}, {"int8": 1}]
    coords = {axis: index_coordinate(axis, n) for axis, n in zip("tzyx", SHAPE, strict=True)}
    read = 0
    for _ in range(1500):
        source = copy.deepcopy(sound())
        source["variables"].pop()
        for _ in range(chance.choice((1, 1, 2, 3))):
            holder, key = chance.choice(places(source))
            if chance.random() < 0.2:
                del holder[key]
            else:
                holder[key] = copy.deepcopy(chance.choice(others))
        try:
            check_source(header(source), ARRAYS)
        except DamagedFileError:
            continue
        assert read_metadata(header(source), ARRAYS, coords) is not None
        read += 1
    assert 100 < read < 1400


def test_no_object_is_damage() -> None:
    with pytest.raises(DamagedFileError, match="source"):
        check_source(header("text"), ARRAYS)


def test_short_texts_of_a_long_type_take_no_memory_before_they_are_refused() -> None:
    """65,536 bytes of memory for 3 in the file: attributes count as arrays do."""
    texts = {"bytes65536": [""] * 3000}
    hostile = [
        put("attributes", "a", value={"bytes65536": [""] * 100_000}),
        put("attributes", value={f"a{number}": texts for number in range(3)}),
        put("variables", 1, "attributes", value={f"a{number}": texts for number in range(3)}),
        put("lengths", value={"bnds": 2, "long": 100_000}),
    ]
    for number, change in enumerate(hostile):
        source = copy.deepcopy(sound())
        change(source)
        if number == 3:
            listed = {"name": "c", "dimensions": ["long"], "values": [""] * 100_000}
            source["variables"].append({**listed, "dtype": "bytes65536"})
        tracemalloc.start()
        with pytest.raises(DamagedFileError, match="bytes"):
            check_source(header(source), ARRAYS)
        assert tracemalloc.get_traced_memory()[1] < 1.2 * MAX_BYTES, number
        tracemalloc.stop()
