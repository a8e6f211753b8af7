"""The files of a report: all or none, and never among other files unless asked."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from fhash_codec.cost import files
from fhash_codec.cost.files import NAMES, check_folder, write_report
from fhash_codec.cost.results import CostReport
from fhash_formats.errors import (
    InputError,
    MissingDependencyError,
    OutputError,
    OutputExistsError,
)


@pytest.fixture(autouse=True)
def drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """A picture that is quick to draw."""
    monkeypatch.setattr(files, "plot", lambda report, path: path.write_bytes(b"PNG"))


def test_page_picture_and_json(report: CostReport, tmp_path: Path) -> None:
    paths = write_report(report, tmp_path / "new")
    assert sorted(path.name for path in paths) == sorted(NAMES)
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == sorted(NAMES)
    assert json.loads((tmp_path / "new" / "cost.json").read_text())["seconds"] == 3.0
    with pytest.raises(OutputExistsError, match="holds files"):
        write_report(report, tmp_path / "new")
    write_report(report, tmp_path / "new", force=True)


def test_other_files_stay(report: CostReport, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("kept")
    with pytest.raises(OutputExistsError, match="--force"):
        check_folder(tmp_path, False)
    write_report(report, tmp_path, force=True)
    assert (tmp_path / "mine.txt").read_text() == "kept"


def test_a_failure_leaves_nothing(
    report: CostReport, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(report: CostReport, path: Path) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(files, "plot", fail)
    with pytest.raises(KeyboardInterrupt):
        write_report(report, tmp_path / "new")
    assert list(tmp_path.iterdir()) == []


def test_unsuitable_folders_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError, match="is a file"):
        check_folder(tmp_path / "file", True)
    with pytest.raises(OutputError, match="does not exist"):
        check_folder(tmp_path / "no" / "where", False)
    (tmp_path / "data.zarr").mkdir()
    with pytest.raises(InputError, match="input"):
        check_folder(tmp_path / "data.zarr", True, (tmp_path / "data.zarr",))


@pytest.mark.parametrize("name", ["plotly.offline", "matplotlib.figure"])
def test_a_missing_library_is_told_at_the_start(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'fhash\[bench\]'"):
        check_folder(tmp_path / "new", False)
