"""Runs of cases, in this process and in workers; their results and the report."""

from __future__ import annotations

import json
import multiprocessing
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from fractions import Fraction
from itertools import groupby
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fhash_codec.config import EncodeConfig
from fhash_codec.rendering.plan import plan_picture
from fhash_codec.rendering.scenes import Scene
from fhash_codec.selftest import checks, ray_cases, value_cases
from fhash_codec.selftest.case import Case, Check, Finding, Run, environment
from fhash_codec.selftest.field_cases import TIME_CASES, series
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
    assert Finding("a", worst, 1.0, "").holds is holds


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


def case_result(name: str, worst: float, errors: tuple[str, ...] = ()) -> CaseResult:
    planted = Finding("planted", worst, 1.0, "a|b", "bound")
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
    return Finding(name, worst, limit, "values", "bound")


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
def test_results_are_json(worst: float) -> None:
    given = result("x", finding("a", worst), under=("bound",), errors=("ended",))
    values = json.loads(json.dumps(given.to_dict(), allow_nan=False))
    assert (values["holds"], values["under"], values["errors"]) == (False, ["bound"], ["ended"])
    (told,) = values["findings"]
    assert (told["name"], float(told["worst"]), told["holds"]) == ("a", worst, worst <= 1)


def quick_cases() -> list[Any]:
    """Every quick case; `make test` runs the middle one of each group."""
    found = []
    for _, group in groupby(sorted(cases(), key=lambda each: each.group), lambda each: each.group):
        several = [each for each in group if each.quick]
        for n, each in enumerate(several):
            marks = () if n == len(several) // 2 else pytest.mark.every
            found.append(pytest.param(each, id=each.name, marks=marks))
    return found


@pytest.mark.parametrize("case", quick_cases())
def test_what_must_hold_holds(case: Case) -> None:
    result = run_case(case)
    assert result.failures == []
    assert result.findings


def test_every_group_has_a_quick_case() -> None:
    quick = {case.group for case in cases() if case.quick}
    assert quick == {case.group for case in cases()}


def _raises(run: Run) -> Iterator[Finding]:
    yield Finding("begun", 0.0, 1.0, "")
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


Broken = Callable[[Run, Check], set[str]]
Spoiled = Callable[..., Run]
COMMON = [*checks.ACCESS_CHECKS, *checks.ACCURACY_CHECKS, *checks.REPEATING_CHECKS, checks.picture]
PART = (slice(1, None), slice(2, 7), slice(3, 8), slice(4, 9))


@pytest.mark.parametrize("check", COMMON)
def test_the_easy_case_keeps_every_property(run: Run, broken: Broken, check: Check) -> None:
    assert broken(run, check) == set()


@pytest.mark.parametrize(
    ("check", "properties"),
    [
        (checks.regions, {"region = slice"}),
        (checks.key_times, {"exact at key times"}),
        (checks.points, {"points = read"}),
    ],
)
def test_a_read_of_other_values_is_seen(
    run: Run, broken: Broken, spoiled: Spoiled, check: Check, properties: set[str]
) -> None:
    assert broken(spoiled(run, run.decoded + np.float32(1e-3)), check) == properties


def holed(values: np.ndarray) -> np.ndarray:
    """Other values, some of them missing."""
    values[:2] += np.float32(1e-3)
    values[2:, ::2] = np.nan
    return values


def part(change: Callable[[np.ndarray], object]) -> Callable[[np.ndarray], np.ndarray]:
    """A change of a part of the values."""

    def changed(values: np.ndarray) -> np.ndarray:
        values[PART] = change(values[PART])
        return values

    return changed


@pytest.mark.parametrize(
    ("check", "change", "properties"),
    [
        (checks.between, holed, {"even between steps"}),
        (checks.levels_of_detail, holed, {"level 0 = read", "coarse levels finite"}),
        (checks.points, holed, {"points: finite as read"}),
        (checks.presence, part(lambda values: np.nan), {"finite in the coreset"}),
        (checks.bound, part(lambda values: values + 0.02), {"strict bound"}),
        (
            checks.quality,
            part(lambda values: values + 0.02),
            {"beyond the stated error", "below the stated PSNR"},
        ),
        (checks.within_range, part(lambda values: 1.02), {"beyond the range"}),
    ],
)
def test_values_that_decode_wrongly_are_seen(
    compact_run: Run,
    broken: Broken,
    spoiled: Spoiled,
    check: Check,
    change: Callable[[np.ndarray], np.ndarray],
    properties: set[str],
) -> None:
    seen = broken(spoiled(compact_run, change(compact_run.decoded.copy())), check)
    assert seen >= properties
    assert seen == properties or change is holed


