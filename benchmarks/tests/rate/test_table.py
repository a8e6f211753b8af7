"""Cells of the table: there and back, and one name for one question."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fhash_bench.rate.table import RateCell, RateTable, Request, bench_table, load, save
from fhash_formats.errors import InputError
from fhash_formats.series import ArraySeries

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


Field = Callable[..., np.ndarray]


def source(values: np.ndarray):
    @contextmanager
    def opened():
        yield ArraySeries(values)

    return opened


def test_cells_are_measured_once(field: Field, tmp_path: Path) -> None:
    sources = {"wave": source(field()), "other": source(field((2, 3, 9, 9)))}
    options = {"targets": (40.0,), "bounds": (0.05,), "names": ("SZ3", "ZFP")}
    first = bench_table(sources, tmp_path, {"effort": 1}, **options)
    assert first.measured == len(first.cells) == len(list(tmp_path.iterdir())) == 12
    for cell in first.cells:
        assert cell.reached
        assert cell.decode_core_mb_s > 0
        assert cell.region_ms > 0
        assert (cell.tile_price is not None) == (cell.codec == "fhash compact")
    again = bench_table(sources, tmp_path, {"effort": 1}, **options)
    assert again.measured == 0
    assert again.cells == first.cells
    next(tmp_path.glob("wave_ZFP_bound*")).unlink()
    assert bench_table(sources, tmp_path, {"effort": 1}, **options).measured == 1
    changed = {"wave": source(2 * field())}
    assert bench_table(changed, tmp_path, {"effort": 1}, **options, speed=False).measured == 6


def test_a_codec_that_cannot_be_measured_says_why(field: Field, tmp_path: Path) -> None:
    sources = {"line": source(field((1, 1, 1, 64)))}
    table = bench_table(
        sources, tmp_path, {"effort": 1}, targets=(40.0,), bounds=(), names=("SPERR",), speed=False
    )
    cell = table.cells[1]
    assert cell.why.startswith("SPERR ")
    assert f"- not measured: line, SPERR, 40 dB: {cell.why}" in table.markdown()
    assert table.rows() == [(table.cells[0], None)]
    with pytest.raises(InputError, match="peer is 'zip'"):
        bench_table(sources, tmp_path, names=("zip",))


def cell(codec: str, count: int, *, reached: bool = True) -> RateCell:
    return RateCell(
        series="a",
        shape=(1, 2, 3, 4),
        dtype="float32",
        raw_bytes=96,
        codec=codec,
        goal="bound",
        asked=0.01,
        reached=reached,
        bytes=count,
        setting=f"{codec} best",
        decode_core_mb_s=12.345,
        one_tile_bytes=800 if codec.startswith("fhash") else None,
        tile_price=1.25 if codec.startswith("fhash") else None,
    )


def test_the_best_peer_is_the_smallest_that_reached_it() -> None:
    cells = (cell("fhash compact", 1000), cell("A", 900, reached=False), cell("B", 2000))
    table = RateTable(cells=cells, measured=0, machine={}, notes=())
    assert table.rows() == [(cells[0], cells[2])]
    row = table.markdown().splitlines()[2]
    assert row == (
        "| a | 1 % | 1,000 | 800 | 1.25 | B best | 2,000 | 2.000 | - / - | 12.3 / - | - |"
        " - / 12.3 / - |"
    )
    missed = RateTable(
        cells=(cell("fhash compact", 1000, reached=False),), measured=0, machine={}, notes=()
    )
    assert "| 1,000 (missed) | 800 | 1.25 | - | - | - |" in missed.markdown()
