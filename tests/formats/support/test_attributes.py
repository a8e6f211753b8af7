"""Attributes as JSON values, and text that files can hold."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest

from fhash_formats.support.attributes import PACKING, PLUMBING, json_attributes, plain_text, text_of


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
