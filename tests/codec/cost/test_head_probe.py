"""Rates of the training of heads: how many updates a training takes."""

from __future__ import annotations

from fhash_codec.cost.head_probe import updates_of


def test_a_training_of_twice_the_updates_takes_twice_as_long() -> None:
    once, twice = (updates_of(updates, 0) for updates in (800, 1600))
    assert 800 < once < 1600
    assert 1.9 < twice / once < 2.1
    assert updates_of(800, 400_000) > once
