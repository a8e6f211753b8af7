"""`fhash bench paper`: parameters, cells of one's own data, and resuming."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result

from fhash_formats.series import Series

Fhash = Callable[..., Result]
FEW = [
    "--quick", "--epochs", "1", "--no-latency", "--no-files", "-q", "--feature", "interval:6:99",
]  # fmt: skip
"""Options that make a training a matter of milliseconds."""


@pytest.fixture(autouse=True)
def no_curves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fhash_bench.paper.report.plot_convergence", lambda *_: [])


def test_parameters_are_printed_to_the_unit(fhash: Fhash, tmp_path: Path) -> None:
    result = fhash("bench", "paper", "--parameters", "-o", tmp_path / "none")
    assert (result.exit_code, result.stderr) == (0, "")
    for count in ("125,829,120", "141,557,760", "80,945,280", "112,857,968"):
        assert count in result.stdout
    assert not (tmp_path / "none").exists()


def test_cells_of_own_data_are_resumed(fhash: Fhash, data: Path, tmp_path: Path) -> None:
    words = ["bench", "paper", data, *FEW, "--protocol", "equal", "-o", tmp_path / "cells"]
    words += ["--encoding", "hash", "--encoding", "tcnn"]
    first = fhash(*words)
    assert first.exit_code == 0, first.stderr
    assert "Claims of the paper" in first.stdout
    assert "not measured: tcnn: " in first.stdout
    (path,) = (tmp_path / "cells").glob("*.json")
    before = path.stat().st_mtime_ns
    cell = json.loads(path.read_text())
    assert (cell["data_set"], cell["encoding"]) == ("tiny.h5", "hash")
    assert fhash(*words).stdout == first.stdout
    assert path.stat().st_mtime_ns == before


def test_files_are_asked_for_by_data_set(
    fhash: Fhash, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def measure(
        name: str, series: Series, feature: str, **_: object
    ) -> tuple[list[object], list[str]]:
        asked.append((name, len(series.shape), feature))
        return [], ["SZ3 not measured"]

    monkeypatch.setattr("fhash_bench.paper.files.measure_files", measure)
    words = [word for word in FEW if word != "--no-files"]
    words += ["--encoding", "fhash", "--protocol", "equal", "-o", str(tmp_path / "cells")]
    result = fhash("bench", "paper", data, *words)
    assert result.exit_code == 0, result.stderr
    assert asked == [("tiny.h5", 4, "interval:6:99")]
    assert "SZ3 not measured" in result.stdout


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--protocol", "fair"], "'fair' is no protocol; allowed: published, released,"),
        (["--encoding", "mhe"], "'mhe' is no encoding; allowed: dense,"),
        (["--data-set", "argon"], "'argon' is no data set; allowed: flame,"),
        (["--var", "x"], "--var is for DATA"),
        (["--feature", "blob", "--quick"], "feature 'blob' is not known"),
    ],
)
def test_unsuitable_words_are_refused(
    refused: Callable[..., str], words: list[str], line: str, tmp_path: Path
) -> None:
    assert line in refused(2, "bench", "paper", "-q", "-o", tmp_path / "none", *words)
