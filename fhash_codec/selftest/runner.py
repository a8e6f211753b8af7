"""Running cases: each in a folder of its own, encode -> container -> decode -> picture, and whatever goes wrong is a line of its result."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from fhash_codec.config import EncodeConfig
from fhash_codec.encoding import encode
from fhash_codec.selftest.case import RUN_THREADS, Case, Check, Finding, Run
from fhash_codec.selftest.checks.properties import EVERY
from fhash_codec.selftest.environment import environment
from fhash_codec.selftest.results import CaseResult
from fhash_codec.volume import open as open_volume
from fhash_formats.errors import InputError, QualityError
from fhash_formats.series import Series

__all__ = ["run_case"]


def run_case(
    case: Case, *, everything: bool = False, checks: Sequence[Check] = EVERY
) -> CaseResult:
    """What is found of a case, under the settings of the long set too with `everything`; nothing is raised but KeyboardInterrupt.

    checks: what every run has to keep, besides the checks of the case. A RuntimeWarning of numpy (an overflow, an invalid operation) counts
    as an error.
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
                found, wrong = _run(
                    case,
                    series,
                    under,
                    replace(config, timings=False),
                    Path(folder),
                    checks,
                    everything,
                )
            findings += [
                replace(one, under=f"{under}, {one.under}" if one.under else under) for one in found
            ]
            errors += wrong
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
    """A check that ends with an error does not keep the others from being made."""
    findings: list[Finding] = []
    errors: list[str] = []
    for check in checks:
        try:
            findings += check(run)
        except Exception as error:
            errors.append(_line(f"{run.under}: {check.__name__}", error))
    return findings, errors


def _refused(
    wanted: str, series: Series, under: str, config: EncodeConfig, path: Path
) -> tuple[list[Finding], list[str]]:
    """Whether the encoding is refused as it must be, and leaves nothing; one that misses its promise leaves its file, as it says."""
    try:
        encode(series, path, config)
    except (InputError, QualityError) as error:
        if wanted not in str(error):
            return [], [f"{under}: refused with '{error}', which does not say '{wanted}'"]
        left = {entry.name for entry in path.parent.iterdir()} - (
            {path.name} if isinstance(error, QualityError) else set()
        )
        return [
            Finding(name="refused, nothing left", worst=float(len(left)), limit=0.0, unit="files")
        ], []
    except Exception as error:
        return [], [_line(under, error)]
    return [], [f"{under}: was encoded; it should have been refused with '{wanted}'"]


def _line(where: str, error: Exception) -> str:
    return " ".join(f"{where}: {type(error).__name__}: {error}".split())
