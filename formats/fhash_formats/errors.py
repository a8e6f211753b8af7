"""Errors that fhash raises: one tree, each with a clear message; and the nearest of known names."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import Any


class FhashError(Exception):
    """Base of all errors of fhash. The command line exits with `exit_code`."""

    exit_code = 1


class InputError(FhashError, ValueError):
    """An unsuitable input, option or value."""

    exit_code = 2


class MissingInputError(InputError, FileNotFoundError):
    """An input that does not exist."""


class RegionError(FhashError, IndexError):
    """A region, step, time or point outside the domain."""

    exit_code = 2


class OutputExistsError(InputError, FileExistsError):
    """An output that exists and may not be replaced without permission (`force`)."""


class OutputError(FhashError, OSError):
    """An output that could not be written: no such folder, no permission, a full disk."""


class QualityError(FhashError):
    """A promised quality that was missed; `figures` is the report of the file."""

    exit_code = 3

    def __init__(self, message: str, figures: Mapping[str, Any] | None = None) -> None:
        super().__init__(message)
        self.figures: Any = figures or {}


class DamagedFileError(FhashError, ValueError):
    """A `.fhz` file that is damaged, hostile or not a container."""

    exit_code = 4


class UnsupportedFileError(DamagedFileError):
    """A sound `.fhz` file of another format, or with features that this version does not know."""


class TrainingError(FhashError, ArithmeticError):
    """Training that diverged or cannot go on."""


class ClusterError(FhashError, RuntimeError):
    """Work that failed on a machine of a cluster, or a cluster that was lost."""


class MissingDependencyError(FhashError, ImportError):
    """A missing optional library of a format or command; the message names the extra to install."""

    exit_code = 2


class InterruptedEncodingError(FhashError):
    """Encoding that a user stopped; the same command continues from its saved checkpoint."""

    exit_code = 130


class FhashWarning(UserWarning):
    """A fact that a user should know and that is no error."""


LIKENESS = 0.6
"""Likeness of two names, 0 to 1, from which on one may stand for the other by mistake."""


def suggestion(name: str, allowed: Iterable[str]) -> str:
    """A clause that names what was probably meant, or else all that is allowed."""
    names = list(allowed)
    near = difflib.get_close_matches(name[:100], names, n=1, cutoff=LIKENESS)
    return f"did you mean '{near[0]}'?" if near else f"known: {', '.join(names)}"
