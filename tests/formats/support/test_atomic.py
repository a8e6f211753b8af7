"""Outputs are complete or absent: every failure leaves the folder as it was."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path
from typing import Any

import pytest

from fhash_formats.errors import InputError, OutputError, OutputExistsError
from fhash_formats.support.atomic import check_output, replacing, replacing_all


def tree(folder: Path) -> dict[str, bytes | None]:
    """Every path below a folder with its bytes."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }


def store(path: Path, text: str = "old") -> Path:
    (path / "c").mkdir(parents=True)
    (path / "zarr.json").write_text("{}")
    (path / "c" / "0").write_text(text)
    return path


def no_links(*_: Any) -> None:
    raise OSError(errno.EPERM, "Operation not permitted")


@pytest.mark.parametrize("links", [True, False])
@pytest.mark.parametrize("old", [None, "old"])
def test_a_file_takes_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, old: str | None, links: bool
) -> None:
    if not links:
        monkeypatch.setattr(os, "link", no_links)
    path = tmp_path / "out.npy"
    if old is not None:
        path.write_text(old)
    with replacing(path, force=old is not None) as temporary:
        assert temporary.parent == tmp_path
        temporary.write_text("new")
        assert path.exists() is (old is not None)
    assert tree(tmp_path) == {"out.npy": b"new"}


def test_a_directory_takes_its_name(tmp_path: Path) -> None:
    path = store(tmp_path / "out.zarr")
    with replacing(path, force=True, directory=True) as temporary:
        store(temporary, "new")
        assert (path / "c" / "0").read_text() == "old"
    assert tree(tmp_path) == {
        "out.zarr": None,
        "out.zarr/c": None,
        "out.zarr/c/0": b"new",
        "out.zarr/zarr.json": b"{}",
    }
    with replacing(tmp_path / "second.zarr", force=False, directory=True) as temporary:
        store(temporary, "new")
    assert (tmp_path / "second.zarr" / "c" / "0").read_text() == "new"


@pytest.mark.parametrize(
    "error",
    [
        KeyboardInterrupt(),
        ValueError("no"),
        InputError("no"),
        OSError(errno.ENOSPC, "No space left on device"),
    ],
)
@pytest.mark.parametrize("written", [True, False])
@pytest.mark.parametrize("old", [True, False])
@pytest.mark.parametrize("directory", [True, False])
def test_a_failure_changes_nothing(
    tmp_path: Path, error: BaseException, written: bool, old: bool, directory: bool
) -> None:
    path = tmp_path / "out.zarr"
    if old:
        store(path) if directory else path.write_text("old")
    before = tree(tmp_path)
    expected = OutputError if type(error) is OSError else type(error)

    def fail() -> None:
        with replacing(path, force=True, directory=directory) as temporary:
            if written:
                store(temporary) if directory else temporary.write_text("half")
            raise error

    with pytest.raises(expected):
        fail()
    assert tree(tmp_path) == before


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_disk_that_fills_up_at_the_end_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    path = tmp_path / "out.npy"
    path.write_text("old")

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    def save() -> None:
        with replacing(path, force=True) as temporary:
            temporary.write_text("new")

    monkeypatch.setattr(os, step, full)
    with pytest.raises(OutputError, match=r"no space left on .*make room") as caught:
        save()
    assert "\n" not in str(caught.value)
    # os.replace also undoes; the old file is then still under its own name
    assert tree(tmp_path)["out.npy"] == b"old"
    assert not list(tmp_path.glob(".*.partial"))


@pytest.mark.parametrize("links", [True, False])
def test_a_file_that_appears_meanwhile_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, links: bool
) -> None:
    if not links:
        monkeypatch.setattr(os, "link", no_links)
    path = tmp_path / "out.npy"

    def save() -> None:
        with replacing(path, force=False) as temporary:
            temporary.write_text("new")
            path.write_text("somebody else's")

    with pytest.raises(OutputExistsError, match=r"appeared meanwhile.*--force"):
        save()
    assert tree(tmp_path) == {"out.npy": b"somebody else's"}


@pytest.mark.parametrize("directory", [True, False])
def test_a_folder_that_appears_meanwhile_is_kept_even_with_force(
    tmp_path: Path, directory: bool
) -> None:
    path = tmp_path / "out.zarr"

    def save() -> None:
        with replacing(path, force=True, directory=directory) as temporary:
            store(temporary) if directory else temporary.write_text("new")
            path.mkdir()
            (path / "notes.txt").write_text("somebody else's")

    with pytest.raises(OutputError, match="is a directory"):
        save()
    assert tree(tmp_path) == {"out.zarr": None, "out.zarr/notes.txt": b"somebody else's"}


