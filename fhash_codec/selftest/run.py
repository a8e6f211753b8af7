"""Run of the cases in worker processes: catalogue, checks, results, and the report as Markdown."""

from __future__ import annotations

import math
import multiprocessing
import os
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from typing import Annotated, Any, TypedDict

import numpy as np

from fhash_codec.config import EncodeConfig
from fhash_codec.encoding import encode
from fhash_codec.progress import Progress, silent
from fhash_codec.selftest.case import RUN_THREADS, Case, Check, Finding, Run, environment
from fhash_codec.selftest.checks import COMMON_CHECKS
from fhash_codec.selftest.field_cases import FEATURE_CASES, FRONT_CASES, SHAPE_CASES, TIME_CASES
from fhash_codec.selftest.network_cases import NETWORK_CASES
from fhash_codec.selftest.ray_cases import RAY_CASES
from fhash_codec.selftest.value_cases import GUISE_CASES, VALUE_CASES
from fhash_codec.volume import open as open_volume
from fhash_formats.errors import InputError, QualityError, suggestion
from fhash_formats.series import Series
from fhash_formats.support.threads import usable_threads


def relative(finding: Finding) -> float:
    """The figure as a multiple of its limit: above 1 if the property does not hold.

    Infinite if the figure is NaN, or positive with a limit of 0.
    """
    if not finding.holds:
        return (
            math.inf
            if finding.limit <= 0 or math.isnan(finding.worst)
            else finding.worst / finding.limit
        )
    return max(finding.worst, 0.0) / finding.limit if finding.limit > 0 else 0.0


@dataclass(frozen=True, kw_only=True)
class CaseResult:
    """The results of one case."""

    name: Annotated[str, "name of the case"]
    group: Annotated[str, "its group"]
    about: Annotated[str, "one line that says what is hard"]
    under: Annotated[tuple[str, ...], "names of the settings that were tried"] = ()
    findings: Annotated[tuple[Finding, ...], "its figures under all settings"] = ()
    errors: Annotated[tuple[str, ...], "what kept it from finishing"] = ()

    @property
    def holds(self) -> bool:
        """Whether there was no error and all figures are within their limits."""
        return not self.errors and all(finding.holds for finding in self.findings)

    @property
    def worst(self) -> Finding | None:
        """The finding nearest to its limit, or farthest beyond it."""
        return max(self.findings, key=relative, default=None)

    @property
    def failures(self) -> list[str]:
        """One line for each error and for each property that does not hold."""
        broken = [finding for finding in self.findings if not finding.holds]
        return [
            *self.errors,
            *(
                f"{finding.under}: {finding.name} is {finding.worst:.6g} {finding.unit}, "
                f"at most {finding.limit:.6g}"
                for finding in broken
            ),
        ]

    def to_dict(self) -> dict[str, Any]:
        """JSON values; figures that are not finite become text."""
        return {**vars(self), "holds": self.holds, "findings": [*map(_json, self.findings)]}


class SelftestReport(TypedDict):
    """The results of many cases, as JSON values."""

    holds: Annotated[bool, "whether everything holds"]
    cases: Annotated[list[dict[str, Any]], list[CaseResult], "every case that was run"]
    failures: Annotated[list[str], "one line for each figure that does not hold, and each error"]


@dataclass(frozen=True, kw_only=True)
class Summary:
    """The results of many cases, in the order of the catalogue."""

    results: Sequence[CaseResult]

    @property
    def holds(self) -> bool:
        """Whether every case holds."""
        return all(result.holds for result in self.results)

    @property
    def groups(self) -> dict[str, list[CaseResult]]:
        """The results by group."""
        groups: dict[str, list[CaseResult]] = {}
        for result in self.results:
            groups.setdefault(result.group, []).append(result)
        return groups

    @property
    def failures(self) -> list[str]:
        """One line for each failure, beginning with the name of the case."""
        return [f"{result.name}: {line}" for result in self.results for line in result.failures]

    def worst(self) -> dict[str, tuple[CaseResult, Finding]]:
        """The finding nearest to its limit for each property, by name, with its case."""
        worst: dict[str, tuple[CaseResult, Finding]] = {}
        for result in self.results:
            for finding in result.findings:
                previous = worst.get(finding.name)
                if previous is None or relative(finding) > relative(previous[1]):
                    worst[finding.name] = result, finding
        return worst

    def to_dict(self) -> SelftestReport:
        """JSON values."""
        return {
            "holds": self.holds,
            "cases": [result.to_dict() for result in self.results],
            "failures": self.failures,
        }


