"""Members become arrays and a header: every member has a place, every chunk is there."""

from __future__ import annotations

import copy
import json
import random
import tracemalloc
from typing import Any

import numpy as np
import pytest
from hostile_files import (
    CHUNK,
    DOCUMENT,
    ROOT,
    edited,
    edited_header,
    put_at,
    refused,
    replaced,
)
from several_files import write_several
from table_files import HEAD, table_parts, write_table

from fhash_formats.container import Container, describe_metadata
from fhash_formats.container import record as strict_json
from fhash_formats.container.source_entry import MAX_BYTES, MAX_INLINE, check_source, read_metadata
from fhash_formats.errors import DamagedFileError, InputError, UnsupportedFileError
from fhash_formats.series import Coordinate, SourceMetadata, SourceVariable, index_coordinate


def extra_array(shape):
    metadata = {
        "shape": shape,
        "data_type": "uint8",
        "fill_value": 0,
        "chunk_key_encoding": {"name": "default"},
        "zarr_format": 3,
        "node_type": "array",
    }
    grid = {"name": "regular", "configuration": {"chunk_shape": [1] * len(shape)}}
    codecs = [
        {"name": "bytes"},
        {"name": "zstd", "configuration": {"level": 1, "checksum": False}},
        {"name": "crc32c"},
    ]
    return json.dumps({**metadata, "chunk_grid": grid, "codecs": codecs}).encode()


PLACES = {
    "chunk missing": (lambda p: [part for part in p if part[0] != CHUNK], "bias_1 has 0 chunks"),
    "all but the root missing": (lambda p: p[-1:], "array key_frames is missing"),
    "root missing": (lambda p: p[:-1], "zarr.json is missing"),
    "nothing": (lambda p: [], "zarr.json is missing"),
    "group missing": (
        lambda p: [part for part in p if part[0] != "mlp/zarr.json"],
        "lies in no group",
    ),
    "chunk outside the grid": (lambda p: [("mlp/bias_1/c/1", b"x"), *p], "bias_1 has 2 chunks"),
    "chunk of other rank": (lambda p: [(f"{CHUNK}/0", b"x"), *p], "bias_1 has 2 chunks"),
    "chunk under another name": (lambda p: [(f"{CHUNK}0", b"x"), *p], f"member {CHUNK}0"),
    "chunk number too long": (
        lambda p: [("mlp/bias_1/c/" + "9" * 400, b"x"), *p],
        "member mlp/bias_1/c/999",
    ),
    "chunk of no array": (lambda p: [("none/c/0", b"x"), *p], "belongs to no array"),
    "file of no array": (lambda p: [("readme.txt", b"x"), *p], "belongs to no array"),
    "tiles of no array": (lambda p: [("mlp/bias_1/t/0", b"x"), *p], "belongs to no array"),
    "array in an array": (
        lambda p: [("mlp/bias_1/a/zarr.json", extra_array([1])), *p],
        "lies in no group",
    ),
    "many chunks declared": (
        lambda p: [("more/zarr.json", extra_array([2**31, 2**31])), *p],
        "has 0 chunks",
    ),
    "table missing": (
        lambda p: [part for part in p if not part[0].startswith("table_2")],
        "table_2 is missing",
    ),
}


@pytest.mark.parametrize("case", PLACES)
def test_members_and_arrays(sample, samples, case) -> None:
    change, message = PLACES[case]
    refused(sample, samples.pack(change(samples.unpack(sample.read_bytes()))), message)


TEXTS = {
    "NaN": (b'{"a": NaN}', "unexpected character"),
    "Infinity": (b'{"a": -Infinity}', "no digit after minus"),
    "beyond float64": (b'{"a": 1e999}', "number is infinity"),
    "many digits": (b'{"a": ' + b"9" * 5000 + b"}", "JSON"),
    "twice": (b'{"a": 1, "a": 2}', "twice"),
    "deep lists": (b'{"a": ' + b"[" * 100_000 + b"]" * 100_000 + b"}", "deep"),
    "deep objects": (b'{"a":' * 50_000 + b"1" + b"}" * 50_000, "deep"),
    "deep and cut": (b"[" * 1_000_000, "unexpected end"),
    "no JSON": (b"zarr", "JSON"),
    "cut": (b'{"a": 1', "JSON"),
    "list": (b"[1]", "object"),
    "empty": (b"", "JSON"),
    "not UTF-8": (b'{"a": "\xff"}', "JSON"),
    "half a pair": (b'{"a": "\\ud800"}', "JSON"),
    "too long": (b" " * ((16 << 20) + 1), "2.24 bytes|limit"),
}


