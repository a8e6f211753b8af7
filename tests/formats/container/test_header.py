"""Header and metadata documents: fields are checked, every bit of a position comes back."""

from __future__ import annotations

import copy
import json
import re
import zipfile
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile_files import ROOT, edited, edited_header, put_at, read_everything, refused

from fhash_formats.container import (
    Container,
    ContainerWriter,
    describe_coordinates,
    read_metadata,
    validate_header,
)
from fhash_formats.container.array import TILES
from fhash_formats.container.header import (
    DEFAULTS,
    LOWEST,
    MAX_LISTED,
    MAX_RULED,
    MAX_ULPS,
    MISSING_ARRAY,
    MLP,
    STEPS,
    brief,
    complete,
    describe_positions,
    positions,
)
from fhash_formats.container.hierarchy import GROUP_KEY, SHARES, VARIABLES, read_headers
from fhash_formats.container.record import MAX_DEPTH, dumps, loads
from fhash_formats.container.zip_file import FORMAT_VERSION
from fhash_formats.errors import DamagedFileError, InputError, UnsupportedFileError
from fhash_formats.series import AXIS_NAMES, Coordinate, index_coordinate
from fhash_formats.support.values import DTYPES

LARGEST = float(np.finfo(np.float64).max)
UNEVEN = np.cumsum(np.random.default_rng(0).random(MAX_LISTED))

RULED = {
    "plain index": (np.arange(128.0), {}),
    "one": (np.array([5.5]), {"start": 5.5}),
    "descending": (np.arange(90, -90.5, -0.5), {"start": 90, "step": -0.5}),
    "constant": (np.full(7, 2.0), {"start": 2, "step": 0}),
    "product and sum": (np.arange(128) * 0.1 + 5, {"start": 5, "step": 0.1}),
    "large": (1e300 + np.arange(5) * 1e299, {"start": 1e300, "step": 1e299}),
    "two far apart": (np.array([0.0, 3e-320]), {"step": 3e-320}),
    "float32": (
        np.linspace(0.1, 9.9, 128, dtype=np.float32).astype(float),
        {"start": 0.1, "dtype": "float32"},
    ),
    "last": (np.linspace(-3.3, 7.1, 128), {"start": -3.3, "ulps": [1]}),
    "an end that is early": (np.append(np.arange(80) * 0.25, 19.8), {"step": 0.25}),
}
LISTED = {
    "uneven": (UNEVEN, None),
    "uneven float32": (UNEVEN.astype(np.float32).astype(float), "float32"),
    "negative zero": (np.array([-0.0, 1.0, 2.0]), "float32"),
    "repeated": (np.array([0.0, 1.0, 1.0, 1.0]), "float32"),
    "to the end of float64 and back": (np.array([0.0, LARGEST, 0.0]), None),
    "a range beyond float64": (np.array([-1.7e308, 1.7e308]), None),
}
NEARLY = {
    "cell centres": ((np.arange(48) + 0.5) / 48, "float64"),
    "fractions": (np.arange(80) / 80, "float64"),
    "middles around 0": ((np.arange(100) + 0.5) / 100 * 2 - 1, "float64"),
    "means of edges": (
        (lambda edges: 0.5 * (edges[1:] + edges[:-1]))(np.linspace(-9.3, -0.1, 301)),
        "float64",
    ),
}
TEXTS = {
    "not a number": (np.array([0.5, np.nan]), [0.5, "NaN"]),
    "infinities": (np.array([-np.inf, 1.0, np.inf]), ["-Infinity", 1.0, "Infinity"]),
}
TOO_MANY = {
    "not finite": np.append(UNEVEN, np.nan),
    "many uneven": np.append(UNEVEN, 1e3),
    "very many": np.arange(MAX_RULED + 1.0),
}


def there_and_back(values):
    """The description of positions, which gives every bit of them, also through JSON."""
    description = describe_positions(values)
    restored = positions(json.loads(json.dumps(description)), values.size)
    assert restored.tobytes() == values.tobytes()
    return description


@pytest.mark.parametrize("case", RULED)
def test_rules(case) -> None:
    values, expected = RULED[case]
    description = there_and_back(values)
    assert "values" not in description
    assert {key: description.get(key) for key in expected} == expected
    assert len(json.dumps(description)) < 100


@pytest.mark.parametrize("case", LISTED)
def test_lists(case) -> None:
    values, dtype = LISTED[case]
    description = there_and_back(values)
    assert len(description["values"]) == values.size
    assert description.get("dtype") == dtype


