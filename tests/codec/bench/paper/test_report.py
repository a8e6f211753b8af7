"""The tables and curves beside the cells."""

from __future__ import annotations

from pathlib import Path

import pytest
from made_cells import cell, cells

from fhash_codec.bench.paper import report
from fhash_codec.bench.paper.report import tables_of, write_report
from fhash_formats.errors import MissingDependencyError


def test_tables_and_claims_of_cells() -> None:
    names = [table.name for table in tables_of(cells())]
    assert names[-1] == "claims"
    assert len(set(names)) == len(names)
    assert tables_of([]) == ()


def test_files_are_written(tmp_path: Path) -> None:
    made = [cell("fhash"), cell("hash")]
    files, missing = write_report(made, tables_of(made), tmp_path)
    assert not missing
    assert [path.suffix for path in files] == [".md", ".png"]
    assert sorted(tmp_path.iterdir()) == sorted(files)
    assert "Claims of the paper" in files[0].read_text()
    assert write_report([], [], tmp_path / "gone") == ([], [])


def test_without_matplotlib_a_line_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*words: object) -> None:
        raise MissingDependencyError("needs matplotlib")

    monkeypatch.setattr(report, "plot_convergence", refuse)
    files, missing = write_report([cell()], tables_of([cell()]), tmp_path)
    assert [path.name for path in files] == ["tables.md"]
    assert missing == ["no curves: needs matplotlib"]
