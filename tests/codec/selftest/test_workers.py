"""Worker processes return results in order; one that dies, hangs or is interrupted ends."""

from __future__ import annotations

import multiprocessing
from dataclasses import replace

import pytest

from fhash_codec.selftest.case import Case
from fhash_codec.selftest.cases.catalogue import choose_cases
from fhash_codec.selftest.workers import run_cases

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
