"""Counters: all names, sums in a fixed order, and text."""

from __future__ import annotations

import pytest

from fhash_codec.rendering.task.counters import COUNTERS, complete, rows


def test_left_out_counters_are_zero_and_given_ones_add_up() -> None:
    total = complete({"rays": 3, "samples": 5}, {"samples": 2})
    assert list(total) == list(COUNTERS)
    assert {name: count for name, count in total.items() if count} == {"rays": 3, "samples": 7}


def test_unknown_counters_are_refused() -> None:
    with pytest.raises(KeyError):
        complete({"photons": 1})


def test_rows_have_every_counter_with_separated_thousands() -> None:
    texts = rows({"rays": 12345})
    assert [name for name, _, _ in texts] == [name.replace("_", " ") for name in COUNTERS]
    assert texts[0][1] == "12,345"
    assert texts[1][1] == "0"
