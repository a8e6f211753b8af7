"""Limits that SECURITY.md lists are those of the program."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

import pytest

TEXT = (Path(__file__).parents[2] / "SECURITY.md").read_text(encoding="utf-8")
ROWS = re.findall(r"^\| (.+) \| ([0-9^]+)(?: (\w+))? \| `(.+)\.(\w+)` \|$", TEXT, re.MULTILINE)
UNITS = {"MiB": 2**20, "GiB": 2**30}


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_limits_are_those_of_the_program(row: tuple[str, ...]) -> None:
    _, number, unit, module, name = row
    base, _, power = number.partition("^")
    limit = int(base) ** int(power or 1) * UNITS.get(unit, 1)
    assert getattr(import_module(module), name) == limit


def test_every_row_is_looked_at() -> None:
    assert len(ROWS) == TEXT.count("` |\n") > 12
