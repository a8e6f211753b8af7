"""Hard cases keep what must hold; whatever goes wrong in a run is a line of its result.

A third of the quick cases runs here, from every group. FHASH_HARD=1 runs all of them, as does
`fhash selftest`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from fhash_codec.selftest.case import Case, Check, Finding, Run
from fhash_codec.selftest.cases.catalogue import cases
from fhash_codec.selftest.cases.fields import series
from fhash_codec.selftest.runner import run_case

EVERY = 1 if os.environ.get("FHASH_HARD") == "1" else 3
"""Every so many of a group's quick cases run."""


def some_cases() -> list[Case]:
    """Every n-th quick case of each group, evenly spread."""
    quick = [case for case in cases() if case.quick]
    groups = dict.fromkeys(case.group for case in quick)
    return [
        case
        for group in groups
        for case in [case for case in quick if case.group == group][EVERY // 2 :: EVERY]
    ]


@pytest.mark.parametrize("case", some_cases(), ids=lambda case: case.name)
def test_what_must_hold_holds(case: Case) -> None:
    result = run_case(case)
    assert result.failures == []
    assert result.findings


def test_every_group_is_among_the_cases_that_run() -> None:
    assert {case.group for case in some_cases()} == {case.group for case in cases()}


def _raises(run: Run) -> Iterator[Finding]:
    yield Finding(name="begun", worst=0.0, limit=1.0, unit="")
    raise ValueError("and it ends")


def test_a_property_that_does_not_hold_and_a_check_that_raises_are_failures(
    easy: Case, figure: Callable[[float], Check]
) -> None:
    result = run_case(replace(easy, checks=(figure(2.0), _raises)), checks=())
    assert not result.holds
    assert result.failures == [
        "bound: _raises: ValueError: and it ends",
        "bound: planted is 2 a|b, at most 1",
    ]
    assert result.worst is not None
    assert result.worst.under == "bound"


def test_a_figure_that_is_not_a_number_does_not_hold(
    easy: Case, figure: Callable[[float], Check]
) -> None:
    assert not run_case(replace(easy, checks=(figure(float("nan")),)), checks=()).holds


def test_the_long_set_adds_settings_and_is_thorough(easy: Case) -> None:
    seen = []

    def note(run: Run) -> list[Finding]:
        seen.append((run.under, run.thorough))
        return []

    case = replace(easy, more={"other": easy.settings["bound"]}, checks=(note,))
    assert run_case(case, checks=()).under == ("bound",)
    assert run_case(case, checks=(), everything=True).under == ("bound", "other")
    assert seen == [("bound", False), ("bound", True), ("other", True)]


def nothing_finite() -> object:
    return series(np.full((2, 2, 2, 2), np.nan))


@pytest.mark.parametrize(
    ("change", "failure"),
    [
        ({"make": lambda: 1 / 0}, "making the series: ZeroDivisionError: division by zero"),
        ({"make": nothing_finite}, "bound: InputError: array: 'hard' has no finite value"),
        (
            {"refused": "no finite value"},
            "bound: was encoded; it should have been refused with 'no finite value'",
        ),
        ({"make": nothing_finite, "refused": "nowhere"}, "which does not say 'nowhere'"),
    ],
)
def test_whatever_goes_wrong_is_a_line_of_the_result(
    easy: Case, change: dict[str, object], failure: str
) -> None:
    result = run_case(replace(easy, **change), checks=())
    assert not result.holds
    assert len(result.failures) == 1
    assert failure in result.failures[0]


def test_a_numeric_warning_is_a_failure(easy: Case) -> None:
    case = replace(easy, checks=(lambda run: [np.float64(1e308) * 10],))
    assert run_case(case, checks=()).errors == (
        "bound: <lambda>: RuntimeWarning: overflow encountered in scalar multiply",
    )
