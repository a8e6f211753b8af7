"""Verdicts on values, and values as text."""

from __future__ import annotations

from fhash_codec.bench.paper.answer import CONFIRMED, NOT_TESTABLE, REFUTED, spread, verdict


def test_without_values_nothing_is_tested() -> None:
    assert verdict([], lambda values: True) == NOT_TESTABLE
    assert verdict([1.0], lambda values: max(values) == 1) == CONFIRMED
    assert verdict([1.0], lambda values: max(values) > 1) == REFUTED


def test_a_spread_names_its_ends_where_they_differ() -> None:
    assert spread([], "x") == "-"
    assert spread([2.0], "x") == "2x"
    assert spread([3.0, 1.0, 12.345], " dB") == "3 dB (1 to 12.3)"