@pytest.mark.parametrize("case", TEXTS)
@pytest.mark.parametrize("name", [ROOT, DOCUMENT])
def test_metadata_text(sample, samples, case, name) -> None:
    text, message = TEXTS[case]
    refused(sample, replaced(sample, samples, name, text), f"member {name}: .*{message}")


def test_root_is_an_ordinary_zarr_group(sample, samples) -> None:
    refused(
        sample,
        edited(sample, samples, ROOT, lambda v: v.update(attributes={})),
        "not the group of an fhash container",
    )


def test_a_newer_format_is_named_before_its_unknown_codecs(tmp_path, sample, samples) -> None:
    def newer(root) -> None:
        root["attributes"]["fhash"]["required_features"] = ["teleport"]

    def unknown(document) -> None:
        document["codecs"][0] = {"name": "fhash.teleport"}

    path = tmp_path / "a.fhz"
    path.write_bytes(edited(sample, samples, ROOT, newer))
    refused(
        path, edited(path, samples, DOCUMENT, unknown), "feature teleport", UnsupportedFileError
    )


def test_names_are_paths_and_documents_lie_together(tmp_path, samples) -> None:
    """One read finds all documents; the root comes last."""
    path = write_several(tmp_path / "a.fhz", samples)
    names = [name for name, _ in samples.unpack(path.read_bytes())]
    documents = [name for name in names if name.endswith("zarr.json")]
    assert names[-len(documents) :] == documents
    assert documents[-1] == ROOT
    with Container.open(path) as file:
        for number, variable in enumerate(file.variables.values()):
            assert variable.header["group"] == f"v{number}"
            for name, array in variable.arrays.items():
                # An array beside the data that an earlier variable has lies with that.
                assert array.name in (f"v{number}/{name}", f"v0/{name}")
    path = write_table(tmp_path / "b.fhz", samples.compact_header(), table_parts())
    with Container.open(path) as one:
        assert [array.name for array in one.arrays.values()] == list(one.arrays)
        assert "group" not in one.header


FIRST, HEADS = "attributes.fhash.variables.0", "attributes.fhash.variables.0.mlp"
ROOTS = {
    "no list": ("attributes.fhash.variables", {}, "a list of at least one object"),
    "an empty list": ("attributes.fhash.variables", [], "a list of at least one object"),
    "a list of numbers": ("attributes.fhash.variables", [1], "variables is not objects"),
    "a name that is no text": (f"{FIRST}.name", 5, "name is not a text"),
    "a name twice": (f"{FIRST}.name", "w", "names that stand once"),
    "no group": (f"{FIRST}.group", ..., "variable 'u': header key group"),
    "a group of another": (f"{FIRST}.group", "v1", "variable 'u': header key group"),
    "a group of no number": (f"{FIRST}.group", 0, "variable 'u': header key group"),
    "coordinates of no variable": (f"{FIRST}.coordinates.x", 3, "'u': header key coordinates"),
    "coordinates of itself": (f"{FIRST}.coordinates.x", 0, "'u': header key coordinates"),
    "coordinates in a ring": (f"{FIRST}.coordinates.z", 1, "'u': header key coordinates"),
    "coordinates of a fraction": (f"{FIRST}.coordinates.x", 0.5, "'u': header key coordinates"),
    "coordinates of another length": (
        f"{FIRST}.coordinates.y",
        {"values": [0, 1]},
        "variable 'u': header key coordinates",
    ),
    "a feature that the root lacks": ("attributes.fhash.required_features", [], "'u': .*features"),
    "a wrong header": (f"{FIRST}.dilation", -1, "variable 'u': header key dilation"),
    "a header of another box": (
        f"{FIRST}.feature_bounding_box",
        [[0, 3], [0, 5], [0, 6]],
        "variable 'u': .*levels",
    ),
    "shares that are a list": (f"{FIRST}.shares", ["auxiliary/lat"], "an object"),
    "a shared table": (f"{FIRST}.shares", {"table_1": 2}, "is missing, or is there"),
    "shares of no variable": (f"{FIRST}.shares", {"auxiliary/a": 3}, "number of a variable"),
    "shares of no number": (f"{FIRST}.shares", {"auxiliary/a": "w"}, "number of a variable"),
    "shares that are not there": (
        f"{FIRST}.shares",
        {"auxiliary/a": 2},
        "auxiliary/a is missing",
    ),
    "shares of another table": (
        f"{FIRST}.shares",
        {"auxiliary/a": [2, "table_1"]},
        "the number",
    ),
    "shares of three": (f"{FIRST}.shares", {"auxiliary/a": [2, "auxiliary/a", 1]}, "the number"),
    "shares of names": (f"{FIRST}.shares", {"auxiliary/a": [["auxiliary/a"], 2]}, "the number"),
    "shares of another name that are not there": (
        f"{FIRST}.shares",
        {"auxiliary/a": [2, "auxiliary/b"]},
        "auxiliary/a is missing",
    ),
    "no MLP": (HEADS, ..., "variable 'u': header key mlp is missing"),
    "an identity": (HEADS, None, "variable 'u': .*lack that of the header"),
    "an MLP that the settings do not have": (
        "attributes.fhash.variables.2.mlp",
        HEAD.to_json(),
        "variable 'w': .*lack that of the header",
    ),
    "an MLP that is text": (HEADS, "AAAA", "variable 'u': header key mlp"),
    "no widths": (f"{HEADS}.widths", ..., r"header key mlp\.widths"),
    "four widths": (f"{HEADS}.widths", [3, 3, 3, 3], r"header key mlp\.widths"),
    "other widths": (f"{HEADS}.widths", [4], r"header key mlp\.scales|header key mlp"),
    "a wide layer": (f"{HEADS}.widths", [65], r"header key mlp\.widths"),
    "sigma of text": (f"{HEADS}.sigma", "1", r"header key mlp\.sigma"),
    "sigma of 0": (f"{HEADS}.sigma", 0, "header key mlp: "),
    "a range of one": (f"{HEADS}.range", [1.0], r"header key mlp\.range"),
    "a range that falls": (f"{HEADS}.range", [1.0, 0.0], "header key mlp: "),
    "a scale less": (f"{HEADS}.scales", [1.0] * 3, r"header key mlp\.scales"),
    "a scale of 0": (f"{HEADS}.scales.1", 0, "header key mlp: "),
    "a scale beyond float16": (f"{HEADS}.scales.1", 1e9, "header key mlp: "),
    "a bias less": (f"{HEADS}.biases", [0, 1, 2], r"header key mlp\.biases"),
    "a large bias": (f"{HEADS}.biases.0", 128, r"header key mlp\.biases"),
    "weights that are a list": (f"{HEADS}.weights", [1], r"header key mlp\.weights"),
    "weights beyond the letters": (f"{HEADS}.weights", "/" * 87, r"header key mlp\.weights"),
    "a weight less": (f"{HEADS}.weights", "A" * 86, "header key mlp: "),
    "a weight more": (f"{HEADS}.weights", "A" * 88, "header key mlp: "),
}


