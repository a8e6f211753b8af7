"""Verdicts on values, and values as text."""

from __future__ import annotations

from fhash_codec.bench.paper.answer import (
    CONFIRMED,
    NOT_REACHED,
    NOT_TESTABLE,
    REFUTED,
    spread,
    verdict,
)


def test_the_median_decides() -> None:
    assert verdict([], 10, 1) == NOT_TESTABLE
    assert verdict([1.0, 10.0, 12.0], 10, 1) == CONFIRMED
    assert verdict([1.0, 9.9, 12.0], 10, 1) == NOT_REACHED
    assert verdict([0.9], 10, 1) == REFUTED


def test_a_spread_names_its_ends_where_they_differ() -> None:
    assert spread([], "x") == "-"
    assert spread([2.0], "x") == "2x"
    assert spread([3.0, 1.0, 12.345], " dB") == "3 dB (1 to 12.3)"
