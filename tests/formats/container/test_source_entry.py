"""A hostile `source` is damage that names its key; what was written comes back."""

from __future__ import annotations

import copy
import random
import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from fhash_formats.container import describe_metadata
from fhash_formats.container import record as strict_json
from fhash_formats.container.source_entry import MAX_BYTES, MAX_INLINE, check_source, read_metadata
from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.series import Coordinate, SourceMetadata, SourceVariable, index_coordinate

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


WRITTEN_SHAPE = (3, 1, 4, 5)
COORDS = {
    "t": Coordinate(name="time", values=np.array([0.0, 1.5, 2.0]), attributes={"units": "h"}),
    "z": Coordinate(name="height", values=np.array([2.0])),
    "y": Coordinate(name="lat", values=np.linspace(0, 1, 4, dtype=np.float32).astype(np.float64)),
    "x": index_coordinate("x", 5),
}


class Written:
    """An array of a container."""

    def __init__(self, values: np.ndarray) -> None:
        self.values, self.shape, self.dtype = values, values.shape, values.dtype
        self.attributes: dict[str, Any] = {}

    def read(self) -> np.ndarray:
        return self.values


def variable(name: str, dimensions: tuple[str, ...], values: Any, **more: Any) -> SourceVariable:
    return SourceVariable(name=name, dimensions=dimensions, values=np.asarray(values), **more)


def through(metadata: SourceMetadata, attributes: dict[str, Any] | None = None) -> Any:
    """The metadata after a file, the header's entry, and the arrays."""
    entry, arrays = describe_metadata(metadata, COORDS, attributes or {})
    header = {
        "format_version": [2, 0],
        "variable": {"name": "u", "attributes": attributes or {}},
        "domain": {"shape": list(WRITTEN_SHAPE)},
        "coordinates": {
            axis: {"name": one.name, "attributes": dict(one.attributes)}
            for axis, one in zip(("time", "z", "y", "x"), COORDS.values(), strict=True)
        },
        "source": strict_json.loads(strict_json.dumps(entry, "test")),
    }
    stored = {name: Written(values) for name, values in arrays.items()}
    return read_metadata(header, stored, COORDS), entry, arrays


def test_everything_comes_back() -> None:
    large = np.random.default_rng(0).random((4, 5)).astype("f4")
    metadata = SourceMetadata(
        dimensions={"lat": "y", "x": "x", "record": "t", "one": ""},
        variable_attributes={"units": "K", "missing_value": np.float32(1e20), "coordinates": "h"},
        variables=(
            variable("lat", ("lat",), COORDS["y"].values.astype("f4"), is_coordinate=True),
            variable("time", ("record",), [0, 1.5, 2], attributes={"units": "h", "bounds": "b"}),
            variable("height", (), 2.0, is_coordinate=True, attributes={"positive": "up"}),
            variable("b", ("record", "bnds"), np.arange(6).reshape(3, 2)),
            variable("field", ("lat", "x"), np.tile(large, 1)),
            variable("wide", ("n",), np.arange(MAX_INLINE + 1, dtype="u2")),
            variable("odd name", ("n",), np.random.default_rng(1).random(MAX_INLINE + 1)),
            variable("crs", (), np.int32(0), attributes={"name": "rotated", "a": np.int8(1)}),
            variable("label", ("one",), np.array(["é"], dtype=object), is_coordinate=True),
            variable("nan", (), np.array([0x7FC00001], "u4").view("f4")[0]),
        ),
        attributes={"title": "a", "levels": np.array([1, 2], "i2")},
        stored="int16",
        file="run.nc",
        digest="00",
    )
    back, entry, arrays = through(metadata, {"units": "K", "long_name": "made up"})
    assert back.dimensions == metadata.dimensions
    assert list(back.dimensions) == list(metadata.dimensions)
    assert (back.stored, back.file, back.digest) == ("int16", "run.nc", "00")
    np.testing.assert_equal(back.variable_attributes, metadata.variable_attributes)
    np.testing.assert_equal(back.attributes, metadata.attributes)
    for one, other in zip(metadata.variables, back.variables, strict=True):
        assert (one.name, one.dimensions) == (other.name, other.dimensions)
        assert one.is_coordinate == other.is_coordinate
        assert one.values.dtype == other.values.dtype
        assert one.values.tobytes() == other.values.tobytes() or one.values.dtype == object
        np.testing.assert_equal(dict(other.attributes), dict(one.attributes))
    assert set(arrays) == {
        "auxiliary/wide",
        "auxiliary/variable",
        "auxiliary/nan",
    }  # field is small
    by_reference = [each["axis"] for each in entry["variables"] if "axis" in each]
    assert by_reference == ["y", "t", "z"]


def test_plain_coordinates_take_few_bytes() -> None:
    metadata = SourceMetadata(
        dimensions={one.name: axis for axis, one in COORDS.items()},
        variables=tuple(
            variable(
                one.name, (one.name,), one.values, attributes=one.attributes, is_coordinate=True
            )
            for one in COORDS.values()
        ),
        variable_attributes={"units": "K"},
    )
    _, entry, arrays = through(metadata, {"units": "K"})
    assert entry == {
        "dimensions": ["t", "z", "y", "x"],
        "variables": [{"axis": axis} for axis in "tzyx"],
    }
    assert not arrays


def test_positions_that_differ_in_a_bit_are_stored() -> None:
    values = np.array([-0.0, 1, 2, 3, 4])
    metadata = SourceMetadata(
        dimensions={"time": "t", "lat": "y", "x": "x"}, variables=(variable("x", ("x",), values),)
    )
    back, entry, _ = through(metadata)
    assert "axis" not in entry["variables"][0]
    assert back.variables[0].values.tobytes() == values.tobytes()


@pytest.mark.parametrize(
    "metadata",
    [
        SourceMetadata(dimensions={}, attributes={"a": 1j}),
        SourceMetadata(dimensions={}, variables=(variable("a", (), 1j),)),
    ],
)
def test_what_has_no_form_is_refused(metadata: SourceMetadata) -> None:
    with pytest.raises(InputError):
        describe_metadata(metadata, COORDS, {})