@pytest.mark.parametrize("links", [True, False])
def test_of_several_outputs_all_or_none_take_their_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, links: bool
) -> None:
    if not links:
        monkeypatch.setattr(os, "link", no_links)
    paths = [tmp_path / name for name in ("a", "b", "c")]
    paths[0].write_text("old a")

    def save() -> None:
        with replacing_all(paths, force=True) as temporaries:
            for temporary in temporaries:
                temporary.write_text("new")

    replace, calls = os.replace, []

    def third_fails(source: Path, target: Path) -> None:
        calls.append(target)
        if len(calls) == 3:
            raise OSError(errno.EIO, "Input/output error")
        replace(source, target)

    monkeypatch.setattr(os, "replace", third_fails)
    with pytest.raises(OutputError, match="cannot be written: Input/output error"):
        save()
    assert tree(tmp_path) == {"a": b"old a"}
    monkeypatch.setattr(os, "replace", replace)
    save()
    assert tree(tmp_path) == {"a": b"new", "b": b"new", "c": b"new"}


@pytest.mark.parametrize("directory", [True, False])
@pytest.mark.parametrize("links", [True, False])
def test_another_writer_between_moving_aside_and_replacing_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, directory: bool, links: bool
) -> None:
    if not links:
        monkeypatch.setattr(os, "link", no_links)
    path = tmp_path / "out.zarr"
    store(path) if directory else path.write_text("old")

    def refuse(source: Path, target: Path) -> None:
        monkeypatch.undo()
        if directory:
            store(path, "somebody else's")
        else:
            path.write_text("somebody else's") if not path.exists() else store_file(
                path, "somebody else's"
            )
            raise OSError(errno.EIO, "Input/output error")
        os.rename(source, target)

    monkeypatch.setattr(os, "replace", refuse)

    def save() -> None:
        with replacing(path, force=True, directory=directory) as temporary:
            store(temporary, "new") if directory else temporary.write_text("new")

    with pytest.raises(
        OutputError,
        match="another process wrote it meanwhile" if directory else "Input/output error",
    ):
        save()
    assert [entry.name for entry in tmp_path.iterdir()] == ["out.zarr"]
    assert (path / "c" / "0" if directory else path).read_text() == "somebody else's"


def test_a_folder_that_appears_at_the_last_moment_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, rename = tmp_path / "out.zarr", os.rename

    def late(source: Path, target: Path) -> None:
        store(path, "somebody else's")
        rename(source, target)

    def save() -> None:
        with replacing(path, force=False, directory=True) as temporary:
            store(temporary, "new")
            monkeypatch.setattr(os, "rename", late)

    with pytest.raises(OutputExistsError, match="appeared meanwhile"):
        save()
    assert [entry.name for entry in tmp_path.iterdir()] == ["out.zarr"]
    assert (path / "c" / "0").read_text() == "somebody else's"


def store_file(path: Path, text: str) -> None:
    """Replace a file by another one, as other writers do."""
    other = path.with_name("other")
    other.write_text(text)
    other.rename(path)


def test_an_output_that_exists_stops_all_before_anything_is_written(tmp_path: Path) -> None:
    (tmp_path / "b").write_text("old")
    with (
        pytest.raises(OutputExistsError),
        replacing_all([tmp_path / "a", tmp_path / "b"], force=False),
    ):
        pytest.fail("the block must not run")
    assert tree(tmp_path) == {"b": b"old"}


def test_a_link_is_followed(tmp_path: Path) -> None:
    real = tmp_path / "disk" / "real.npy"
    real.parent.mkdir()
    real.write_text("old")
    link = tmp_path / "out.npy"
    link.symlink_to(real)
    with replacing(link, force=True) as temporary:
        assert temporary.parent == real.parent
        temporary.write_text("new")
    assert link.is_symlink()
    assert real.read_text() == "new"


def test_a_name_as_long_as_the_file_system_takes(tmp_path: Path) -> None:
    path = tmp_path / ("\u00e9" * 125 + ".npy")
    with replacing(path, force=False) as temporary:
        temporary.write_text("new")
    assert path.read_text() == "new"
    with pytest.raises(OutputError, match="cannot be written: File name too long"):
        check_output(tmp_path / ("n" * 300), False)


def test_an_old_output_that_cannot_be_deleted_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = store(tmp_path / "out.zarr")

    def save() -> None:
        with replacing(path, force=True, directory=True) as temporary:
            store(temporary, "new")

    monkeypatch.setattr(shutil, "rmtree", no_links)
    with pytest.raises(
        OutputError, match=r"is written, but the older one could not be deleted; delete .*\.old"
    ):
        save()
    assert (path / "c" / "0").read_text() == "new"


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o444])
@pytest.mark.parametrize("links", [True, False])
def test_the_permissions_of_what_is_replaced_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: int, links: bool
) -> None:
    if not links:
        monkeypatch.setattr(os, "link", no_links)
    path = tmp_path / "out.npy"
    path.write_text("old")
    path.chmod(mode)
    with replacing(path, force=True) as temporary:
        temporary.write_text("new")
    assert (path.read_text(), path.stat().st_mode & 0o777) == ("new", mode)
