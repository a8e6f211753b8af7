"""Attributes and arrays come back from JSON in their type and in every bit."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from fhash_formats.container import strict_json
from fhash_formats.errors import DamagedFileError
from fhash_formats.support.plain_json import UnknownValueError
from fhash_formats.support.typed_values import (
    attribute_value,
    inline_array,
    inline_values,
    stored_type,
    type_of_name,
    typed_attribute,
)

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