@pytest.mark.parametrize("case", NEARLY)
def test_rules_that_hold_but_for_a_few_units_in_the_last_place(case) -> None:
    values, dtype = NEARLY[case]
    description = there_and_back(values)
    assert values.size // 2 < len(description["ulps"]) <= values.size
    assert description["ulps"][0] != 0
    assert 0 < max(map(abs, description["ulps"])) <= MAX_ULPS
    assert len(json.dumps(description)) < 5 * values.size + 60
    assert description.get("dtype", "float64") == dtype


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_ulps_lead_over_zero_and_no_farther_than_infinity(dtype) -> None:
    tiny, most = float(np.finfo(dtype).smallest_subnormal), float(np.finfo(dtype).max)
    rule = {"start": 0, "step": 0, "dtype": dtype, "ulps": [0, 1, -2, 3]}
    np.testing.assert_array_equal(positions(rule, 4), [0, tiny, -2 * tiny, 3 * tiny])
    rule = {"start": tiny, "step": -2 * tiny, "dtype": dtype, "ulps": [-1, 1]}
    result = positions(rule, 2)
    np.testing.assert_array_equal(result, [0, 0])
    assert not np.signbit(result).any()
    rule = {"start": -most, "step": 0, "dtype": dtype, "ulps": [-1, -(2**52) + 1, 0]}
    np.testing.assert_array_equal(positions(rule, 3), [-np.inf, -np.inf, -most])


@pytest.mark.parametrize("case", TEXTS)
def test_positions_that_are_no_numbers_are_texts(case) -> None:
    values, listed = TEXTS[case]
    assert there_and_back(values) == {"values": listed}


@pytest.mark.parametrize("case", TOO_MANY)
def test_irregular_positions_beyond_a_limit_are_refused(case) -> None:
    x = Coordinate(name="x", values=TOO_MANY[case])
    with pytest.raises(InputError, match=r"axis x has [\d,]+ irregular positions.*regular"):
        describe_coordinates(coords() | {"x": x})


def test_random_positions_come_back() -> None:
    rng = np.random.default_rng(1)
    for _ in range(300):
        size = int(rng.integers(1, 100))
        # People write starts of few digits, and steps of more.
        start, step = (
            float(f"{rng.normal() * 10.0 ** rng.integers(-4, 5):.{rng.integers(1, most)}g}")
            for most in (6, 12)
        )
        values = start + step * np.arange(size)
        if rng.random() < 0.5:
            values = values.astype(np.float32).astype(np.float64)
        there_and_back(values)


def coords():
    return {
        "t": Coordinate(
            name="time", values=np.array([0, 0.5, 2.0, 2.25]), attributes={"units": "h"}
        ),
        "z": index_coordinate("z", 3),
        "y": Coordinate(
            name="lat", values=np.array([1.0, np.nan, 3, 4, np.inf]), attributes={"units": "deg"}
        ),
        "x": Coordinate(name="lon", values=np.arange(6) * 0.25),
    }


def write(path, header):
    with ContainerWriter(path) as writer:
        writer.add_whole("table_1", np.zeros(header["model"]["levels"][0], dtype=np.float32))
        writer.commit(header)


def test_coordinates_of_a_series_come_back(tmp_path, samples) -> None:
    given = coords()
    header = {**samples.compact_header(), "coordinates": describe_coordinates(given)}
    assert list(header["coordinates"]) == ["time", "y", "x"]
    write(tmp_path / "a.fhz", header)
    with Container.open(tmp_path / "a.fhz") as container:
        for axis, stored in (("t", "time"), ("z", "z"), ("y", "y"), ("x", "x")):
            coordinate = container.coordinate(stored)
            assert (coordinate.name, dict(coordinate.attributes)) == (
                given[axis].name,
                dict(given[axis].attributes),
            )
            np.testing.assert_array_equal(coordinate.values, given[axis].values)


def test_ulps_need_a_rule(tmp_path, samples) -> None:
    header = samples.compact_header()
    header["coordinates"]["y"] = {"ulps": [0, 1, 0, -1, 0]}
    write(tmp_path / "a.fhz", header)
    for wrong in ([], [0] * 6, [0, 0.5, 0, 0, 0], [2**52], None):
        header["coordinates"]["y"] = {"ulps": wrong}
        with pytest.raises(InputError, match="ulps"):
            write(tmp_path / "b.fhz", header)
    header["coordinates"]["y"] = {"values": [0, 1, 2, 3, 4], "ulps": [0] * 5}
    with pytest.raises(InputError, match="whole numbers of a rule"):
        write(tmp_path / "b.fhz", header)


