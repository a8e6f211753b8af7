"""Suggestions: the name that was meant, and none that is quite another."""

from __future__ import annotations

import pytest

from fhash_formats.support.suggestions import suggestion

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
