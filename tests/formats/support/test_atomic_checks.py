"""Checks of an output before any work: what may be replaced, and that no source is."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import pytest

from fhash_formats.errors import InputError, OutputError, OutputExistsError
from fhash_formats.support import files as atomic
from fhash_formats.support.files import check_output


def store(path: Path, text: str = "old") -> Path:
    (path / "c").mkdir(parents=True)
    (path / "zarr.json").write_text("{}")
    (path / "c" / "0").write_text(text)
    return path


def file(path: Path) -> Path:
    path.write_text("old")
    return path


def folder(path: Path) -> Path:
    path.mkdir()
    return path


def pipe(path: Path) -> Path:
    os.mkfifo(path)
    return path


@pytest.mark.parametrize(
    ("make", "force", "directory", "error", "message"),
    [
        (
            file,
            False,
            False,
            OutputExistsError,
            r"out exists; use --force \(force=True\) to replace it",
        ),
        (store, False, True, OutputExistsError, r"out exists; use --force"),
        (folder, False, False, OutputError, "out is a directory; give the name of a file"),
        (store, True, False, OutputError, "out is a directory; give the name of a file"),
        (folder, True, True, OutputError, "is a directory but no Zarr store"),
        (pipe, True, False, OutputError, "is not an ordinary file"),
        (
            lambda path: path / "x.npy",
            True,
            False,
            OutputError,
            r"the folder .*out does not exist; create it first",
        ),
        (lambda path: file(path) / "x.npy", True, False, OutputError, r"out is not a folder"),
    ],
)
def test_what_may_not_be_replaced(
    tmp_path: Path, make: Any, force: bool, directory: bool, error: type[Exception], message: str
) -> None:
    path = make(tmp_path / "out")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(error, match=message) as caught:
        check_output(path, force, directory=directory)
    assert "\n" not in str(caught.value)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("make", "directory"),
    [
        (lambda path: path, False),
        (lambda path: path, True),
        (file, False),
        (store, True),
        (file, True),
    ],
)
def test_what_may_be_written_with_force(tmp_path: Path, make: Any, directory: bool) -> None:
    check_output(make(tmp_path / "out"), True, directory=directory)


def test_a_folder_without_permission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        os, "access", lambda *_: False
    )  # the tests may run as root, whom no mode stops
    with pytest.raises(OutputError, match="no permission to write in"):
        check_output(tmp_path / "out", False)


@pytest.mark.parametrize(
    ("code", "message"),
    [
        (errno.ENOSPC, "no space left on the disk"),
        (errno.EDQUOT, "no space left on the disk"),
        (errno.EACCES, "no permission to write in"),
        (errno.EROFS, "no permission to write in"),
        (errno.EISDIR, "is a directory"),
        (errno.ENOTDIR, "is not a folder"),
        (errno.EFBIG, "cannot be written: File too large"),
    ],
)
def test_every_failure_is_one_line(tmp_path: Path, code: int, message: str) -> None:
    error = atomic.explained(tmp_path / "out", OSError(code, os.strerror(code)))
    assert message in str(error)
    assert "\n" not in str(error)
    assert "\n" not in str(atomic.explained(tmp_path / "out", OSError("two\nlines")))


def itself(folder: Path) -> tuple[Path, Path]:
    return file(folder / "a.npy"), folder / "a.npy"


def by_link(folder: Path) -> tuple[Path, Path]:
    (folder / "link.npy").symlink_to(file(folder / "a.npy"))
    return folder / "a.npy", folder / "link.npy"


def link_to_it(folder: Path) -> tuple[Path, Path]:
    return by_link(folder)[::-1]


def by_hard_link(folder: Path) -> tuple[Path, Path]:
    os.link(file(folder / "a.npy"), folder / "b.npy")
    return folder / "a.npy", folder / "b.npy"


def not_there(folder: Path) -> tuple[Path, Path]:
    return folder / "x" / ".." / "a.npy", folder / "a.npy"


def inside(folder: Path) -> tuple[Path, Path]:
    return store(folder / "a.zarr"), folder / "a.zarr" / "c" / "0"


def new_inside(folder: Path) -> tuple[Path, Path]:
    return store(folder / "a.zarr"), folder / "a.zarr" / "run.fhz"


def around(folder: Path) -> tuple[Path, Path]:
    return store(folder / "a.zarr") / "c" / "0", folder / "a.zarr"


@pytest.mark.parametrize("force", [True, False])
@pytest.mark.parametrize(
    ("make", "words"),
    [
        (itself, "is the input itself; choose another name"),
        (by_link, "is the input itself"),
        (link_to_it, "is the input itself"),
        (by_hard_link, "is the input itself"),
        (not_there, "is the input itself"),
        (inside, "lies inside the input"),
        (new_inside, "lies inside the input"),
        (around, "contains the input"),
    ],
)
def test_no_output_is_its_own_input(tmp_path: Path, make: Any, words: str, force: bool) -> None:
    source, path = make(tmp_path)
    for name in (source, str(source)):
        with pytest.raises(InputError, match=words) as caught:
            check_output(path, force, directory=path.is_dir(), sources=[tmp_path / "other", name])
        assert "--force" not in str(caught.value)
    check_output(
        path.with_name("out.npy") if make is not inside else tmp_path / "out",
        False,
        sources=[tmp_path / "a.npy"],
    )


def test_a_link_into_a_folder_that_is_not_there(tmp_path: Path) -> None:
    (tmp_path / "out.npy").symlink_to(tmp_path / "gone" / "out.npy")
    with pytest.raises(
        OutputError,
        match=r"out.npy is a link to .*, and the folder .*gone does not exist; create it",
    ):
        check_output(tmp_path / "out.npy", True)