@pytest.mark.parametrize(
    ("description", "key"),
    [
        ([], "x"),
        ({"values": [0, 1]}, "x.values"),
        ({"values": [0, 1, 2, 3, 4, None]}, "x.values"),
        ({"values": [0, 1, 2, 3, 4, "nan"]}, "x.values"),
        ({"values": [0, 1, 2, 3, 4, True]}, "x.values"),
        ({"start": "0"}, "x.start"),
        ({"start": 10**400}, "x.start"),
        ({"step": None}, "x.step"),
        ({"ulps": [True]}, "x.ulps"),
        ({"dtype": "float16"}, "x.dtype"),
        ({"dtype": ["float32"]}, "x.dtype"),
        ({"name": 5}, "x.name"),
        ({"attributes": []}, "x.attributes"),
    ],
)
def test_wrong_description_is_named(samples, description, key) -> None:
    header = {**samples.compact_header(), "format": "fhash", "format_version": [3, 0]}
    validate_header(header)
    header["coordinates"] = {"x": description}
    with pytest.raises(
        DamagedFileError, match=rf"header key coordinates[.]{key.replace('.', '[.]')}\b"
    ):
        validate_header(header)


def test_few_bytes_do_not_ask_for_much_memory(samples) -> None:
    header = {**samples.compact_header(), "format": "fhash", "format_version": [3, 0]}
    header["domain"]["shape"][3] = MAX_RULED + 1
    with pytest.raises(DamagedFileError, match=r"coordinates[.]x.*of at most 67108864 positions"):
        validate_header(header)


FIXED = {"format": "fhash", "format_version": [3, 0], "required_features": []}
VERSION = {"format": "fhash", "format_version": [3, 0]}


BAD = [
    ("encoder", ...),
    ("encoder", []),
    ("encoder.version", 1),
    ("encoder.took_seconds", "1 s"),
    ("encoder.predicted", 2.0),
    ("encoder.predicted", {"seconds": "1 s"}),
    ("variable.name", ...),
    ("variable.units", None),
    ("variable.dtype", "complex64"),
    ("variable.dtype", ["float32"]),
    ("variable.attributes", []),
    ("domain", [4, 3, 5, 6]),
    ("domain.shape", [4, 3, 5]),
    ("domain.shape", [0, 3, 5, 6]),
    ("domain.shape", [4, 3, 5, 2**41]),
    ("domain.shape", [4, 3, 5, True]),
    ("value_range", [1.0, 0.0]),
    ("value_range", [0.0]),
    ("value_range", [0.0, "1"]),
    ("value_range", [0, 10**400]),
    ("value_range", [-1e39, 0]),
    ("value_range", [0, 1e300]),
    ("background", -1e39),
    ("background", None),
    ("background", 10**400),
    ("background", True),
    ("feature_bounding_box", [[0, 3], [1, 5]]),
    ("feature_bounding_box", [[0, 3], [1, 5], [0, 7]]),
    ("feature_bounding_box", [[0, 3], [5, 5], [0, 6]]),
    ("feature_bounding_box", [[-1, 3], [1, 5], [0, 6]]),
    ("feature_bounding_box", [[0, 3], [1, 5], [0.0, 6]]),
    ("feature_bounding_box", [[0, 3], [1, 5], 6]),
    ("feature_bounding_box", None),
    ("features", []),
    ("features", "all"),
    ("features", [None]),
    ("dilation", -1),
    ("dilation", "1"),
    ("model", None),
    ("model.profile", 1),
    ("model.fold", 1),
    ("model.embedding_size", 0),
    ("model.embedding_size", 2000),
    ("model.hidden_layers", -1),
    ("model.hidden_layers", 10**9),
    ("model.width", 0),
    ("model.tables", "float64"),
    ("model.levels", []),
    ("model.levels", [[2, 3, 4, 6]] * 65),
    ("model.levels", [[2, 3, 4, 6], [2, 2, 2]]),
    ("model.levels", [[2, 3, 4, 6], [2, 2, 5, 2]]),
    ("model.levels", [[2, 3, 4, 6], [2, 0, 2, 2]]),
    ("model.levels", [[2, 3, 5, 6], [2, 2, 2, 3]]),
    ("model.levels", {"a": 1}),
    ("model.levels", [[5, 3, 4, 6], [2, 2, 2, 3]]),
    ("model.parameters", ...),
    ("model.parameters", 1.5),
    ("coreset_fraction", ...),
    ("coreset_fraction", 1.5),
    ("coreset_fraction", None),
    ("training", ...),
    ("training.seconds", ...),
    ("training.seconds", "1"),
    ("training.epochs", None),
    ("training.device", 0),
    ("training.restarts", -1),
    ("training.restarts", "1"),
    ("training.learning_rate", "0.1"),
    ("config", None),
    ("quality", ...),
    ("quality.psnr", "48"),
    ("quality.bulk", 40),
    ("quality.between", "NaN"),
    ("quality.between", {"psnr": "40"}),
    ("quality.bulk", {"psnr": 40}),
    ("quality.bulk", {"psnr": "40", "range": [0, 1]}),
    ("quality.bulk", {"range": [1, 0]}),
    ("history", [1]),
    ("history", [{"seconds": "1"}]),
]


