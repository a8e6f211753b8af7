"""`fhash selftest`: its table, exit codes, JSON and report."""

from __future__ import annotations

import json
import platform
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import pytest
from click.testing import Result

from fhash_codec.selftest import run as workers
from fhash_codec.selftest.case import Case, Finding
from fhash_codec.selftest.run import CaseResult, Summary


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> dict[str, float]:
    """Replaces the run of cases: each has the figure {"worst": figure}.

    The arguments of the call are added under their names.
    """
    asked: dict[str, float] = {"worst": 0.5}

    def run(
        cases: list[Case], *, everything: bool, processes: int | None, progress: object
    ) -> Summary:
        asked.update(cases=len(cases), everything=everything, processes=processes or 0)
        finding = Finding(name="bound", worst=asked["worst"], limit=1.0, unit="of it", under="psnr")
        return Summary(
            results=[
                CaseResult(
                    name=case.name,
                    group=case.group,
                    about=case.about,
                    under=("psnr",),
                    findings=(finding,),
                )
                for case in cases
            ]
        )

    monkeypatch.setattr(workers, "run_cases", run)
    return asked


def test_one_case_runs_and_holds(fhash: Callable[..., Result]) -> None:
    result = fhash("selftest", "--case", "nothing-finite", "--processes", "1", "--quiet")
    assert result.exit_code == 0, result.output
    assert "values      1        3" in result.stdout
    assert result.stdout.endswith("everything holds\n")


def test_a_failure_is_listed_and_exits_with_1(
    fhash: Callable[..., Result], measured: dict[str, float]
) -> None:
    measured["worst"] = 1.25
    result = fhash("selftest", "--group", "times", "--quiet")
    assert result.exit_code == 1
    assert "uneven: psnr: bound is 1.25 of it, at most 1" in result.stdout
    assert result.stderr == ""


def test_json_holds_every_figure(fhash: Callable[..., Result], measured: dict[str, float]) -> None:
    result = fhash("selftest", "--case", "spike", "--case", "twos", "--json")
    printed = json.loads(result.stdout)
    assert result.exit_code == 0
    assert printed["holds"] is True
    assert [case["name"] for case in printed["cases"]] == ["twos", "spike"]
    assert printed["cases"][0]["findings"][0] == {
        "name": "bound",
        "worst": 0.5,
        "limit": 1.0,
        "unit": "of it",
        "under": "psnr",
        "holds": True,
    }


def test_all_runs_more(fhash: Callable[..., Result], measured: dict[str, float]) -> None:
    assert fhash("selftest", "--quiet").exit_code == 0
    few = measured["cases"]
    assert not measured["everything"]
    assert fhash("selftest", "--all", "--processes", "3", "--quiet").exit_code == 0
    assert measured["cases"] >= few
    assert measured["everything"]
    assert measured["processes"] == 3


def test_the_report_is_written_once(
    fhash: Callable[..., Result], measured: dict[str, float], tmp_path: Path
) -> None:
    path = tmp_path / "stability.md"
    assert fhash("selftest", "--case", "spike", "--report", path, "--quiet").exit_code == 0
    assert (
        f"minutes with fhash {version('fhash')}, Python {platform.python_version()},"
        in path.read_text()
    )
    assert (
        "| spike | one value of 1e6, all others 0 | psnr | bound (psnr) | 0.5 of it | 1 |"
        in path.read_text()
    )
    again = fhash("selftest", "--case", "spike", "--report", path)
    assert again.exit_code == 2
    assert "--force" in again.stderr
    assert (
        fhash("selftest", "--case", "spike", "--report", path, "--force", "--quiet").exit_code == 0
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--case", "spikey"), "unknown case 'spikey'; did you mean 'spike'?"),
        (("--group", "frontes"), "unknown group 'frontes'; did you mean 'fronts'?"),
        (("--report", "no/such/folder/a.md"), "no/such/folder"),
        (("--processes", "0"), "0 is not in the range"),
    ],
)
def test_what_cannot_be_is_refused(
    refused: Callable[..., str], words: tuple[str, ...], message: str
) -> None:
    assert message in refused(2, "selftest", *words)
