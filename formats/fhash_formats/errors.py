"""The one error tree of fhash; every package raises from here and the command line turns it into one line.

The tree has built-in bases, so that `except FileNotFoundError` works as it does anywhere else.
A message says what is wrong, the value that was given, what is allowed and what to do about it.
"""

from __future__ import annotations

from typing import Any


class FhashError(Exception):
    """Anything that fhash refuses or fails at. The command line exits with `exit_code`."""

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
    """An output that is there already and may not be replaced without leave."""


class OutputError(FhashError, OSError):
    """An output that could not be written: no such folder, no permission, a full disk."""


class QualityError(FhashError):
    """A promised quality that was not reached; `figures` holds what was, as JSON values."""

    exit_code = 3

    def __init__(self, message: str, figures: dict[str, Any] | None = None) -> None:
        super().__init__(message)
        self.figures = figures or {}


class DamagedFileError(FhashError, ValueError):
    """A `.fhz` file that is damaged, hostile or not a container at all."""

    exit_code = 4


class UnsupportedFileError(DamagedFileError):
    """A sound `.fhz` file of a newer format or with features that this version does not know."""


class TrainingError(FhashError, ArithmeticError):
    """Training that diverged or cannot go on."""


class MissingDependencyError(FhashError, ImportError):
    """An optional library that a format or command needs; the message names the extra to install."""

    exit_code = 2


class InterruptedEncodingError(FhashError):
    """Encoding that a user stopped; its checkpoint is saved and the same command goes on from there."""

    exit_code = 130


class FhashWarning(UserWarning):
    """Something that a user should know and that is no error."""