@pytest.mark.parametrize(("path", "value"), BAD)
def test_wrong_key_is_named(samples, path, value) -> None:
    header = {**FIXED, **samples.header()}
    validate_header(header)
    with pytest.raises(
        DamagedFileError, match=rf"header key {path.replace('.', '[.]')}\b"
    ) as caught:
        validate_header(edited_header(header, path, value))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("novelty", [1, 2]),
        ("model.novelty", {"a": None}),
        ("value_range", [1, 1]),
        ("background", -3),
        ("quality", {}),
        ("quality.psnr", None),
        ("quality.bulk", None),
        ("quality.between", None),
        ("quality.between", {"psnr": 40, "fringe_fraction": 0.5}),
        ("quality.bulk", {"psnr": 40, "range": [0, 1]}),
        ("quality.bulk", {"psnr": None, "range": [1, 1.5]}),
        ("training.seconds", 0.5),
        ("history", {}),
        ("history", {"epoch": [1, 2], "seconds": [None, 0.5]}),
        ("variable.units", ""),
        ("format_version", [3, 3]),
    ],
)
def test_allowed(samples, path, value) -> None:
    validate_header(edited_header({**FIXED, **samples.header()}, path, value))


@pytest.mark.parametrize("dtype", ["float64", "int64", "uint32"])
def test_sources_that_decode_to_float64_may_have_its_range(samples, dtype) -> None:
    header = edited_header({**FIXED, **samples.header()}, "variable.dtype", dtype)
    validate_header({**header, "value_range": [-1e300, 1e300], "background": 1e299})


def test_a_table_that_overflows_the_type_of_decoded_values_is_refused(samples) -> None:
    header = {**FIXED, **samples.compact_header()}
    validate_header(edited_header(header, "model.tables", "int32"))
    with pytest.raises(DamagedFileError, match=r"header key model\.tables"):
        validate_header(edited_header(header, "model.tables", "float64"))


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("required_features", []),
        ("model.levels", [[4, 3, 4, 6], [2, 2, 2, 3]]),
        ("model.levels", [[5, 3, 4, 6]]),
        ("model.levels", [[4, 3, 4, 5]]),
        ("model.embedding_size", 2),
        ("model.tables", "complex64"),
        ("model.parameters", -1),
        ("model.tiling", [1.1]),
        ("model.tiling", {"price": "1.1"}),
        ("model.tiling", {"tried": 1.5}),
        ("model.between", "cubic"),
        ("model.between", {"rule": "quintic"}),
        ("model.between", {"rule": "cubic", "gain_db": "1.8"}),
        ("coordinates", []),
        ("history", 1),
        ("history", {"psnr": [1]}),
        ("history", {"epoch": [1, 2], "psnr": [1]}),
        ("history", {"epoch": [1, "2"]}),
    ],
)
def test_wrong_key_of_the_profile_compact_is_named(samples, path, value) -> None:
    with pytest.raises(DamagedFileError, match=rf"header key {path.replace('.', '[.]')}\b"):
        validate_header(edited_header(samples.compact_header() | VERSION, path, value))


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("model.parameters", 0),
        ("model.tables", "uint16"),
        ("model.tiling", {}),
        ("model.tiling", {"price": 1, "tried": 3}),
        ("model.between", {"rule": "linear"}),
        ("model.between", {"rule": "cubic", "gain_db": None}),
        ("coordinates", {}),
        ("history", {}),
        ("history", {"epoch": [1, 2], "psnr": [40.5, None]}),
    ],
)
def test_allowed_in_the_profile_compact(samples, path, value) -> None:
    validate_header(edited_header(samples.compact_header() | VERSION, path, value))