@pytest.mark.parametrize("case", ROOTS)
def test_headers_that_are_refused(tmp_path, samples, case) -> None:
    path = write_several(tmp_path / "a.fhz", samples, paper=False)
    place, value, message = ROOTS[case]
    refused(path, edited(path, samples, ROOT, lambda root: put_at(root, place, value)), message)


def test_an_mlp_stands_once(tmp_path, samples) -> None:
    """Not in the settings of the table as well."""
    path = write_table(tmp_path / "a.fhz", samples.compact_header(), table_parts())
    whole = table_parts().settings.to_text()
    place = "attributes.tiles.settings"
    data = edited(path, samples, "table_1/zarr.json", lambda v: put_at(v, place, whole))
    refused(path, data, "they have a head of their own")


@pytest.mark.parametrize("name", ["a", "v3", "v00/a", "v0a", "u/table_1"])
def test_arrays_that_belong_to_no_variable(tmp_path, samples, name) -> None:
    """They are checked as all are, but no variable has them."""
    path = write_several(tmp_path / "a.fhz", samples, paper=False)
    parts = samples.unpack(path.read_bytes())
    source = "v0/auxiliary/area/"
    copies = [(n.replace(source, f"{name}/"), data) for n, data in parts if n.startswith(source)]
    group = json.dumps({"zarr_format": 3, "node_type": "group"}).encode()
    folders = [name.rsplit("/", k)[0] for k in range(1, name.count("/") + 1)]
    groups = [(f"{folder}/zarr.json", group) for folder in folders]
    path.write_bytes(samples.pack([*copies, *groups, *parts]))
    with Container.open(path) as file:
        assert file.verify() == len(file.arrays) == 6
        assert not file.arrays[name].read().any()
        for variable in file.variables.values():
            assert name not in {array.name for array in variable.arrays.values()}


def test_a_missing_chunk_of_any_variable_is_refused(tmp_path, samples) -> None:
    path = write_several(tmp_path / "a.fhz", samples)
    parts = samples.unpack(path.read_bytes())
    for missing in (
        *("v2/table_1/t/0", "v2/table_1/c/0/0/0/0"),
        *("v0/auxiliary/area/c/0/0", "v3/key_frames/c/0"),
    ):
        assert missing in dict(parts)
        data = samples.pack([part for part in parts if part[0] != missing])
        refused(path, data, "chunks|is missing")


SHAPE_SOURCE_ENTRY = [2, 1, 3, 4]


