"""Runs of cases, in this process and in workers; their results and the report."""

from __future__ import annotations

import json
import multiprocessing
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib.metadata import version

import numpy as np
import pytest

from fhash_codec.selftest.case import Case, Check, Finding, Run, describe_machine, environment
from fhash_codec.selftest.field_cases import series
from fhash_codec.selftest.run import (
    CaseResult,
    Summary,
    cases,
    choose_cases,
    markdown,
    relative,
    run_case,
    run_cases,
)


@pytest.mark.parametrize(
    ("worst", "holds"),
    [(0.5, True), (1.0, True), (np.nextafter(1.0, 2.0), False), (np.inf, False), (np.nan, False)],
)
def test_a_finding_holds_up_to_its_limit(worst: float, holds: bool) -> None:
    assert Finding(name="a", worst=worst, limit=1.0, unit="").holds is holds


def test_a_run_decodes_its_file_once(run: Run) -> None:
    assert run.decoded.shape == run.values.shape
    assert run.decoded is run.decoded
    assert run.data_range == float(run.values.max()) - float(run.values.min())


def test_the_environment_is_put_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FHASH_THREADS", "3")
    monkeypatch.delenv("OMP_TEST", raising=False)
    seen = []

    def within() -> None:
        with environment(FHASH_THREADS="2", OMP_TEST="0"):
            seen.append((os.environ["FHASH_THREADS"], os.environ["OMP_TEST"]))
            raise ValueError("out")

    with pytest.raises(ValueError, match="out"):
        within()
    assert seen == [("2", "0")]
    assert os.environ["FHASH_THREADS"] == "3"
    assert "OMP_TEST" not in os.environ


def test_the_machine_is_described_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FHASH_THREADS", "3")
    facts = describe_machine().split(", ")
    assert facts[0] == f"fhash {version('fhash')}"
    assert f"numpy {version('numpy')}" in facts
    assert "3 processors" in facts
    assert facts[-1] in ("CUDA", "no CUDA")


def case_result(name: str, worst: float, errors: tuple[str, ...] = ()) -> CaseResult:
    planted = Finding(name="planted", worst=worst, limit=1.0, unit="a|b", under="bound")
    return CaseResult(
        name=name,
        group="values",
        about="nothing is hard",
        under=("bound",),
        findings=() if errors else (planted,),
        errors=errors,
    )


def test_the_report_names_every_case_and_what_does_not_hold() -> None:
    summary = Summary(results=[case_result("good", 0.5), case_result("bad", 2.0)])
    text = markdown(summary, options=" --case bad", where="It took 1 minute.")
    assert "Made by `fhash selftest --case bad --report`: 2 hard cases." in text
    assert "\n\nIt took 1 minute.\n" in text
    assert "**1 does not hold.**" in text
    assert "- bad: bound: planted is 2 a\\|b, at most 1" in text
    assert "| planted | 2 a\\|b | 1 | bad | bound |" in text
    assert "## Values\n" in text
    assert "| good | nothing is hard | bound | planted (bound) | 0.5 a\\|b | 1 |" in text
    assert "| bad | nothing is hard | bound | planted (bound) | 2 a\\|b | 1 |" in text


def test_a_case_that_did_not_finish_is_listed_with_its_error() -> None:
    summary = Summary(
        results=[case_result("bad", 0.0, ("bound: ended", "more")), case_result("worse", 3.0)]
    )
    text = markdown(summary)
    assert "**3 do not hold.**" in text
    assert "| bad | nothing is hard | bound | bound: ended | - | - |" in text


def test_the_same_figures_give_the_same_text() -> None:
    good = markdown(Summary(results=[case_result("good", 0.5)]))
    assert "**Everything holds.**" in good
    assert "## What does not hold" not in good
    assert markdown(Summary(results=[case_result("good", 0.5)])) == good


