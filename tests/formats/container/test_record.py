"""Checked access to a JSON object: a message names the key and what is needed."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from fhash_formats.container.record import Record
from fhash_formats.errors import DamagedFileError

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