def _json(finding: Finding) -> dict[str, Any]:
    """JSON values of a finding."""
    figures = {
        name: value if math.isfinite(value) else str(value)
        for name, value in (("worst", finding.worst), ("limit", finding.limit))
    }
    return {**vars(finding), **figures, "holds": finding.holds}


HEAD = """\
# Numerical stability

Made by `fhash selftest{options} --report`: {cases} hard cases. Each case is encoded with several
settings, decoded and drawn. A property holds if its figure is at most its limit. For each case, the
tables show the property whose figure came nearest to its limit.{where}

**{verdict}**
"""


def markdown(summary: Summary, *, options: str = "", where: str = "") -> str:
    """The verdict, the worst figure of every property, and a table of cases for every group.

    Args:
        summary: the results.
        options: options of the command that made them, for the text.
        where: a sentence on machine and time.
    """
    failures = summary.failures
    verdict = (
        "Everything holds."
        if summary.holds
        else "1 does not hold."
        if len(failures) == 1
        else f"{len(failures)} do not hold."
    )
    sections = [
        HEAD.format(
            options=options,
            cases=len(summary.results),
            verdict=verdict,
            where=where and f"\n\n{where}",
        )
    ]
    if failures:
        sections.append(
            "## What does not hold\n\n" + "\n".join(f"- {_plain(line)}" for line in failures) + "\n"
        )
    worst = summary.worst()
    sections.append("## The worst of every property\n")
    rows = [
        (name, _figure(finding), _limit(finding), result.name, finding.under)
        for name, (result, finding) in sorted(worst.items())
    ]
    sections.append(_table(("property", "worst", "limit", "case", "settings"), rows))
    for group, results in summary.groups.items():
        sections.append(f"## {group.capitalize()}\n")
        sections.append(
            _table(
                ("case", "what is hard", "settings", "nearest to its limit", "figure", "limit"),
                [_row(result) for result in results],
            )
        )
    return "\n".join(sections)


def _row(result: CaseResult) -> tuple[str, ...]:
    worst = result.worst
    shown = (
        ("-", "-", "-")
        if worst is None
        else (f"{worst.name} ({worst.under})", _figure(worst), _limit(worst))
    )
    if result.errors:
        shown = (result.errors[0], "-", "-")
    return (result.name, result.about, ", ".join(result.under), *shown)


def _figure(finding: Finding) -> str:
    return f"{finding.worst:.4g} {finding.unit}".rstrip()


def _limit(finding: Finding) -> str:
    return f"{finding.limit:.4g}"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return (
        "\n".join("| " + " | ".join(_plain(cell) for cell in line) + " |" for line in lines) + "\n"
    )


def _plain(text: str) -> str:
    return text.replace("|", "\\|")


@cache
def cases() -> tuple[Case, ...]:
    """All cases, group by group."""
    return (
        *VALUE_CASES,
        *SHAPE_CASES,
        *FRONT_CASES,
        *FEATURE_CASES,
        *TIME_CASES,
        *NETWORK_CASES,
        *RAY_CASES,
        *GUISE_CASES,
    )