def finding(name: str, worst: float, limit: float = 1.0) -> Finding:
    return Finding(name=name, worst=worst, limit=limit, unit="values", under="bound")


def result(name: str, *findings: Finding, group: str = "values", **rest: object) -> CaseResult:
    return CaseResult(name=name, group=group, about="", findings=findings, **rest)


@pytest.mark.parametrize(
    ("worst", "limit", "multiple"),
    [
        (0.5, 2.0, 0.25),
        (3.0, 2.0, 1.5),
        (-1.0, 2.0, 0.0),
        (0.0, 0.0, 0.0),
        (1.0, 0.0, np.inf),
        (np.nan, 1.0, np.inf),
    ],
)
def test_a_figure_is_a_multiple_of_its_limit(worst: float, limit: float, multiple: float) -> None:
    assert relative(finding("a", worst, limit)) == multiple


def test_errors_and_figures_beyond_their_limits_are_failures() -> None:
    broken = result("x", finding("a", 0.5), finding("b", 2.0), errors=("bound: ended",))
    assert not broken.holds
    assert broken.failures == ["bound: ended", "bound: b is 2 values, at most 1"]
    assert broken.worst == finding("b", 2.0)
    assert not result("y", errors=("bound: ended",)).holds
    assert result("z").worst is None
    summary = Summary(results=[result("y", finding("a", 0.25)), broken])
    assert not summary.holds
    assert summary.failures == ["x: bound: ended", "x: bound: b is 2 values, at most 1"]


def test_the_summary_keeps_the_worst_figure_of_every_property() -> None:
    first = result("first", finding("a", 0.5), finding("b", 0.1))
    second = result("second", finding("a", 0.75), finding("b", 0.05), group="rays")
    summary = Summary(results=[first, second])
    assert summary.holds
    assert summary.groups == {"values": [first], "rays": [second]}
    assert summary.worst() == {
        "a": (second, finding("a", 0.75)),
        "b": (first, finding("b", 0.1)),
    }


@pytest.mark.parametrize("worst", [0.25, np.inf, -np.inf])
def test_results_survive_json(worst: float) -> None:
    given = result("x", finding("a", worst), under=("bound",), errors=("ended",))
    values = json.loads(json.dumps(given.to_dict(), allow_nan=False))
    assert CaseResult.from_dict(values) == given


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


# Cases whose encoding is refused take milliseconds.
CHEAP = ("nothing-selected", "nothing-finite", "beyond-float64-exactly")


def cheap(*names: str) -> list[Case]:
    return [case for name in names for case in choose_cases(names=[name])]


def test_cases_run_in_processes_in_their_order() -> None:
    seen: list[str] = []
    summary = run_cases(
        cheap(*CHEAP),
        processes=2,
        progress=lambda stage, done, total, note: seen.append(f"{stage} {done}/{total} {note}"),
    )
    assert [result.name for result in summary.results] == list(CHEAP)
    assert summary.failures == []
    assert seen == [f"testing {number}/3 {name}" for number, name in enumerate(CHEAP, 1)]


def test_a_process_that_dies_is_a_failure_of_its_case_only() -> None:
    unknown = replace(cheap("nothing-finite")[0], name="of-no-catalogue")
    summary = run_cases([unknown, *cheap("nothing-finite")], processes=1)
    assert [result.holds for result in summary.results] == [False, True]
    assert summary.failures == ["of-no-catalogue: the process ended with 1"]


def test_a_process_that_takes_too_long_is_a_failure_of_its_case() -> None:
    summary = run_cases(cheap("nothing-finite"), processes=1, max_seconds=0.0)
    assert summary.failures == ["nothing-finite: took longer than 0 s"]


def test_an_interruption_ends_the_processes() -> None:
    def stop(stage: str, done: int, total: int, note: str) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_cases(
            [*cheap("nothing-finite"), *choose_cases(groups=["times"])], processes=1, progress=stop
        )
    assert multiprocessing.active_children() == []
