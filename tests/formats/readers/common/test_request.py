"""Requests: number types, shapes, axes and raw layouts, as text and as records."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fhash_formats import RawLayout, parse_shape
from fhash_formats.errors import InputError
from fhash_formats.readers.common.request import DTYPES, Request, parse_axes, parse_dtype


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"shape": {"x": 1, "y": 2}}, "name three or four of t, z, y, x"),
        ({"shape": {"x": 1, "y": 2, "w": 3}}, "names x, y, w"),
        ({"shape": {}}, "names no axis"),
        ({"shape": {"x": 1, "y": 2, "z": 0}}, "z=0; a length is at least 1"),
        ({"dtype": "c8"}, "'c8' is not a number type"),
        ({"endian": "middle"}, "byte order 'middle'; allowed: little, big"),
    ],
)
def test_impossible_layouts_are_refused(values: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        RawLayout(**values)


def test_parse_shape() -> None:
    assert parse_shape("x=64,y=64, z=32,t=10") == {"x": 64, "y": 64, "z": 32, "t": 10}
    assert list(parse_shape("t=1,x=2,y=3")) == ["t", "x", "y"]


@pytest.mark.parametrize(
    "text", ["", "64,64,32", "x=64,x=3", "w=1", "x=-1", "x=1.5", "x=\u00b2", "x", "x=1,,y=2"]
)
def test_parse_shape_refuses(text: str) -> None:
    with pytest.raises(InputError, match=r"write each axis once, such as x=64,y=64,z=32,t=10"):
        parse_shape(text)


@pytest.mark.parametrize("axes", ["", "t,z,y,w", "t,z,y,y", "tzyx", "time,z,y,x"])
def test_axes_that_mean_nothing(axes: str) -> None:
    with pytest.raises(InputError, match="name the file's dimensions in their order"):
        parse_axes(axes)


def test_axes_in_any_case() -> None:
    assert parse_axes("T,Z,y, X") == ("t", "z", "y", "x")


@pytest.mark.parametrize(("name", "short"), DTYPES.items())
def test_a_number_type_has_a_long_and_a_short_name(name: str, short: str) -> None:
    assert parse_dtype(name) == parse_dtype(short.upper()) == np.dtype(short)
    assert parse_dtype(name).name == name


def test_a_variable_is_refused_where_there_is_none() -> None:
    Request().refuse_var("a.npy")
    with pytest.raises(InputError, match="--var v cannot be used"):
        Request(var="v").refuse_var("a.npy")