def choose_cases(
    *, names: Sequence[str] = (), groups: Sequence[str] = (), everything: bool = False
) -> tuple[Case, ...]:
    """The cases with these names or of these groups; without names and groups, all quick cases.

    With `everything`, a call without names and groups returns the long set too. Raises InputError
    for an unknown name or group; its message offers the nearest one.
    """
    all_cases = cases()
    _check_names("case", names, [case.name for case in all_cases])
    _check_names("group", groups, list(dict.fromkeys(case.group for case in all_cases)))
    if names or groups:
        return tuple(case for case in all_cases if case.name in names or case.group in groups)
    return tuple(case for case in all_cases if case.quick or everything)


def _check_names(kind: str, names: Sequence[str], allowed: Sequence[str]) -> None:
    for name in names:
        if name not in allowed:
            raise InputError(f"unknown {kind} '{name}'; {suggestion(name, allowed)}")


def run_case(
    case: Case, *, everything: bool = False, checks: Sequence[Check] = COMMON_CHECKS
) -> CaseResult:
    """The result of a case; raises nothing but KeyboardInterrupt.

    A RuntimeWarning of numpy (an overflow or an invalid operation) counts as an error.

    Args:
        case: the case.
        everything: whether the additional settings of the long set are run, too.
        checks: the checks of every run, in addition to the checks of the case.
    """
    settings: Mapping[str, EncodeConfig] = {**case.settings, **(case.more if everything else {})}
    findings: list[Finding] = []
    errors: list[str] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("error", RuntimeWarning)
        try:
            series = case.make()
        except Exception as error:
            errors.append(_line("making the series", error))
            settings = {}
        for under, config in settings.items():
            with tempfile.TemporaryDirectory(prefix="fhash-selftest-") as folder:
                run_findings, run_errors = _run(
                    case,
                    series,
                    under,
                    replace(config, timings=False),
                    Path(folder),
                    checks,
                    everything,
                )
            findings += [
                replace(finding, under=f"{under}, {finding.under}" if finding.under else under)
                for finding in run_findings
            ]
            errors += run_errors
    return CaseResult(
        name=case.name,
        group=case.group,
        about=case.about,
        under=tuple(settings),
        findings=tuple(findings),
        errors=tuple(errors),
    )


def _run(
    case: Case,
    series: Series,
    under: str,
    config: EncodeConfig,
    folder: Path,
    checks: Sequence[Check],
    thorough: bool,
) -> tuple[list[Finding], list[str]]:
    """Findings and errors of a case under one of its settings."""
    path = folder / "case.fhz"
    if case.refused is not None:
        return _refused(case.refused, series, under, config, path)
    try:
        with environment(FHASH_THREADS=str(RUN_THREADS)):
            encode(series, path, config)
        values = np.stack(list(series.frames()))
        with open_volume(path) as volume:
            run = Run(
                case=case,
                series=series,
                values=values,
                under=under,
                config=config,
                folder=folder,
                path=path,
                volume=volume,
                thorough=thorough,
            )
            return _checked(run, [*checks, *case.checks])
    except Exception as error:
        return [], [_line(under, error)]


def _checked(run: Run, checks: Sequence[Check]) -> tuple[list[Finding], list[str]]:
    """Findings and errors of all checks; a check that raises does not stop the others."""
    findings: list[Finding] = []
    errors: list[str] = []
    for check in checks:
        try:
            findings += check(run)
        except Exception as error:
            errors.append(_line(f"{run.under}: {check.__name__}", error))
    return findings, errors


def _refused(
    expected: str, series: Series, under: str, config: EncodeConfig, path: Path
) -> tuple[list[Finding], list[str]]:
    """Whether the encoding is refused with a message that contains `expected`, and leaves no file.

    An encoding that misses its promise raises QualityError and leaves its file beside the name.
    """
    try:
        encode(series, path, config)
    except (InputError, QualityError) as error:
        if expected not in str(error):
            return [], [f"{under}: refused with '{error}', which does not say '{expected}'"]
        left = {entry.name for entry in path.parent.iterdir()} - (
            {f"{path.stem}.missed{path.suffix}"} if isinstance(error, QualityError) else set()
        )
        return [Finding("refused, nothing left", len(left), 0.0, "files")], []
    except Exception as error:
        return [], [_line(under, error)]
    return [], [f"{under}: was encoded; it should have been refused with '{expected}'"]


