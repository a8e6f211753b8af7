"""JSON: what is read is what was written, hostile text is refused, and no text takes long."""

from __future__ import annotations

import pytest

from fhash_formats.container.record import MAX_DEPTH, dumps, loads
from fhash_formats.errors import DamagedFileError, InputError


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
