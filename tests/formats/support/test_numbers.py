"""Texts that are numbers."""

from __future__ import annotations

import pytest

from fhash_formats.support.numbers import is_number


@pytest.mark.parametrize("text", ["0", "-1.5", "1e-300", " 2 ", "inf", "nan", "1_000"])
def test_what_float_reads_is_a_number(text: str) -> None:
    assert is_number(text)


@pytest.mark.parametrize("text", ["", " ", "x", "1:2", "0x10", "1,5", "2001-02-10", "--1"])
def test_other_texts_are_none(text: str) -> None:
    assert not is_number(text)