def _line(where: str, error: Exception) -> str:
    return " ".join(f"{where}: {type(error).__name__}: {error}".split())


MAX_SECONDS = 600.0
"""Longest time of one case, in seconds."""


def run_cases(
    cases: Sequence[Case],
    *,
    everything: bool = False,
    processes: int | None = None,
    max_seconds: float = MAX_SECONDS,
    progress: Progress = silent,
) -> Summary:
    """The results of cases of the catalogue, in the order of `cases`. Progress stage: "testing".

    Args:
        cases: cases of the catalogue; workers look them up by name.
        everything: whether the additional settings of the long set are run, too.
        processes: number of processes, by default one for each processor.
        max_seconds: max_seconds time of one case, in seconds.
        progress: called after each case.
    """
    count = max(1, min(processes or usable_threads(), len(cases)))
    idle: SimpleQueue[_Worker] = SimpleQueue()
    workers = [_Worker(everything) for _ in range(count)]
    for worker in workers:
        idle.put(worker)

    def run_one(case: Case) -> CaseResult:
        worker = idle.get()
        try:
            return worker.run(case, max_seconds)
        finally:
            idle.put(worker)

    results = []
    pool = ThreadPoolExecutor(count, thread_name_prefix="fhash-selftest")
    try:
        # One thread for each process; BLAS and torch read the variable when they are loaded there.
        with environment(OMP_NUM_THREADS=os.environ.get("OMP_NUM_THREADS", "1")):
            for result in pool.map(run_one, cases):
                results.append(result)
                progress("testing", len(results), len(cases), result.name)
    finally:
        # After an interruption no case is started, and no thread waits for a process.
        pool.shutdown(wait=False, cancel_futures=True)
        for worker in workers:
            worker.end()
        pool.shutdown()
    return Summary(results=results)


class _Worker:
    """A process that runs cases by name. It starts at the first case, and again after it died."""

    def __init__(self, everything: bool) -> None:
        self._everything = everything
        self._process: Any = None
        self._pipe: Any = None

    def run(self, case: Case, max_seconds: float) -> CaseResult:
        """The result of a case; if the process dies or takes too long, the result says so."""
        if self._process is None:
            self._start()
        try:
            self._pipe.send(case.name)
            if not self._pipe.poll(max_seconds):
                self._stop()
                return _broken(case, f"took longer than {max_seconds:g} s")
            result: CaseResult = self._pipe.recv()
            return result
        except (EOFError, OSError):
            code = self._stop(patience=5)
            return _broken(case, f"the process ended with {code}")

    def end(self) -> None:
        """End the process, even if it is busy."""
        self._stop()

    def _start(self) -> None:
        # Not forked: this process may have threads, and torch does not survive a fork.
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        self._process = context.Process(target=_serve, args=(other, self._everything), daemon=True)
        self._process.start()
        other.close()

    def _stop(self, *, patience: float = 0) -> int | None:
        """End the process and return its exit code. It has `patience` seconds to end by itself."""
        process, self._process = self._process, None
        if process is None:
            return None
        process.join(patience)
        process.terminate()
        process.join(5)
        if process.exitcode is None:
            process.kill()
            process.join()
        return int(process.exitcode)


def _broken(case: Case, line: str) -> CaseResult:
    return CaseResult(
        name=case.name,
        group=case.group,
        about=case.about,
        under=tuple(case.settings),
        errors=(line,),
    )


def _serve(pipe: Connection, everything: bool) -> None:
    """Run the cases whose names arrive on the pipe, until its other end closes."""
    try:
        while True:
            (case,) = choose_cases(names=[pipe.recv()])
            pipe.send(run_case(case, everything=everything))
    except (EOFError, OSError, KeyboardInterrupt):
        return
