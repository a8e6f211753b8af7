"""Cells of the table: there and back, and one name for one question."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from fhash_codec.bench.rate.cells import RateCell, Request, load, save

CELL = RateCell(
    series="a b.h5",
    shape=(1, 2, 3, 4),
    dtype="float32",
    raw_bytes=96,
    codec="SZ3",
    goal="psnr",
    asked=45.0,
    reached=True,
    bytes=12,
)
REQUEST = Request(series="a b.h5", codec="SZ3", goal="psnr", asked=45.0, settings={"checksum": 1})


def test_a_cell_comes_back(tmp_path: Path) -> None:
    assert load(tmp_path, REQUEST) is None
    save(tmp_path / "cells", REQUEST, CELL)
    assert load(tmp_path / "cells", REQUEST) == CELL
    save(tmp_path / "cells", REQUEST, replace(CELL, bytes=None, why="broken"))
    assert load(tmp_path / "cells", REQUEST) == replace(CELL, bytes=None, why="broken")


def test_what_is_no_cell_is_not_taken(tmp_path: Path) -> None:
    for text in ("", "[]", "{}", '{"series": 1}', "\xff"):
        (tmp_path / REQUEST.filename).write_text(text, encoding="latin-1")
        assert load(tmp_path, REQUEST) is None


def test_another_question_has_another_name() -> None:
    assert REQUEST.filename.startswith("a-b.h5_SZ3_psnr45_")
    others = [
        replace(REQUEST, series="a_b.h5"),
        replace(REQUEST, asked=46.0),
        replace(REQUEST, settings={"checksum": 2}),
    ]
    assert len({request.filename for request in (REQUEST, *others)}) == 4
