"""`fhash bench table`: a table of several series, whose cells are kept."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from click.testing import Result

Fhash = Callable[..., Result]


def test_bench_table_prints_markdown_and_goes_on(fhash: Fhash, data: Path, tmp_path: Path) -> None:
    words = ["bench", "table", data, "--target", "40", "--bound", "0.05", "--peer", "SZ3"]
    words += ["--effort", "1", "-o", tmp_path / "cells", "-q"]
    first = fhash(*words)
    assert (first.exit_code, first.stderr) == (0, "")
    header, line, *rows = first.stdout.splitlines()
    assert header.startswith("| series | quality | fhash, bytes | one tile | tiles cost |")
    assert set(line) == set("| -")
    assert [row.split(" | ")[1] for row in rows] == ["40 dB", "5 %"]
    assert len(list((tmp_path / "cells").glob("*.json"))) == 4
    again = json.loads(fhash(*words, "--json").stdout)
    assert again["measured"] == 0
    assert again["table"] == first.stdout.rstrip("\n")
    assert {cell["codec"] for cell in again["cells"]} == {"fhash compact", "SZ3"}


def test_bench_table_needs_data(refused: Callable[..., str], data: Path) -> None:
    assert "Missing DATA; or give --generated" in refused(2, "bench", "table")
    assert "is no program that can be run" in refused(
        2, "bench", "table", data, "--peer", "tthresh=/nowhere/tthresh"
    )
    assert "and as NAME=PATH tthresh, qoz" in refused(2, "bench", "table", data, "--peer", "zip=a")
    assert "is no peer" in refused(2, "bench", "table", data, "--peer", "tthresh")