def test_holes_promises_constants_and_bounds_of_0_are_checked(
    compact_run: Run, broken: Broken, spoiled: Spoiled
) -> None:
    values = compact_run.values.copy()
    values[1, 2, 3, 4] = np.inf
    filled = spoiled(replace(compact_run, values=values), compact_run.decoded)
    assert broken(filled, checks.presence) == {"NaN outside of it"}

    config = replace(compact_run.config, max_error_rel=None, psnr=120.0)
    assert broken(replace(compact_run, config=config), checks.quality) == {"promised PSNR"}

    ones = np.ones_like(compact_run.values)
    decoded = ones.copy()
    constant = replace(compact_run, values=ones)
    assert broken(spoiled(constant, decoded), checks.constants) == set()
    decoded[0, 0, 0, 0] = np.nextafter(np.float32(1), np.float32(2))
    assert broken(spoiled(constant, decoded), checks.constants) == {"exact constant"}

    lossless = replace(compact_run.config, max_error_rel=None, max_error=0.0)
    (finding,) = checks.bound(replace(compact_run, config=lossless))
    assert finding.name == "lossless"
    assert finding.worst == np.count_nonzero(compact_run.values != compact_run.decoded) > 0


def test_bits_rounding_and_differences_are_counted_exactly(run: Run) -> None:
    zeros = np.zeros(3, np.float32)
    assert checks._count_unequal(zeros, zeros) == 0
    assert checks._count_unequal(zeros, -zeros) == 3
    assert checks._count_unequal(np.full(2, np.nan), np.full(2, np.nan)) == 0
    assert checks._count_unequal(zeros, zeros[:2]) == 3
    assert checks._count_unequal(zeros, zeros.astype(np.float64)) == 3

    off = np.float32(1e-5 * run.data_range)
    assert checks.rounding(run, run.decoded, run.decoded) == 0
    once = checks.rounding(run, run.decoded + off, run.decoded)
    assert once > 1
    ten = checks.rounding(run, run.decoded + 10 * off, run.decoded)
    assert ten == pytest.approx(10 * once, rel=0.1)

    everywhere = np.ones(2, dtype=bool)
    large = np.array([2**63 - 1, 5], dtype=np.int64)
    huge, tiny = np.array([1.7e308, 0.0]), np.array([5e-324, 0.0])
    assert checks.largest_difference(large, np.array([2.0**63, 5.0]), everywhere) == 1
    assert checks.largest_difference(huge, -huge, everywhere) == 2 * Fraction(1.7e308)
    assert checks.largest_difference(tiny, np.zeros(2), everywhere) == Fraction(5e-324)
    assert checks.largest_difference(huge, -huge, ~everywhere) == 0


def test_the_coreset_of_an_interval_is_grown_and_spans_key_frames(compact_run: Run) -> None:
    values = np.zeros_like(compact_run.values)
    values[1, 4, 5, 6] = 10.0
    config = replace(compact_run.config, features=("interval:9:11",), dilation=1)
    mask = checks.expected_coreset(replace(compact_run, values=values, config=config))
    assert mask.sum(axis=(1, 2, 3)).tolist() == [0, 27, 0, 0]
    assert mask[1, 3:6, 4:7, 5:8].all()


@pytest.mark.parametrize(
    ("cached", "others", "properties"),
    [
        (0.5, 0.5, set()),
        (1.001, 0.5, {"pixels in 0..1"}),
        (-0.001, 0.5, {"pixels in 0..1"}),
        (0.5, np.nan, {"finite pixels, stream", "finite pixels, arm"}),
    ],
)
def test_wrong_pixels_are_seen(
    paper_run: Run,
    broken: Broken,
    monkeypatch: pytest.MonkeyPatch,
    cached: float,
    others: float,
    properties: set[str],
) -> None:
    def drawn(run: Run, mode: str) -> np.ndarray:
        return np.full((4, 4, 4), cached if mode == "cache" else others, np.float32)

    monkeypatch.setattr(checks, "_rendered", drawn)
    assert broken(paper_run, checks.picture) == properties