def header(source: Any) -> dict[str, Any]:
    return {
        "format_version": [2, 0],
        "variable": {"name": "u", "attributes": {"units": "K"}},
        "domain": {"shape": SHAPE_SOURCE_ENTRY},
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


class Stored:
    """An array of a container."""

    def __init__(self, values: np.ndarray) -> None:
        self.values, self.shape, self.dtype = values, values.shape, values.dtype
        self.attributes: dict[str, Any] = {}

    def read(self) -> np.ndarray:
        return self.values


ARRAYS = {
    "auxiliary/a": Stored(np.zeros((3, 4), np.float32)),
    "auxiliary/huge": Stored(np.broadcast_to(np.int8(0), 1 << 30)),
}


def test_a_sound_entry_is_taken() -> None:
    check_source(header(sound()), ARRAYS)
    assert read_metadata({"format_version": [2, 0]}, {}, {}) is None


HOSTILE = [
    ("dimensions", "tzyx"),
    ("dimensions", ["t", "y"]),
    ("dimensions", ["t", "y", "x", "x"]),
    ("dimensions.+", ["../x", ""]),
    ("dimensions.+", ["lon", ""]),
    ("dimensions.+", ["a", "w"]),
    ("dimensions.+", ["a"]),
    ("dimensions.+", 7),
    ("dimensions", ["t", "y", "x", *([f"d{n}", ""] for n in range(20))]),
    ("lengths", [2]),
    ("lengths.bnds", 0),
    ("lengths.bnds", 2.0),
    ("lengths.bnds", 3),
    ("lengths.lon", 4),
    ("lengths.a/b", 4),
    ("variable", "text"),
    ("variable.valid_min", {"int16": 1 << 20}),
    ("attributes", [1]),
    ("attributes.title", {}),
    ("attributes.a\0b", 1),
    ("stored", "int12"),
    ("file", 3),
    ("digest", None),
    ("date", 7),
    ("variables", {}),
    ("variables", [{}] * 2000),
    ("variables.0.axis", "w"),
    ("variables.0.dtype", "text"),
    ("variables.0.dtype", "object"),
    ("variables.0.dimensions", ["y"]),
    ("variables.1.name", "u"),
    ("variables.1.name", "time"),
    ("variables.1.name", "a/b"),
    ("variables.1.name", "\n"),
    ("variables.2.name", "__a"),
    ("variables.2.dimensions", ["y", "other"]),
    ("variables.2.dimensions", ["y", "y"]),
    ("variables.2.values", [0]),
    ("variables.2.values", None),
    ("variables.2.coordinate", 1),
    ("variables.2.attributes", []),
    ("variables.3.array", "missing"),
    ("variables.3.array", 4),
    ("variables.3.dtype", "float64"),
    ("variables.3.dimensions", ["lon", "y"]),
]


@pytest.mark.parametrize(("place", "value"), HOSTILE, ids=range(len(HOSTILE)))
def test_a_hostile_entry_is_damage(place: str, value: Any) -> None:
    source = edited_header(sound(), place, value)
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
    coords = {
        axis: index_coordinate(axis, n) for axis, n in zip("tzyx", SHAPE_SOURCE_ENTRY, strict=True)
    }
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
    many = {f"a{number}": texts for number in range(3)}
    listed = {"name": "c", "dimensions": ["long"], "values": [""] * 100_000, "dtype": "bytes65536"}
    hostile = [
        [("attributes.a", {"bytes65536": [""] * 100_000})],
        [("attributes", many)],
        [("variables.1.attributes", many)],
        [("lengths", {"bnds": 2, "long": 100_000}), ("variables.+", listed)],
    ]
    for changes in hostile:
        source = sound()
        for place, value in changes:
            put_at(source, place, value)
        tracemalloc.start()
        with pytest.raises(DamagedFileError, match="bytes"):
            check_source(header(source), ARRAYS)
        assert tracemalloc.get_traced_memory()[1] < 1.2 * MAX_BYTES, changes[0][0]
        tracemalloc.stop()


WRITTEN_SHAPE = (3, 1, 4, 5)
COORDS = {
    "t": Coordinate(name="time", values=np.array([0.0, 1.5, 2.0]), attributes={"units": "h"}),
    "z": Coordinate(name="height", values=np.array([2.0])),
    "y": Coordinate(name="lat", values=np.linspace(0, 1, 4, dtype=np.float32).astype(np.float64)),
    "x": index_coordinate("x", 5),
}


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
    stored = {name: Stored(values) for name, values in arrays.items()}
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
            variable("same", ("n",), np.arange(MAX_INLINE + 1, dtype="u2")),
            variable("wider", ("n",), np.arange(MAX_INLINE + 1, dtype="u4")),
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
        "auxiliary/wide",  # and for same
        "auxiliary/wider",
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
