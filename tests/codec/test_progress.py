"""Progress of a stage with parts: trials are counted, and other threads never call."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from fhash_codec import progress as stage_clock
from fhash_codec.progress import OTHER, Parts, attribute, recording, skip, stage

Call = tuple[str, int, int, str]


@pytest.fixture
def calls() -> list[Call]:
    return []


@pytest.fixture
def parts(calls: list[Call]) -> Parts:
    return Parts("planning", 3, lambda *call: calls.append(call))


def test_parts_are_counted_when_the_next_one_begins(parts: Parts, calls: list[Call]) -> None:
    parts.begin("tiles")
    parts.tick()
    parts.tick()
    parts.begin("step")
    parts.end()
    assert calls == [
        ("planning", 0, 3, "tiles"),
        ("planning", 0, 3, "tiles, 1 tiles tried"),
        ("planning", 0, 3, "tiles, 2 tiles tried"),
        ("planning", 1, 3, "step"),
        ("planning", 3, 3, ""),
    ]


def test_other_threads_count_and_do_not_call(parts: Parts, calls: list[Call]) -> None:
    parts.begin("head")
    go_on, shares = threading.Event(), [0.0]

    def work() -> str:
        assert go_on.wait(30)
        parts.tick()
        parts.report("training", 0.9)
        return "done"

    def share() -> float:
        go_on.set()
        shares.append(min(1.0, shares[-1] + 0.5))
        return shares[-1]

    with ThreadPoolExecutor(1) as workers:
        works = [workers.submit(work)]
        parts.wait(works, "training", share, poll_seconds=0.01)
        assert works[0].result() == "done"
    assert calls[:2] == [("planning", 0, 3, "head"), ("training", 50, 100, "")]
    assert ("training", 90, 100, "") not in calls
    parts.tick()
    assert calls[-1] == ("planning", 0, 3, "head, 2 tiles tried")


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
