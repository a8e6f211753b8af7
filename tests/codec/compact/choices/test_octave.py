"""The exchange of quality for bytes, from outcomes of trials."""

from __future__ import annotations

import pytest

from fhash_codec.compact.choices.octave import octave_gain
from fhash_codec.compact.choices.search import EXCHANGE
from fhash_codec.compact.tiles.coding import Outcome


def outcome(size: int, psnr: float) -> Outcome:
    return Outcome(size=size, squares=10 ** (-psnr / 10) * 100, count=100, max_error=1.0)


def test_the_last_two_outcomes_tell_what_an_octave_buys() -> None:
    tried = [outcome(100, 30.0), outcome(1000, 40.0), outcome(2000, 46.0)]
    assert octave_gain(tried, 1.0) == pytest.approx(6.0)


def test_one_outcome_and_empty_ones_tell_nothing() -> None:
    assert octave_gain([outcome(1000, 40.0)], 1.0) == EXCHANGE
    assert octave_gain([outcome(0, 40.0), outcome(1000, 46.0)], 1.0) == EXCHANGE