def test_a_picture_that_differs_from_that_of_float64_is_seen(
    compact_run: Run, broken: Broken, monkeypatch: pytest.MonkeyPatch
) -> None:
    reference = ray_cases.reference_picture
    monkeypatch.setattr(ray_cases, "reference_picture", lambda *given: reference(*given) + 2e-3)
    assert broken(compact_run, checks.picture) == {"float64 picture"}


def test_the_float64_picture_of_a_network_is_the_same_on_a_gpu(
    paper_run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There `auto` marches through the network, whose values between vertices are others."""
    (here,) = (each for each in checks.picture(paper_run) if each.name == "float64 picture")
    monkeypatch.setattr("fhash_codec.rendering.plan.has_device", lambda: True)
    assert plan_picture(paper_run.volume, Scene(), pictures=10**9).mode == "arm"
    (there,) = (each for each in checks.picture(paper_run) if each.name == "float64 picture")
    assert there.worst == here.worst
    assert here.holds


@pytest.mark.parametrize("thorough", [False, True])
def test_bytes_that_depend_on_the_threads_are_seen(
    compact_run: Run,
    broken: Broken,
    monkeypatch: pytest.MonkeyPatch,
    thorough: bool,
    tmp_path: Path,
) -> None:
    encode = checks.encode
    counts = []

    def other(source: object, path: object, config: EncodeConfig, **rest: object) -> object:
        counts.append(int(os.environ["FHASH_THREADS"]))
        return encode(source, path, replace(config, seed=counts[-1]), **rest)

    monkeypatch.setattr(checks, "encode", other)
    run = replace(compact_run, thorough=thorough)
    assert broken(run, checks.same_bytes) == {"same bytes by other threads"}
    assert counts == [1, 2] if thorough else len(counts) == 1

    (tmp_path / "a").write_bytes(b"abcd")
    for data, count in ((b"abcd", 0), (b"abxd", 1), (b"axc", 2)):
        assert checks._count_unequal_bytes(data, tmp_path / "a") == count


def test_answers_outside_the_series_are_counted(compact_run: Run, broken: Broken) -> None:
    (outside,) = next(case for case in TIME_CASES if case.name == "tiny").checks
    assert broken(compact_run, outside) == set()
    volume = compact_run.volume
    clamped = SimpleNamespace(
        shape=volume.shape,
        key_times=volume.key_times,
        read=lambda step: volume.read(0),
        step_of_time=volume.step_of_time,
        sample=volume.sample,
    )
    assert broken(replace(compact_run, volume=clamped), outside) == {"outside is refused"}


@pytest.mark.parametrize(
    ("check", "error", "growth", "properties"),
    [
        (value_cases.powers_of_two, 0.0, 1.0, set()),
        (value_cases.powers_of_two, 1e-6, 1.0, {"times a power of two"}),
        (value_cases.powers_of_two, 0.0, 1.01, {"times a power of two, size"}),
        (value_cases.affine, 0.0, 1.0, set()),
        (value_cases.affine, 0.0, 1.1, {"same size in any guise"}),
        (value_cases.affine, 1.0, 1.0, {"same PSNR in any guise"}),
        (value_cases.guises, 0.0, 1.0, set()),
        (value_cases.guises, 0.0, 0.9, {"same size in any guise"}),
        (value_cases.guises, 0.02, 1.0, {"same PSNR in any guise", "bound in any guise"}),
    ],
)
def test_a_guise_with_other_errors_or_another_size_is_seen(
    compact_run: Run,
    broken: Broken,
    monkeypatch: pytest.MonkeyPatch,
    check: Check,
    error: float,
    growth: float,
    properties: set[str],
) -> None:
    """Gives every guise the errors of the run, and a share of the range more."""
    own = compact_run.decoded - compact_run.values.astype(np.float64)

    def encoded(run: Run, values: np.ndarray, factor: float, **_: object) -> tuple:
        exact = values.astype(np.float64)
        extra = error * (exact.max() - exact.min())
        same = own if values.shape == own.shape else np.resize(own, values.shape)
        return exact + same * factor + extra, value_cases._size(run.volume) * growth

    monkeypatch.setattr(value_cases, "_encoded", encoded)
    seen = broken(compact_run, check)
    assert properties <= seen
    assert properties or not seen
