"""Room on disks: refused with figures before any work, on both sides of the free space."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from fhash_formats.errors import OutputError
from fhash_formats.support.files import check_space


def test_what_fits_exactly_is_allowed_and_one_byte_more_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Path] = []

    def usage(folder: Path) -> SimpleNamespace:
        asked.append(folder)
        return SimpleNamespace(free=5_480_000_000)

    monkeypatch.setattr(shutil, "disk_usage", usage)
    check_space(tmp_path / "run.h5", 5_480_000_000)
    with pytest.raises(OutputError, match=r"up to 5.48 GB are needed.* has 5.48 GB free") as error:
        check_space(tmp_path / "run.h5", 5_480_000_001)
    assert "choose another folder" in str(error.value)
    assert asked == [tmp_path, tmp_path]


@pytest.mark.parametrize(("count", "text"), [(999, "999 B"), (1000, "1 kB"), (2e15, "2e+03 TB")])
def test_sizes_are_written_in_units(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count: float, text: str
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=1))
    with pytest.raises(OutputError) as error:
        check_space(tmp_path / "x", int(count))
    assert f"up to {text} are needed" in str(error.value)
    assert "1 B free" in str(error.value)


def test_a_folder_that_is_not_there_is_left_to_the_writer(tmp_path: Path) -> None:
    check_space(tmp_path / "none" / "x.h5", 2**60)
    with pytest.raises(OutputError):
        check_space(tmp_path / "x.h5", 2**60)
