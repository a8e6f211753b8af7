"""Quoted figures: identities that hold among them catch a slip of the pen."""

from __future__ import annotations

import json
import math
from itertools import product
from math import prod

import pytest

from fhash_bench.paper.printed import (
    DECIBELS,
    ENCODINGS,
    NOT_REACHED_TEXT,
    NOTES,
    PARAMETERS,
    SETS,
    TABLE_1,
    TABLE_2,
    TABLE_3,
    TABLE_4,
    TABLE_5,
    TABLE_6,
    PaperTable,
    Spread,
    notes_of,
    shown,
)

M = 2**20


def test_every_table_has_every_cell() -> None:
    for table in (TABLE_4, TABLE_6, PARAMETERS):
        assert [tuple(row) for row in table.values()] == [tuple(ENCODINGS)] * len(SETS)
    for name, decibels in product(SETS, DECIBELS):
        assert tuple(TABLE_3[name][decibels]) == tuple(ENCODINGS)
    assert len(TABLE_1) == 12


def test_time_is_proportional_to_the_embedding() -> None:
    for (fold, size), minutes in TABLE_1.items():
        assert minutes / size == pytest.approx(TABLE_1[fold, 1], rel=0.01)


@pytest.mark.parametrize("name", SETS)
def test_sizes_and_boxes_agree(name: str) -> None:
    data = TABLE_2[name]
    assert data.raw_bytes / 2**30 == pytest.approx(data.gigabytes, abs=0.01)
    assert prod(data.box) / prod(data.shape) == pytest.approx(data.box_share, abs=1e-4)


@pytest.mark.parametrize("name", SETS)
def test_more_decibels_never_take_less_time(name: str) -> None:
    for encoding in ENCODINGS:
        for feature in range(3):
            times = [TABLE_3[name][decibels][encoding][feature] for decibels in DECIBELS]
            reached = [minutes for minutes in times if minutes is not None]
            assert reached == sorted(reached)
            assert times[: len(reached)] == reached


@pytest.mark.parametrize("name", SETS)
def test_ratios_follow_from_parameters(name: str) -> None:
    raw = TABLE_2[name].raw_bytes / 2**20
    assert PARAMETERS[name]["dense-multi"][0] / PARAMETERS[name]["dense"][0] == pytest.approx(
        8 / 7, abs=0.002
    )
    for encoding in set(ENCODINGS) - {"tcnn"}:
        for feature, ratio in enumerate(TABLE_5[name][encoding]):
            assert raw / (4 * PARAMETERS[name][encoding][feature] * M / 1e6) == pytest.approx(
                ratio, abs=0.06, rel=0.005
            )


def test_times_are_whole_epochs_of_table_4() -> None:
    for encoding in set(ENCODINGS) - {"fhash"}:
        an_epoch = TABLE_4["bubble"][encoding].minutes / 30
        for decibels in DECIBELS:
            minutes = TABLE_3["bubble"][decibels][encoding][2]
            if minutes is not None:
                assert minutes / an_epoch == pytest.approx(round(minutes / an_epoch), abs=0.1)


def test_adaptive_marching_gains_half_everywhere() -> None:
    gains = [cell.gain for row in TABLE_6.values() for cell in row.values()]
    assert min(gains) == pytest.approx(1.44, abs=0.005)
    assert max(gains) == pytest.approx(1.55, abs=0.005)


def test_notes_name_tables() -> None:
    assert all(set(note.tables) <= {1, 2, 3, 4, 5, 6} for note in NOTES)
    assert len(notes_of(5)) == 3


@pytest.mark.parametrize(
    ("figures", "text"),
    [
        ([2.0], "2"),
        ([1.234], "1.23"),
        ([3.0, 1.0, 2.5], "2.5 (1-3)"),
        ([2.0, 2.0], "2"),
        ([None], NOT_REACHED_TEXT),
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
    assert rows[0]["a|b"] == {
        "median": NOT_REACHED_TEXT,
        "low": 1.0,
        "high": NOT_REACHED_TEXT,
        "seeds": 2,
    }
    assert rows[1] == {"set": "y", "a|b": None}
    assert math.isinf(table.rows[0][1].median)  # type: ignore[union-attr]
