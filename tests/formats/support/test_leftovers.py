"""Leftovers of a killed writer are cleared away by the next one, those of a living one are kept."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fhash_formats.support import leftovers
from fhash_formats.support.atomic import replacing, replacing_all
from fhash_formats.support.leftovers import clear, new_stem


@pytest.fixture
def gone() -> int:
    """The number of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def leftover(target: Path, process: int, kind: str = ".partial", text: str = "half") -> Path:
    path = target.with_name(
        new_stem(target.name).replace(f"-{os.getpid()}-", f"-{process}-") + kind
    )
    path.write_text(text)
    return path


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("name", ["out.npy", "x" * 60 + ".npy", "é" * 100, "a\nb"])
def test_the_next_writer_clears_what_a_killed_one_left(
    tmp_path: Path, gone: int, name: str
) -> None:
    target = tmp_path / name
    leftover(target, gone)
    leftover(target, gone)
    with replacing(target, force=False) as temporary:
        assert names(tmp_path) == []
        temporary.write_text("new")
    assert names(tmp_path) == [name]


def test_a_folder_is_cleared_too(tmp_path: Path, gone: int) -> None:
    half = leftover(tmp_path / "out.zarr", gone)
    half.unlink()
    (half / "c" / "0").mkdir(parents=True)
    clear([tmp_path / "out.zarr"])
    assert names(tmp_path) == []


def test_nothing_of_a_living_writer_is_touched(
    tmp_path: Path, gone: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "out.npy"
    target.write_text("new")
    with subprocess.Popen(
        [sys.executable, "-c", "import sys; sys.stdin.read()"], stdin=subprocess.PIPE
    ) as process:
        kept = [
            leftover(target, process.pid),
            leftover(target, os.getpid()),
            leftover(target, process.pid, ".old"),
        ]
        foreign = leftover(target, gone)
        elsewhere = foreign.with_name(foreign.name.replace(leftovers._machine(), "0123abcd"))
        foreign.rename(elsewhere)
        clear([target])
        assert names(tmp_path) == sorted(path.name for path in [*kept, elsewhere, target])
        process.communicate()
    with monkeypatch.context() as patched:
        patched.setattr(os, "kill", lambda *_: (_ for _ in ()).throw(PermissionError()))
        clear([target])
        assert len(names(tmp_path)) == 5
    clear([target])
    assert names(tmp_path) == sorted([kept[1].name, elsewhere.name, target.name])


def test_a_process_that_nobody_has_waited_for_is_gone(tmp_path: Path) -> None:
    if not Path("/proc/self/stat").exists():
        pytest.skip("only /proc shows zombies")
    process = subprocess.Popen([sys.executable, "-c", ""], stdout=subprocess.PIPE)
    assert process.stdout is not None
    with process.stdout:
        process.stdout.read()  # ends with the process, which is not waited for
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    leftover(tmp_path / "out.npy", process.pid)
    clear([tmp_path / "out.npy"])
    assert names(tmp_path) == []
    process.wait()


def test_nothing_of_another_output_is_touched(tmp_path: Path, gone: int) -> None:
    long = "y" * 50
    for name in ("out", "npy", "out.npy.x", ".out.npy", "aout.npy", f"{long}1"):
        leftover(tmp_path / name, gone)
    for name in (
        ".out.npy.partial",
        ".out.npy.0123abcd.partial",
        "out.npy.partial",
        ".out.npy.old",
    ):
        (tmp_path / name).write_text("somebody else's")
    before = names(tmp_path)
    clear([tmp_path / "out.npy", tmp_path / f"{long}2"])
    assert names(tmp_path) == before


def test_an_output_that_was_moved_aside_comes_back_and_is_not_replaced_without_leave(
    tmp_path: Path, gone: int
) -> None:
    target = tmp_path / "out.zarr"
    aside = leftover(target, gone, ".old")
    aside.unlink()
    aside.mkdir()
    (aside / "zarr.json").write_text("old")
    with pytest.raises(FileExistsError), replacing(target, force=False, directory=True):
        pytest.fail("the block must not run")
    assert names(tmp_path) == ["out.zarr"]
    assert (target / "zarr.json").read_text() == "old"


def test_an_older_output_that_was_replaced_goes(tmp_path: Path, gone: int) -> None:
    target = tmp_path / "out.npy"
    target.write_text("new")
    leftover(target, gone, ".old", "old")
    clear([target])
    assert names(tmp_path) == ["out.npy"]
    assert target.read_text() == "new"


def test_many_outputs_are_cleared_with_one_look_at_their_folder(
    tmp_path: Path, gone: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    targets = [tmp_path / f"a_{number}.vti" for number in range(5)]
    for target in targets:
        leftover(target, gone)
    looks, listing = [], os.listdir
    monkeypatch.setattr(os, "listdir", lambda path: looks.append(path) or listing(path))
    with replacing_all(targets, force=False) as temporaries:
        assert listing(tmp_path) == []
        for temporary in temporaries:
            temporary.write_text("new")
    assert len(looks) == 1


def test_a_folder_that_is_not_there_is_for_others_to_say(tmp_path: Path) -> None:
    clear([tmp_path / "no" / "out.npy"])