ROOTS = {
    "newer major": (
        ("format_version", [4, 1]),
        "the file is of format 4.x; this version reads format 3.x: upgrade",
        UnsupportedFileError,
    ),
    "older major": (
        ("format_version", [2, 8]),
        "the file is of format 2.x; this version reads format 3.x: encode the source again",
        UnsupportedFileError,
    ),
    "feature": (
        ("required_features", ["teleport"]),
        "feature teleport",
        UnsupportedFileError,
    ),
    "profile": (
        ("variables.0.model.profile", "magic"),
        "profile is magic",
        UnsupportedFileError,
    ),
    "another format": (("format", "zhash"), "format is not fhash", DamagedFileError),
}


@pytest.mark.parametrize("case", ROOTS)
def test_root(sample, samples, case) -> None:
    change, message, kind = ROOTS[case]
    data = edited(sample, samples, ROOT, lambda v: put_at(v["attributes"]["fhash"], *change))
    refused(sample, data, message, kind)


def test_newer_minor_is_read(sample, samples) -> None:
    def newer(document) -> None:
        root = document["attributes"]["fhash"]
        root["format_version"] = [3, 7]
        root["variables"][0]["novelty"] = {"a": 1}

    sample.write_bytes(edited(sample, samples, ROOT, newer))
    read_everything(sample)
    with Container.open(sample) as container:
        assert container.header["novelty"] == {"a": 1}
        assert container.header["format_version"] == [3, 7]


def test_a_file_of_format_1_is_named(sample, samples) -> None:
    """Its header has no variables."""

    def older(document) -> None:
        document["attributes"]["fhash"] = {"format": "fhash", "format_version": [2, 8]}

    message = "sample.fhz: the file is of format 2.x; this version reads format 3.x: encode the"
    refused(sample, edited(sample, samples, ROOT, older), message, UnsupportedFileError)


def test_a_brief_header_comes_back(samples) -> None:
    quality = {"psnr": 40.0, "psnr_domain": 40.0, "rmse": 1.0, "rmse_domain": None}
    whole = {
        **samples.header(),
        "features": ["all"],
        "mlp": None,
        "config": {"effort": 7},
        "training": {"seconds": None, "steps": 3, "epochs": 0, "device": "none"},
        "history": {},
        "quality": {**quality, "ssim_window": {"window": 7, "sigma": 1.5, "steps": [0]}},
    }
    before = copy.deepcopy(whole)
    short = brief(whole)
    assert whole == before
    assert short["config"] == {"effort": 7}
    assert short["training"] == {"steps": 3}
    assert not {"features", "history", "dilation"} & short.keys()
    assert short["quality"] == {
        "psnr": 40.0,
        "rmse": 1.0,
        "rmse_domain": None,
        "ssim_window": {"window": 7, "steps": [0]},
    }
    assert complete(short) == before
    assert complete(complete(short)) == before


def test_a_quality_that_nobody_measured_stays_empty() -> None:
    assert complete({"quality": {}})["quality"] == {}
    assert brief({"quality": {"ssim_window": {}}}) == {"quality": {"ssim_window": {}}}


def test_values_of_another_form_stay() -> None:
    odd = {"config": 5, "training": [1], "features": None, "history": {"epoch": []}, "quality": 3}
    whole = complete(odd)
    assert {key: whole[key] for key in odd} == odd
    complete({})["features"].append("isosurface:1")
    assert DEFAULTS["features"] == ["all"]


@pytest.mark.parametrize(
    "value", [{}, {"b": [1, 2.5, None, True, 'ü"\\\n[{'], "a": {"ä": -1e-300}}, {"n": 2**63}]
)
def test_reading_what_was_written(value) -> None:
    assert loads(dumps(value, "it")) == value


def test_keys_are_sorted_and_compact() -> None:
    assert dumps({"b": {"d": 1, "c": 2}, "a": "ü"}, "it") == '{"a":"ü","b":{"c":2,"d":1}}'.encode()


@pytest.mark.parametrize(
    "value",
    [
        {"a": float("nan")},
        {"a": float("inf")},
        {"a": b"x"},
        {"a": {1}},
        {"a": "\ud800"},
        {1: 0, "a": 0},
    ],
)
def test_what_json_cannot_hold_is_refused(value) -> None:
    with pytest.raises(InputError, match="the header cannot be stored as JSON"):
        dumps(value, "the header")


