"""The report names every case and what does not hold, and is the same for the same figures."""

from __future__ import annotations

from fhash_codec.selftest.case import Finding
from fhash_codec.selftest.report import markdown
from fhash_codec.selftest.results import CaseResult, Summary


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
