"""Suggestions: the name that was meant, and none that is quite another."""

from __future__ import annotations

import pytest

from fhash_formats import errors
from fhash_formats.errors import suggestion

NAMES = ("shadows", "shading", "box")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("shadow", "did you mean 'shadows'?"),
        ("shadng", "did you mean 'shading'?"),
        ("foo", "known: shadows, shading, box"),
        ("", "known: shadows, shading, box"),
        ("x" * 10_000, "known: shadows, shading, box"),
    ],
)
def test_suggestion(name: str, text: str) -> None:
    assert suggestion(name, NAMES) == text


@pytest.mark.parametrize(
    ("error", "base", "exit_code"),
    [
        (errors.InputError, ValueError, 2),
        (errors.MissingInputError, FileNotFoundError, 2),
        (errors.RegionError, IndexError, 2),
        (errors.OutputExistsError, FileExistsError, 2),
        (errors.OutputError, OSError, 1),
        (errors.QualityError, Exception, 3),
        (errors.DamagedFileError, ValueError, 4),
        (errors.UnsupportedFileError, errors.DamagedFileError, 4),
        (errors.TrainingError, ArithmeticError, 1),
        (errors.MissingDependencyError, ImportError, 2),
        (errors.InterruptedEncodingError, Exception, 130),
    ],
)
def test_every_error_has_its_base_and_its_exit_code(
    error: type[errors.FhashError], base: type[Exception], exit_code: int
) -> None:
    assert issubclass(error, errors.FhashError)
    assert issubclass(error, base)
    assert error.exit_code == exit_code
    assert str(error("what is wrong")) == "what is wrong"


def test_a_missed_quality_has_its_figures() -> None:
    assert errors.QualityError("missed", {"psnr": 40.0}).figures == {"psnr": 40.0}
    assert errors.QualityError("missed").figures == {}
