"""Hard cases keep what must hold, and the suite of them can fail."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from fhash_codec.config import EncodeConfig
from fhash_codec.selftest.case import Case, Finding, Run
from fhash_codec.selftest.cases.catalogue import cases, chosen
from fhash_codec.selftest.cases.fields import series, waves
from fhash_codec.selftest.checks import accuracy
from fhash_codec.selftest.checks.access import regions
from fhash_codec.selftest.environment import environment
from fhash_codec.selftest.report import markdown
from fhash_codec.selftest.results import CaseResult, Summary, relative
from fhash_codec.selftest.runner import run_case
from fhash_codec.selftest.workers import run_cases
from fhash_formats.errors import InputError

QUICK = [case for case in cases() if case.quick]
GROUPS = ("values", "shapes", "fronts", "features", "times", "networks", "rays")
CASE = Case(
    name="plain",
    group="values",
    about="nothing is hard",
    make=lambda: series(waves().astype(np.float32)),
    settings={"bound": EncodeConfig(max_error_rel=0.01, effort=1)},
)


def nothing() -> object:
    return series(np.full((2, 2, 2, 2), np.nan))


def found(worst: float) -> object:
    return lambda run: [Finding(name="broken", worst=worst, limit=1.0, unit="a|b")]


@pytest.mark.parametrize("case", QUICK, ids=[case.name for case in QUICK])
def test_what_must_hold_holds(case: Case) -> None:
    result = run_case(case)
    assert result.failures == []
    assert result.findings


def test_names_are_unique_and_every_case_says_what_is_hard() -> None:
    every = cases()
    assert len({case.name for case in every}) == len(every)
    assert {case.group for case in every} <= set(GROUPS)
    for case in every:
        assert case.name == case.name.lower().replace(" ", "-")
        assert case.about
        assert case.settings
        assert not set(case.settings) & {
            name for name, config in case.more.items() if case.settings.get(name, config) != config
        }


def test_a_series_is_the_same_on_every_call() -> None:
    for case in cases():
        one, other = case.make(), case.make()
        assert one.shape == other.shape
        assert one.read(0).tobytes() == other.read(0).tobytes()


def test_cases_are_chosen_by_name_and_group() -> None:
    assert [case.name for case in chosen(names=["spike"])] == ["spike"]
    assert {case.group for case in chosen(groups=["times"])} == {"times"}
    assert chosen() == tuple(QUICK)
    assert chosen(everything=True) == cases()
    with pytest.raises(InputError, match="unknown case 'spikey'; did you mean 'spike'"):
        chosen(names=["spikey"])
    with pytest.raises(InputError, match="unknown group 'time'; did you mean 'times'"):
        chosen(groups=["time"])


def _ends(run: Run) -> Iterator[Finding]:
    yield Finding(name="begun", worst=0.0, limit=1.0, unit="")
    raise ValueError("and it ends")


def test_a_property_that_does_not_hold_and_one_that_ends_with_an_error_are_failures() -> None:
    result = run_case(replace(CASE, checks=(found(2.0), _ends)))
    assert not result.holds
    assert result.failures == [
        "bound: _ends: ValueError: and it ends",
        "bound: broken is 2 a|b, at most 1",
    ]
    assert result.worst is not None
    assert relative(result.worst) == 2


def test_a_figure_that_is_no_number_does_not_hold() -> None:
    assert relative(Finding(name="lost", worst=float("nan"), limit=1.0, unit="")) == np.inf
    assert not run_case(replace(CASE, checks=(found(float("nan")),))).holds


@pytest.mark.parametrize(
    ("spoiled", "property_name"),
    [
        ("value", "strict bound"),
        ("missing", "finite in the coreset"),
        ("filled", "NaN outside of it"),
        ("value", "region = slice"),
    ],
)
def test_a_value_that_decodes_wrongly_is_found(
    monkeypatch: pytest.MonkeyPatch, spoiled: str, property_name: str
) -> None:
    def decoded(run: Run) -> np.ndarray:
        values = run.volume[...]
        values[1:, 2:7, 3:8, 4:9] = {
            "value": values[1:, 2:7, 3:8, 4:9] + 0.02,
            "missing": np.nan,
            "filled": 0.5,
        }[spoiled]
        return values

    def make() -> object:
        values = waves().astype(np.float32)
        if spoiled == "filled":
            values[1, 2, 3, 4] = np.inf
        return series(values)

    monkeypatch.setattr(Run, "decoded", property(decoded))
    result = run_case(replace(CASE, make=make), checks=(*accuracy.CHECKS, regions))
    assert property_name in {one.name for one in result.findings if not one.holds}


def test_bytes_that_depend_on_the_threads_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    from fhash_codec.selftest.checks import repeating

    encode = repeating.encode

    def other(source: object, path: object, config: EncodeConfig, **rest: object) -> object:
        return encode(source, path, replace(config, seed=int(os.environ["FHASH_THREADS"])), **rest)

    monkeypatch.setattr(repeating, "encode", other)
    assert [one.name for one in run_case(CASE).findings if not one.holds] == [
        "same bytes by other threads"
    ]


@pytest.mark.parametrize(
    ("change", "failure"),
    [
        ({"make": lambda: 1 / 0}, "making the series: ZeroDivisionError: division by zero"),
        ({"make": nothing}, "bound: InputError: array: 'hard' has no finite value"),
        (
            {"refused": "no finite value"},
            "bound: was encoded; it should have been refused with 'no finite value'",
        ),
        ({"make": nothing, "refused": "nowhere"}, "which does not say 'nowhere'"),
    ],
)
def test_whatever_goes_wrong_is_a_line_of_the_result(
    change: dict[str, object], failure: str
) -> None:
    result = run_case(replace(CASE, **change))
    assert not result.holds
    assert len(result.failures) == 1
    assert failure in result.failures[0]


def test_a_numeric_warning_is_a_failure() -> None:
    result = run_case(replace(CASE, checks=(lambda run: [np.float64(1e308) * 10],)))
    assert result.errors == (
        "bound: <lambda>: RuntimeWarning: overflow encountered in scalar multiply",
    )


def test_differences_are_exact() -> None:
    everywhere = np.ones(2, dtype=bool)
    large = np.array([2**63 - 1, 5], dtype=np.int64)
    assert accuracy.largest_difference(large, np.array([2.0**63, 5.0]), everywhere) == 1
    huge = np.array([1.7e308, 0.0])
    assert accuracy.largest_difference(huge, -huge, everywhere) == 2 * Fraction(1.7e308)
    tiny = np.array([5e-324, 0.0])
    assert accuracy.largest_difference(tiny, np.zeros(2), everywhere) == Fraction(5e-324)


def test_the_environment_is_put_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FHASH_THREADS", "3")
    monkeypatch.delenv("FHASH_NATIVE", raising=False)
    seen = []

    def within() -> None:
        with environment(FHASH_THREADS="2", FHASH_NATIVE="0"):
            seen.append((os.environ["FHASH_THREADS"], os.environ["FHASH_NATIVE"]))
            raise ValueError("out")

    with pytest.raises(ValueError, match="out"):
        within()
    assert seen == [("2", "0")]
    assert os.environ["FHASH_THREADS"] == "3"
    assert "FHASH_NATIVE" not in os.environ


def test_results_survive_json() -> None:
    one = Finding(name="a", worst=float("inf"), limit=0.0, unit="values", under="bound")
    result = CaseResult(
        name="x", group="values", about="y", under=("bound",), findings=(one,), errors=("z",)
    )
    assert CaseResult.from_dict(result.to_dict()) == result


def test_cases_run_in_processes_in_their_order() -> None:
    picked = [*chosen(names=["threes"]), *chosen(names=["nothing-finite"]), *chosen(names=["twos"])]
    seen: list[str] = []
    summary = run_cases(
        picked,
        processes=2,
        progress=lambda stage, done, total, note: seen.append(f"{stage} {done}/{total}"),
    )
    assert [result.name for result in summary.results] == ["threes", "nothing-finite", "twos"]
    assert summary.failures == []
    assert seen == ["testing 1/3", "testing 2/3", "testing 3/3"]


def test_a_process_that_dies_or_hangs_is_a_failure_of_its_case() -> None:
    unknown = replace(chosen(names=["nothing-finite"])[0], name="of-no-catalogue")
    summary = run_cases([unknown, *chosen(names=["nothing-finite"])], processes=1)
    assert [result.holds for result in summary.results] == [False, True]
    assert summary.failures == ["of-no-catalogue: the process ended with 1"]
    slow = run_cases(chosen(names=["twos"]), processes=1, longest=0.0)
    assert slow.failures == ["twos: took longer than 0 s"]


def test_an_interruption_ends_the_processes() -> None:
    def stop(stage: str, done: int, total: int, note: str) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_cases(
            [*chosen(names=["nothing-finite"]), *chosen(groups=["times"])],
            processes=1,
            progress=stop,
        )
    assert multiprocessing.active_children() == []


def test_the_report_names_every_case_and_what_does_not_hold() -> None:
    good = run_case(CASE)
    bad = run_case(replace(CASE, name="bad", checks=(found(2.0),)))
    text = markdown(Summary(results=[good, bad]), options=" --case bad")
    assert "Made by `fhash selftest --case bad --report`: 2 hard cases" in text
    assert "**1 does not hold.**" in text
    assert "- bad: bound: broken is 2 a\\|b, at most 1" in text
    assert "| bad | nothing is hard | bound | broken (bound) | 2 a\\|b | 1 |" in text
    assert "Everything holds." in markdown(Summary(results=[good]))
    assert markdown(Summary(results=[good])) == markdown(Summary(results=[run_case(CASE)]))