def nested(depth):
    return b'{"a":' * depth + b"1" + b"}" * depth


def test_depth() -> None:
    loads(nested(MAX_DEPTH))
    with pytest.raises(DamagedFileError, match="deep"):
        loads(nested(MAX_DEPTH + 1))
    loads(b'{"a": "' + b"[" * 1000 + b'\\"[[[["}')


@pytest.mark.parametrize(
    "text",
    [
        b'"' * 10**6,
        b'"\\' * 10**6,
        b'"' + b'\\"' * 10**6,
        b'{"a":"' + b"\\" * 10**6,
        b'{"' + b"a" * 10**6,
        b"[]" * 10**6,
    ],
)
def test_no_text_takes_more_than_linear_time(text: bytes) -> None:
    """A search of quadratic time would take some 10^12 steps here, and not end."""
    with pytest.raises(DamagedFileError):
        loads(text)


DOCUMENT = files("fhash_formats").joinpath("FORMAT.md").read_text(encoding="utf-8")


def example(name: str) -> dict[str, Any]:
    (text,) = re.findall(rf"^```json {name}\n(.*?)^```", DOCUMENT, re.MULTILINE | re.DOTALL)
    return json.loads(text)


def shown(path: Path) -> dict[str, Any]:
    """The attribute of the root of a file."""
    with zipfile.ZipFile(path) as file:
        return json.loads(file.read("zarr.json"))["attributes"]["fhash"]


def test_header_is_valid_and_can_be_written(tmp_path, samples) -> None:
    root = example("header")
    assert tuple(root["format_version"]) == FORMAT_VERSION
    (header,) = root["variables"]
    with ContainerWriter(tmp_path / "a.fhz") as writer:
        writer.add_whole("table_1", np.zeros(header["model"]["levels"][0], dtype=np.float32))
        writer.add_whole("auxiliary/area", np.ones((5, 6), dtype=np.float32))
        writer.commit({**header, "required_features": root["required_features"]})
    assert shown(tmp_path / "a.fhz") == root
    with Container.open(tmp_path / "a.fhz") as container:
        assert container.coordinate("x").name == "lon"
        coords = {axis: container.coordinate(name) for axis, name in AXIS_NAMES.items()}
        metadata = read_metadata(header, container.arrays, coords)
    assert list(metadata.dimensions) == ["time", "level", "y", "lon", "member"]
    assert [each.name for each in metadata.variables][:2] == ["time", "lon"]
    assert metadata.named("lon").values.dtype == np.float32
    assert metadata.variable_attributes["missing_value"] == np.float32(1e20)
    for key in (
        *header,
        *samples.header(),
        *header["model"],
        *samples.header()["model"],
        *header["coordinates"]["x"],
        *header["source"],
        *header["quality"],
        *(key for each in header["source"]["variables"] for key in each),
        *(GROUP_KEY, MLP, SHARES, TILES, VARIABLES, LOWEST),
    ):
        assert f"`{key}`" in DOCUMENT
    for name in (*samples.arrays(samples.header()), MISSING_ARRAY, STEPS):
        assert f"`{re.sub('_[0-9]$', '_1', name)}`" in DOCUMENT


def test_defaults_are_those_of_the_document() -> None:
    for key in DEFAULTS:
        assert f"| `{key}` |" in DOCUMENT


def test_no_key_of_the_example_can_be_left_out_but_defaults() -> None:
    (header,) = example("header")["variables"]
    for key in header:
        root = {**example("header"), "variables": [{k: v for k, v in header.items() if k != key}]}
        if key in (*DEFAULTS, "source"):
            read_headers(root)
        elif key != "variable":  # libfhash has looked at them before
            with pytest.raises(DamagedFileError, match=key):
                read_headers(root)
        assert f"| `{key}` |" in DOCUMENT


def test_every_file_that_is_named_exists() -> None:
    named = re.findall(r"`((?:container|transform|native)/[^`]+)`", DOCUMENT)
    assert named
    for path in named:
        assert files("fhash_formats").joinpath(path).is_file(), path


def test_every_data_type_is_named() -> None:
    assert all(name in DOCUMENT for name in DTYPES)
    assert f"version {FORMAT_VERSION[0]}.{FORMAT_VERSION[1]}" in DOCUMENT.splitlines()[0]
