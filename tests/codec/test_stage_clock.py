"""The record of stages: nothing is counted twice, and what was left out says so."""

from __future__ import annotations

import pytest

from fhash_codec import stage_clock
from fhash_codec.stage_clock import OTHER, attribute, recording, skip, stage


class _Hands:
    """A clock that moves when it is told."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def perf_counter(self) -> float:
        return self.seconds


@pytest.fixture
def hands(monkeypatch: pytest.MonkeyPatch) -> _Hands:
    """The clock that stages read."""
    hands = _Hands()
    monkeypatch.setattr(stage_clock, "time", hands)
    return hands


def test_a_stage_inside_another_takes_its_seconds_from_that_one(hands: _Hands) -> None:
    with recording() as clock:
        hands.seconds += 1
        with stage("outer", "first"):
            hands.seconds += 2
            with stage("inner", "twice"):
                hands.seconds += 4
            with stage("inner", "again"):
                hands.seconds += 8
        hands.seconds += 16
    stages = {entry.stage: entry for entry in clock.stages()}
    assert {name: entry.seconds for name, entry in stages.items()} == {
        "outer": 2,
        "inner": 12,
        OTHER: 17,
    }
    assert (stages["inner"].times, stages["inner"].why) == (2, "twice")


def test_an_error_ends_a_stage_as_well() -> None:
    with recording() as clock:
        with pytest.raises(ValueError, match="no"), stage("broken", "tried"):
            raise ValueError("no")
        with stage("next", "on it goes"):
            pass
    assert [entry.stage for entry in clock.stages()] == ["broken", "next", OTHER]


def test_what_is_left_out_was_never_entered_and_says_why() -> None:
    with recording() as clock:
        skip("head", "--without head")
        skip("tiles", "at first")
        with stage("tiles", "after all"):
            skip("tiles", "once more")
    head, tiles, _ = clock.to_list()
    assert head == {"stage": "head", "seconds": 0.0, "times": 0, "why": "--without head"}
    assert (tiles["times"], tiles["why"]) == (1, "after all")


def test_seconds_between_those_of_a_stage_are_given_to_another(hands: _Hands) -> None:
    with recording() as clock, stage("measuring", "errors"):
        hands.seconds += 5
        attribute("ssim", "likeness", 3.0)
    assert [entry.seconds for entry in clock.stages()] == [2, 3, 0]


def test_without_a_clock_nothing_is_recorded() -> None:
    with stage("alone", "nobody counts"):
        attribute("part", "nor this", 1.0)
    skip("left out", "nor that")
    with recording() as outer:
        with recording() as inner, stage("inside", "its own record"):
            pass
        assert [entry.stage for entry in inner.stages()] == ["inside", OTHER]
    assert [entry.stage for entry in outer.stages()] == [OTHER]
