"""The run of a case: encode, open, decode, draw and check it in a temporary folder.

Whatever goes wrong becomes a line of the result.
"""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from fhash_codec.config import EncodeConfig
from fhash_codec.devices import has_torch
from fhash_codec.encoding import encode
from fhash_codec.selftest.case import RUN_THREADS, Case, Check, Finding, Run
from fhash_codec.selftest.checks.properties import COMMON_CHECKS
from fhash_codec.selftest.environment import environment
from fhash_codec.selftest.results import CaseResult
from fhash_codec.volume import open as open_volume
from fhash_formats.errors import InputError, QualityError
from fhash_formats.series import Series

__all__ = ["run_case"]


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
    left_out = [name for name, config in settings.items() if not _possible(config)]
    settings = {name: config for name, config in settings.items() if name not in left_out}
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
        left_out=tuple(left_out),
    )


def _possible(config: EncodeConfig) -> bool:
    """Whether settings can be tried here: the profile paper needs torch."""
    return config.profile != "paper" or has_torch()


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

    An encoding that misses its promise raises QualityError and keeps its file.
    """
    try:
        encode(series, path, config)
    except (InputError, QualityError) as error:
        if expected not in str(error):
            return [], [f"{under}: refused with '{error}', which does not say '{expected}'"]
        left = {entry.name for entry in path.parent.iterdir()} - (
            {path.name} if isinstance(error, QualityError) else set()
        )
        return [
            Finding(name="refused, nothing left", worst=float(len(left)), limit=0.0, unit="files")
        ], []
    except Exception as error:
        return [], [_line(under, error)]
    return [], [f"{under}: was encoded; it should have been refused with '{expected}'"]


def _line(where: str, error: Exception) -> str:
    return " ".join(f"{where}: {type(error).__name__}: {error}".split())
