"""The time of `fhash cost`: parts, what does not fit, and the end of work that overruns."""

from __future__ import annotations

import pytest

from fhash_codec.cost.allowance import OVERRUN, Allowance, BudgetSpentError
from fhash_codec.progress import silent


class Clock:
    """A clock that stands until it is moved."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_a_part_ends_at_its_share_and_what_does_not_fit_is_told() -> None:
    clock = Clock()
    allowance = Allowance(100.0, clock)
    allowance.part(0.5)
    clock.now = 20.0
    assert allowance.left == 30.0
    assert allowance.has("short", 30.0)
    assert not allowance.has("long", 31.0)
    assert not allowance.has("half", 16.0, share=0.5)
    clock.now = 70.0
    assert allowance.left == 0.0
    entry, _ = allowance.left_out
    assert (entry.what, entry.late) == ("long", True)
    assert "31 s" in entry.why
    assert "30 s" in entry.why


def test_work_that_overruns_is_ended_and_told() -> None:
    clock = Clock()
    allowance = Allowance(100.0, clock)
    allowance.part(0.5)
    clock.now = 10.0
    guarded = allowance.guard(silent, share=0.5)
    clock.now = 10.0 + 20 * (1 + OVERRUN)
    guarded("stage", 1, 2, "")
    clock.now += 0.1
    with allowance.work("an encoding"):
        guarded("stage", 2, 2, "")
        pytest.fail("it went on")
    assert [entry.what for entry in allowance.left_out] == ["an encoding"]
    with pytest.raises(BudgetSpentError):
        guarded("stage", 2, 2, "")


def test_ctrl_c_ends_the_work_and_everything_after_it() -> None:
    allowance = Allowance(100.0)
    with allowance.work("a picture"):
        raise KeyboardInterrupt
    assert allowance.interrupted
    assert not allowance.has("another", 0.0)
    assert {entry.why for entry in allowance.left_out} == {"interrupted"}
