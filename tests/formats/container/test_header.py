"""The header: every key has a type and a range, and a message names the key."""

from __future__ import annotations

import copy
from collections.abc import Callable

import pytest
from hostile_files import ROOT, edited, edited_header, read_everything, refused

from fhash_formats.container import Container, validate_header
from fhash_formats.container.header import CONFIG_DEFAULTS, DEFAULTS, brief, complete
from fhash_formats.container.record import Record
from fhash_formats.errors import DamagedFileError, UnsupportedFileError

FIXED = {"format": "fhash", "format_version": [2, 0], "required_features": []}
VERSION = {"format": "fhash", "format_version": [2, 0]}


BAD = [
    ("format", "FHASH"),
    ("format_version", [1]),
    ("format_version", [1, 0.5]),
    ("format_version", "1.0"),
    ("required_features", {}),
    ("required_features", [1]),
    ("required_features", ["transform", "transform"]),
    ("encoder", ...),
    ("encoder", []),
    ("encoder.version", 1),
    ("encoder.seed", 1.5),
    ("encoder.seed", True),
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
    ("history", {}),
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
        ("encoder.seed", 2**63 - 1),
        ("features", []),
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
        ("format_version", [2, 3]),
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
        ("model.head", ...),
        ("model.head", 1),
        ("model.tiling", [1.1]),
        ("model.tiling", {"price": "1.1"}),
        ("model.tiling", {"best": [4, 3, 4]}),
        ("model.tiling", {"tried": 1.5}),
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
        ("model.head", {"width": 8}),
        ("model.tables", "uint16"),
        ("model.tiling", {}),
        ("model.tiling", {"price": 1, "best": [4, 3, 4, 6]}),
        ("coordinates", ...),
        ("history", {}),
        ("history", {"epoch": [1, 2], "psnr": [40.5, None]}),
    ],
)
def test_allowed_in_the_profile_compact(samples, path, value) -> None:
    validate_header(edited_header(samples.compact_header() | VERSION, path, value))


ROOTS = {
    "newer major": (
        lambda v: v.update(format_version=[3, 1]),
        "the file is of format 3.1; this fhash reads format 2.x: upgrade",
        UnsupportedFileError,
    ),
    "older major": (
        lambda v: v.update(format_version=[1, 8]),
        "the file is of format 1.8; this fhash reads format 2.x: encode the source again",
        UnsupportedFileError,
    ),
    "feature": (
        lambda v: v.update(required_features=["teleport"]),
        "feature 'teleport'",
        UnsupportedFileError,
    ),
    "profile": (
        lambda v: v["variables"][0]["model"].update(profile="magic"),
        "profile is 'magic'",
        UnsupportedFileError,
    ),
    "another format": (lambda v: v.update(format="zhash"), "format is 'zhash'", DamagedFileError),
}


@pytest.mark.parametrize("case", ROOTS)
def test_root(sample, samples, case) -> None:
    change, message, kind = ROOTS[case]
    refused(
        sample,
        edited(sample, samples, ROOT, lambda v: change(v["attributes"]["fhash"])),
        message,
        kind,
    )


def test_newer_minor_is_read(sample, samples) -> None:
    def newer(document) -> None:
        root = document["attributes"]["fhash"]
        root["format_version"] = [2, 7]
        root["variables"][0]["novelty"] = {"a": 1}

    sample.write_bytes(edited(sample, samples, ROOT, newer))
    read_everything(sample)
    with Container.open(sample) as container:
        assert container.header["novelty"] == {"a": 1}
        assert container.header["format_version"] == [2, 7]


def test_a_file_of_format_1_is_named(sample, samples) -> None:
    """Its header has no variables."""

    def older(document) -> None:
        document["attributes"]["fhash"] = {"format": "fhash", "format_version": [1, 8]}

    message = "sample.fhz: the file is of format 1.8; this fhash reads format 2.x: encode the"
    refused(sample, edited(sample, samples, ROOT, older), message, UnsupportedFileError)


def test_a_brief_header_comes_back(samples) -> None:
    quality = {"psnr": 40.0, "psnr_domain": 40.0, "rmse": 1.0, "rmse_domain": None}
    whole = {
        **samples.header(),
        "features": ["all"],
        "config": {**CONFIG_DEFAULTS, "effort": 7},
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
    assert complete({})["config"] == CONFIG_DEFAULTS
    complete({})["config"]["without"].append("ssim")
    assert CONFIG_DEFAULTS["without"] == DEFAULTS["config"]["without"] == []


VALUES = {
    "object": {"inner": 1.5},
    "objects": [{"n": 1}, {"n": "x"}],
    "text": "abc",
    "texts": ["a", "b"],
    "integer": 7,
    "integers": [1, 2],
    "number": -0.5,
    "numbers": [1, 2.5],
    "null": None,
    "huge": 10**400,
}


def test_values_come_back() -> None:
    record = Record(VALUES, "key ")
    assert record.record("object").number("inner") == 1.5
    assert [entry.get("n") for entry in record.records("objects")] == [1, "x"]
    assert (record.text("text"), record.texts("texts")) == ("abc", ["a", "b"])
    assert (record.integer("integer", 7, 7), record.integers("integers", 2, 1, 2)) == (7, [1, 2])
    assert (record.number("number"), record.numbers("numbers", 2)) == (-0.5, [1.0, 2.5])
    assert record.number_or_null("null") is record.number_or_null("none") is None
    assert record.choice("text", ("abc", "d")) == "abc"
    assert record.has("null")
    assert not record.has("none")


@pytest.mark.parametrize(
    ("take", "message"),
    [
        (lambda r: r.get("none"), "key none is missing"),
        (lambda r: r.record("text"), "key text is 'abc'; needed: an object"),
        (lambda r: r.record("object").text("inner"), "key object.inner is 1.5; needed: a string"),
        (lambda r: r.records("objects")[1].number("n"), "key objects.1.n is 'x'; needed: a finite"),
        (lambda r: r.integer("integer", 8, 9), "key integer is 7; needed: a whole number from 8"),
        (lambda r: r.integer("number", -1, 1), "key number is -0.5; needed: a whole number"),
        (lambda r: r.integers("integers", 3, 1, 2), "needed: 3 whole numbers from 1 to 2"),
        (lambda r: r.number("huge"), "key huge is 1000.*; needed: a finite number"),
        (lambda r: r.numbers("numbers", 1), "key numbers is .*; needed: 1 finite numbers"),
        (lambda r: r.choice("text", ("d", "e")), "needed: d or e"),
        (lambda r: r.texts("numbers"), "needed: a list of strings"),
    ],
)
def test_another_value_is_named(take: Callable[[Record], object], message: str) -> None:
    with pytest.raises(DamagedFileError, match=message):
        take(Record(VALUES, "key "))
