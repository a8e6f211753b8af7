"""Names of arrays in the configuration of a codec."""

from __future__ import annotations

from typing import Any

import pytest

from fhash_formats.transform.apart import apart_message, without_names


@pytest.mark.parametrize(
    ("configuration", "rest", "names"),
    [
        ({}, {}, ()),
        ({"head": "AAAA", "mask": {"reach": 1}}, {"head": "AAAA", "mask": {"reach": 1}}, ()),
        ({"head": {"array": "a"}, "step": 1}, {"step": 1}, ("a",)),
        ({"mask": {"array": "b", "reach": 1}}, {"mask": {"reach": 1}}, ("b",)),
        ({"head": {"array": 5}}, {"head": {"array": 5}}, ()),
    ],
)
def test_names_are_taken_out(
    configuration: dict[str, Any], rest: dict[str, Any], names: tuple[str, ...]
) -> None:
    assert without_names(configuration) == (rest, names)


def test_the_message_names_the_arrays_and_the_ways_to_read_them() -> None:
    message = apart_message(["a", "b"])
    assert "a and b" in message
    assert "fhash_codec.open" in message
