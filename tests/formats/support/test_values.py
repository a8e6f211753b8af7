"""Attributes as JSON values, and text that files can hold."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest

from fhash_formats.container import record as strict_json
from fhash_formats.errors import DamagedFileError
from fhash_formats.support.values import (
    DTYPES,
    MAX_DEPTH,
    PACKING,
    PLUMBING,
    UnknownValueError,
    attribute_json,
    attribute_value,
    inline_array,
    inline_values,
    is_number,
    is_wide_integer,
    json_attributes,
    plain_json,
    plain_text,
    stored_type,
    text_of,
    type_of_name,
    typed_attribute,
)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("m s-1", "m s-1"),
        (b"caf\xc3\xa9", "caf\u00e9"),
        (b"\xff", "\ufffd"),
        (None, None),
        (True, True),
        (np.bool_(True), True),
        (np.int16(-3), -3),
        (np.float64(0.5), 0.5),
        (np.float32(0.5), 0.5),
        (math.inf, "Infinity"),
        (np.float32(-np.inf), "-Infinity"),
        (math.nan, "NaN"),
        (np.arange(3), [0, 1, 2]),
        (np.array([[1.0, np.nan]]), [[1.0, "NaN"]]),
        (np.array([b"a", b"b"]), ["a", "b"]),
        (np.datetime64("2000-01-01"), "2000-01-01"),
        ((1, "a"), [1, "a"]),
        ({"a": np.int8(1), 2: [b"x"]}, {"a": 1, "2": ["x"]}),
    ],
)
def test_values_become_json(value: Any, expected: Any) -> None:
    converted = json_attributes({"name": value})
    assert converted == {"name": expected}
    assert json.loads(json.dumps(converted, allow_nan=False)) == converted


@pytest.mark.parametrize("value", [object(), np.zeros(1, "V4"), np.complex64(1), [object()]])
def test_what_json_cannot_hold_is_dropped(value: Any) -> None:
    assert json_attributes({"bad": value, "good": 1}) == {"good": 1}


def test_names_that_only_tie_datasets_together_are_dropped() -> None:
    attributes = {"DIMENSION_LIST": "x", "scale_factor": 2.0, "units": "K"}
    assert json_attributes(attributes) == {"scale_factor": 2.0, "units": "K"}
    assert json_attributes(attributes, without=PLUMBING | PACKING) == {"units": "K"}


def test_text_without_lone_surrogates() -> None:
    assert plain_text("a\udcffb\u00e9") == "a\u00ffb\u00e9"
    assert json_attributes({"a": "\ud800"}) == {"a": "?"}
    assert text_of(b"\xb0C") == "\u00b0C"
    assert (text_of(b"\xc3\xa9"), text_of("x"), text_of(5)) == ("\u00e9", "x", "5")


def test_only_integers_of_64_bits_are_wide() -> None:
    assert {name for name, dtype in DTYPES.items() if is_wide_integer(dtype)} == {
        "int64",
        "uint64",
    }
    assert is_wide_integer(np.dtype(">i8"))


@pytest.mark.parametrize("text", ["0", "-1.5", "1e-300", " 2 ", "inf", "nan", "1_000"])
def test_what_float_reads_is_a_number(text: str) -> None:
    assert is_number(text)


@pytest.mark.parametrize("text", ["", " ", "x", "1:2", "0x10", "1,5", "2001-02-10", "--1"])
def test_other_texts_are_none(text: str) -> None:
    assert not is_number(text)


@pytest.mark.parametrize(
    ("value", "figure", "attribute"),
    [
        (1.5, 1.5, 1.5),
        (np.float32(0.5), 0.5, 0.5),
        (np.longdouble(1.5), 1.5, 1.5),
        (np.array([1, np.nan], "g"), [1.0, None], [1.0, "NaN"]),
        (math.inf, None, "Infinity"),
        (-math.inf, None, "-Infinity"),
        (math.nan, None, "NaN"),
        (10**400, None, "1" + "0" * 400),
        (2**63, 2**63, 2**63),
        (np.uint64(2**64 - 1), 2**64 - 1, 2**64 - 1),
        (np.bool_(True), True, True),
        (True, True, True),
        (None, None, None),
        ("a\udc80", "a?", "a?"),
        ({"a\udc80": (1, np.int8(2))}, {"a?": [1, 2]}, {"a?": [1, 2]}),
        ({1: math.nan}, {"1": None}, {"1": "NaN"}),
        (np.ma.masked, None, None),
    ],
)
def test_each_rule(value: Any, figure: Any, attribute: Any) -> None:
    for converted, expected in ((plain_json(value), figure), (attribute_json(value), attribute)):
        assert converted == expected
        assert json.loads(json.dumps(converted, allow_nan=False)) == converted


@pytest.mark.skipif(
    np.finfo(np.longdouble).max <= np.finfo(np.float64).max, reason="long doubles are doubles here"
)
def test_long_doubles_beyond_float64() -> None:
    value = np.longdouble("1e400")
    assert plain_json(value) is None
    assert attribute_json(value) == "1e+400"


def nested(depth: int) -> Any:
    value: Any = 1
    for _ in range(depth):
        value = [value]
    return value


@pytest.mark.parametrize("value", [object(), 1j, np.complex64(1), {1}, nested(MAX_DEPTH + 1)])
def test_values_of_other_kinds(value: Any) -> None:
    assert json.dumps(plain_json(value), allow_nan=False)
    with pytest.raises(UnknownValueError):
        attribute_json(value)
    assert attribute_json(nested(MAX_DEPTH)) == nested(MAX_DEPTH)


def test_digits_that_python_refuses_to_write() -> None:
    assert plain_json(10**5000) is None
    with pytest.raises(UnknownValueError):
        attribute_json(10**5000)


def test_text_without_lone_surrogates_plain_json() -> None:
    assert plain_text("a\udcffb\u00e9") == "a\u00ffb\u00e9"


ARRAYS = [
    np.array([0.1, -0.0, 1e-45, np.nan, np.inf, -np.inf], "f4"),
    np.array([[0.1, 5e-324], [1.7e308, -2.5]]),
    np.array([2**63 - 1, -(2**63)]),
    np.array([2**64 - 1, 0], "u8"),
    np.array([65504, 6e-8], "f2"),
    np.array(-7, "i1"),
    np.array([b"a", b"\xff\x00\xe9"], "S3"),
    np.array([["ü", ""]], dtype=object),
    np.array(["one", "other"]),
    np.array([1.5, 2.5], ">f8"),
]


def through(values: Any) -> Any:
    """JSON values after a document."""
    return strict_json.loads(strict_json.dumps({"v": values}, "test"))["v"]


@pytest.mark.parametrize("values", ARRAYS, ids=lambda values: str(values.dtype))
def test_arrays_come_back_in_every_bit(values: np.ndarray) -> None:
    name = stored_type(values)
    back = inline_array(through(inline_values(values, name)), name, values.shape)
    assert back.shape == values.shape
    if name == "text":
        assert back.tolist() == values.tolist()
    else:
        assert back.tobytes() == values.astype(type_of_name(name)).tobytes()


def test_other_bits_of_nan_are_not_written_as_text() -> None:
    values = np.array([0x7FC00001], "u4").view("f4")
    assert inline_values(values, "float32") is None


@pytest.mark.parametrize(
    "value",
    [
        "text",
        "",
        True,
        7,
        -2.5,
        np.float32(0.1),
        np.int16(-3),
        np.float64("nan"),
        np.array([1, 2]),
        np.array([1.0, 2.0]),
        np.array([1.0, np.nan]),
        np.array([1, 2], "u1"),
        np.array([]),
        ["a", "b"],
        {"nested": [1, None]},
        [1, "mixed"],
        None,
    ],
    ids=repr,
)
def test_attributes_keep_their_type(value: Any) -> None:
    back = attribute_value(through(typed_attribute(value)))
    if isinstance(value, np.ndarray | np.generic):
        assert np.asarray(back).dtype == np.asarray(value).dtype
        assert np.asarray(back).shape == np.asarray(value).shape
    np.testing.assert_equal(back, value)


@pytest.mark.parametrize("value", [1j, np.zeros((2, 2)), "\ud800", np.array([object()])])
def test_values_without_a_form_are_refused(value: Any) -> None:
    with pytest.raises(UnknownValueError):
        typed_attribute(value)


@pytest.mark.parametrize(
    ("listed", "name"),
    [
        ([300], "uint8"),
        ([-1], "uint64"),
        ([1.5], "int32"),
        ([True], "int32"),
        ([1e39], "float32"),
        (["nan"], "float64"),
        ([True], "float64"),
        ([10**400], "float64"),
        (["ab"], "bytes1"),
        (["\u0100"], "bytes1"),
        ([1], "text"),
        ([1, 2], "int32"),
        ("1", "int32"),
        ([1], "complex64"),
        (["a"], "bytes99999"),
        ([1], ["int32"]),
    ],
)
def test_hostile_lists_are_damage(listed: Any, name: Any) -> None:
    with pytest.raises(DamagedFileError):
        inline_array(listed, name, (1,))


@pytest.mark.parametrize("value", [None, [], {}, [1, "a"], {"a": 1, "b": 2}, {"int8": 300}, [[1]]])
def test_hostile_attributes_are_damage(value: Any) -> None:
    json.dumps(value)
    with pytest.raises(DamagedFileError):
        attribute_value(value)


@pytest.mark.parametrize("name", ["int8", "uint64", "int64", "float16", "float32", "float64"])
def test_long_lists_of_numbers_are_taken_as_single_ones_are(name: str) -> None:
    numbers = [0, 1, 127, -1, 2**63, 2**64, 0.1, -0.0, 1e300, 10**300, 10**400, True, "NaN", None]
    for number in numbers:
        try:
            single = attribute_value({name: number})
        except DamagedFileError:
            with pytest.raises(DamagedFileError):
                inline_array([1, number, 1], name, (3,))
        else:
            found = inline_array([1, number, 1], name, (3,))
            assert found[1:2].tobytes() == np.asarray(single).tobytes()
            assert found.dtype == single.dtype


def test_values_of_more_bytes_than_are_allowed_are_refused() -> None:
    assert inline_array(["", "a"], "bytes4", (2,), 8).tolist() == [b"", b"a"]
    with pytest.raises(DamagedFileError, match="too many bytes"):
        inline_array(["", "a"], "bytes4", (2,), 7)
