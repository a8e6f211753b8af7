"""Progress of a stage with parts: trials are counted, and other threads never call."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from fhash_codec.progress import Parts, silent

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


def test_a_known_share_is_reported_in_percent_and_once_each(
    parts: Parts, calls: list[Call]
) -> None:
    for share in (-1.0, 0.001, 0.5, 0.502, 1.0, 2.0):
        parts.report("training", share)
    assert calls == [("training", percent, 100, "") for percent in (0, 50, 100)]


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


def test_a_wait_ends_when_a_work_fails(parts: Parts) -> None:
    release = threading.Event()

    def fail() -> None:
        raise ArithmeticError

    with ThreadPoolExecutor(2) as workers:
        works = [workers.submit(release.wait, 30), workers.submit(fail)]
        try:
            parts.wait(works, "training", lambda: 0.0, poll_seconds=0.01)
        finally:
            release.set()
        with pytest.raises(ArithmeticError):
            works[1].result()


def test_silence_reports_nothing() -> None:
    assert silent("coding", 1, 2, "") is None  # type: ignore[func-returns-value]
    Parts().tick()
