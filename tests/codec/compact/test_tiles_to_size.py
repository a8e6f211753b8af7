"""The search for a number of bytes: on tables that are made up, by a law of their sizes."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fhash_codec.compact.choices.transform import usual_transform
from fhash_codec.compact.coded_table import CodedTable
from fhash_codec.compact.goal import Goal
from fhash_codec.compact.plan import CodingPlan
from fhash_codec.compact.tiles.coding import Coding, Outcome
from fhash_codec.compact.tiles_to_size import PASSES, ByteWindow, code_to_size, is_exact
from fhash_formats.transform.tile.settings import TileSettings

Law = Callable[[float], float]
WINDOW = ByteWindow(9524.0, 10000.0)


def coder(law: Law, dtype: str = "float32") -> tuple[CodedTable, Callable[..., CodedTable], list]:
    """Return a table to begin with, the function that makes others, and the steps it was given."""
    steps: list[float] = []
    blocks: Any = SimpleNamespace(dtype=np.dtype(dtype))

    def code_all(plan: CodingPlan) -> CodedTable:
        step = plan.settings.step
        steps.append(step)
        error = 0.0 if step < 1e-3 else step / 2
        outcome = Outcome(size=round(law(step)), squares=error, count=1, max_error=error)
        return CodedTable(plan=plan, streams=[], outcome=outcome)

    settings = TileSettings(
        transform=usual_transform((1, 4, 4, 4)), step=0.05, center=0.0, low=0.0, high=10.0
    )
    plan = CodingPlan(
        blocks=blocks, settings=settings, coding=Coding(), goal=Goal(size=1.0, data_range=10.0)
    )
    return code_all(plan), code_all, steps


LAWS: dict[str, Law] = {
    "usual": lambda step: 300 * step**-1.2 + 20,
    "steep": lambda step: 20000 * math.exp(-step * 40),
    "flat": lambda step: 8000 * step**-0.1,
    "wavy": lambda step: 300 * step**-1.2 * (1 + 0.2 * math.sin(9 * math.log(step))),
}


@pytest.mark.parametrize("name", LAWS)
def test_a_size_is_found(name: str) -> None:
    table, code_all, steps = coder(LAWS[name])
    assert WINDOW.holds(code_to_size(table, WINDOW, code_all))
    assert len(steps) <= PASSES + 1


def test_a_table_that_fits_is_not_coded_again() -> None:
    table, code_all, steps = coder(lambda step: 9800.0)
    assert code_to_size(table, WINDOW, code_all) is table
    assert len(steps) == 1


def test_where_no_step_fits_the_best_table_below_is_taken() -> None:
    table, code_all, _ = coder(lambda step: 12000.0 if step < 0.02 else 7000 - step)
    assert code_to_size(table, WINDOW, code_all).outcome.size in (6999, 7000)
    table, code_all, _ = coder(lambda step: 12000.0 - step)
    assert code_to_size(table, WINDOW, code_all).outcome.size < 12000


@pytest.mark.parametrize(("dtype", "passes"), [("float32", PASSES), ("int16", 0)])
def test_exact_values_are_not_coded_in_more_bytes(dtype: str, passes: int) -> None:
    """Whole numbers are exact already where their errors are below a half."""
    table, code_all, steps = coder(lambda step: 3000.0, dtype)
    assert is_exact(table) == (dtype == "int16")
    assert code_to_size(table, WINDOW, code_all).outcome.size == 3000
    assert (len(steps) == 1) == (passes == 0)


def test_the_window_is_five_percent_wide() -> None:
    window = ByteWindow.of(Goal(size=1050.0, data_range=1.0), 100)
    assert (window.low, window.high) == (pytest.approx(900.0), 950.0)
