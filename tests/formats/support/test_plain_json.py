"""Any value as JSON values: null for figures without one, text for attributes."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest

from fhash_formats.support.plain_json import (
    MAX_DEPTH,
    UnknownValueError,
    attribute_json,
    plain_json,
    plain_text,
)


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


def test_text_without_lone_surrogates() -> None:
    assert plain_text("a\udcffb\u00e9") == "a\u00ffb\u00e9"
