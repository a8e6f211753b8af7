"""Runs of a sample that are known: what they stand for, and how many are kept."""

from __future__ import annotations

from dataclasses import replace

import pytest
from untrained_heads import some_head

from fhash_codec.compact.choices.transform import usual_transform
from fhash_codec.compact.tiles import known as module
from fhash_codec.compact.tiles.coding import Coding, Outcome
from fhash_codec.compact.tiles.known import Known, Run, TileRun
from fhash_formats.transform.tile.settings import TileSettings

SETTINGS = TileSettings(
    transform=usual_transform((2, 4, 8, 8)), step=1.0, center=0.0, low=0.0, high=16.0
)
OUTCOME = Outcome(size=3, squares=1.0, count=10, max_error=0.5)


def run(settings: TileSettings, coding: Coding, stream: bytes = b"abc") -> Run:
    return Run(settings, coding, [TileRun(stream, OUTCOME)])


def test_equal_settings_are_known_and_others_are_not() -> None:
    runs = Known()
    first = run(SETTINGS, Coding())
    runs.keep(first)
    assert runs.run(replace(SETTINGS), Coding()) is first
    assert runs.run(replace(SETTINGS, step=1.5), Coding()) is None
    assert runs.run(SETTINGS, Coding(passes=2)) is None


def test_a_head_changes_no_stream_but_under_a_bound() -> None:
    headed = replace(SETTINGS, head=some_head())
    for coding, same in ((Coding(), True), (Coding(error=0.5), False)):
        runs = Known()
        first = run(SETTINGS, coding)
        runs.keep(first)
        assert runs.run(headed, coding) is None
        assert (runs.same_streams(headed, coding) is first) == same
        assert runs.same_streams(SETTINGS, coding) is first


def test_the_oldest_runs_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_BYTES", 10)
    runs, steps = Known(), (1.0, 2.0, 3.0, 4.0)
    for step in steps:
        runs.keep(run(replace(SETTINGS, step=step), Coding(), b"abcd"))
    found = [runs.run(replace(SETTINGS, step=step), Coding()) is not None for step in steps]
    assert found == [False, False, True, True]
