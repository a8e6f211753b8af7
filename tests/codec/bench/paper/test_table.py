"""Tables as text, Markdown and JSON."""

from __future__ import annotations

import json
import math

import pytest

from fhash_codec.bench.paper.table import NR, PaperTable, Spread, shown


@pytest.mark.parametrize(
    ("figures", "text"),
    [
        ([2.0], "2"),
        ([1.234], "1.23"),
        ([3.0, 1.0, 2.5], "2.5 (1-3)"),
        ([2.0, 2.0], "2"),
        ([None], NR),
        ([4.0, None, None], "NR (4-NR)"),
        ([4.0, 5.0, None], "5 (4-NR)"),
        ([12345.6], "12,346"),
        ([0.0], "0"),
    ],
)
def test_a_spread_has_its_median_and_its_ends(figures: list[float | None], text: str) -> None:
    assert str(Spread.of(figures)) == text


def test_no_seed_has_no_spread() -> None:
    assert Spread.of([]) is None


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "-"),
        ("a", "a"),
        (1234567, "1,234,567"),
        (205.83, "205.8"),
        (1223.84, "1,223.8"),
        (0.05, "0.05"),
    ],
)
def test_values_as_text(value: float | str | None, text: str) -> None:
    assert shown(value) == text


def test_a_table_as_markdown_and_json() -> None:
    table = PaperTable(
        name="t",
        title="A title",
        columns=("set", "a|b"),
        rows=(("x", Spread.of([1.0, None])), ("y", None)),
        notes=("a note",),
    )
    assert table.lines() == [["set", "a|b"], ["x", "NR (1-NR)"], ["y", "-"]]
    assert table.markdown().splitlines() == [
        "### A title",
        "",
        "| set | a\\|b |",
        "| --- | --- |",
        "| x | NR (1-NR) |",
        "| y | - |",
        "",
        "- a note",
    ]
    rows = json.loads(json.dumps(table.to_dict(), allow_nan=False))["rows"]
    assert rows[0]["a|b"] == {"median": NR, "low": 1.0, "high": NR, "seeds": 2}
    assert rows[1] == {"set": "y", "a|b": None}
    assert math.isinf(table.rows[0][1].median)  # type: ignore[union-attr]
