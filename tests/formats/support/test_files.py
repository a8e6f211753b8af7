"""Outputs are complete or absent, whatever fails; a full disk is told before the work."""

from __future__ import annotations

import errno
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from folders import listing, store

from fhash_formats.errors import InputError, OutputError, OutputExistsError
from fhash_formats.support import files
from fhash_formats.support.files import (
    OTHERS,
    check_output,
    check_space,
    clear_leftovers,
    deferred_interrupts,
    file_name,
    is_url,
    local_path,
    many_files,
    new_stem,
    open_files,
    replacing,
    replacing_all,
    signals_held,
    without_secrets,
)


def no_links(*_: Any) -> None:
    raise OSError(errno.EPERM, "Operation not permitted")


@pytest.fixture(params=[True, False], ids=["links", "no links"])
def links(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """File systems with and without hard links."""
    if not request.param:
        monkeypatch.setattr(os, "link", no_links)


def save(
    path: Path,
    *,
    force: bool = True,
    directory: bool = False,
    meanwhile: Callable[[], object] = lambda: None,
) -> None:
    """Write "new"; something happens before it takes its name."""
    with replacing(path, force=force, directory=directory) as temporary:
        store(temporary, "new") if directory else temporary.write_text("new")
        meanwhile()


@pytest.mark.usefixtures("links")
@pytest.mark.parametrize("old", [None, "old"])
def test_a_file_takes_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, old: str | None
) -> None:
    path = tmp_path / "out.npy"
    if old is not None:
        path.write_text(old)
    with replacing(path, force=old is not None) as temporary:
        assert temporary.parent == tmp_path
        temporary.write_text("new")
        assert path.exists() is (old is not None)
    assert listing(tmp_path) == {"out.npy": b"new"}


def test_a_directory_takes_its_name(tmp_path: Path) -> None:
    path = store(tmp_path / "out.zarr")
    with replacing(path, force=True, directory=True) as temporary:
        store(temporary, "new")
        assert (path / "c" / "0").read_text() == "old"
    assert listing(tmp_path) == {
        "out.zarr": None,
        "out.zarr/c": None,
        "out.zarr/c/0": b"new",
        "out.zarr/zarr.json": b"{}",
    }
    save(tmp_path / "second.zarr", force=False, directory=True)
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
    before = listing(tmp_path)
    expected = OutputError if type(error) is OSError else type(error)

    def fail() -> None:
        with replacing(path, force=True, directory=directory) as temporary:
            if written:
                store(temporary) if directory else temporary.write_text("half")
            raise error

    with pytest.raises(expected):
        fail()
    assert listing(tmp_path) == before


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_disk_that_fills_up_at_the_end_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    path = tmp_path / "out.npy"
    path.write_text("old")

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, step, full)
    with pytest.raises(OutputError, match=r"no space left on .*make room") as caught:
        save(path)
    assert "\n" not in str(caught.value)
    # os.replace also undoes; the old file is then still under its own name
    assert listing(tmp_path)["out.npy"] == b"old"
    assert not list(tmp_path.glob(".*.partial"))


@pytest.mark.usefixtures("links")
def test_a_file_that_appears_meanwhile_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "out.npy"
    with pytest.raises(OutputExistsError, match=r"appeared meanwhile.*--force"):
        save(path, force=False, meanwhile=lambda: path.write_text("somebody else's"))
    assert listing(tmp_path) == {"out.npy": b"somebody else's"}


@pytest.mark.parametrize("directory", [True, False])
def test_a_folder_that_appears_meanwhile_is_kept_even_with_force(
    tmp_path: Path, directory: bool
) -> None:
    path = tmp_path / "out.zarr"

    def appears() -> None:
        path.mkdir()
        (path / "notes.txt").write_text("somebody else's")

    with pytest.raises(OutputError, match="is a directory"):
        save(path, directory=directory, meanwhile=appears)
    assert listing(tmp_path) == {"out.zarr": None, "out.zarr/notes.txt": b"somebody else's"}


@pytest.mark.usefixtures("links")
def test_of_several_outputs_all_or_none_take_their_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = [tmp_path / name for name in ("a", "b", "c")]
    paths[0].write_text("old a")

    def save_all() -> None:
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
        save_all()
    assert listing(tmp_path) == {"a": b"old a"}
    monkeypatch.setattr(os, "replace", replace)
    save_all()
    assert listing(tmp_path) == {"a": b"new", "b": b"new", "c": b"new"}


@pytest.mark.parametrize("directory", [True, False])
@pytest.mark.usefixtures("links")
def test_another_writer_between_moving_aside_and_replacing_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, directory: bool
) -> None:
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
    told = "another process wrote it meanwhile" if directory else "Input/output error"
    with pytest.raises(OutputError, match=told):
        save(path, directory=directory)
    assert [entry.name for entry in tmp_path.iterdir()] == ["out.zarr"]
    assert (path / "c" / "0" if directory else path).read_text() == "somebody else's"


def test_a_folder_that_appears_at_the_last_moment_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, rename = tmp_path / "out.zarr", os.rename

    def late(source: Path, target: Path) -> None:
        store(path, "somebody else's")
        rename(source, target)

    with pytest.raises(OutputExistsError, match="appeared meanwhile"):
        save(
            path,
            force=False,
            directory=True,
            meanwhile=lambda: monkeypatch.setattr(os, "rename", late),
        )
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
    assert listing(tmp_path) == {"b": b"old"}


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
    save(path, force=False)
    assert path.read_text() == "new"
    with pytest.raises(OutputError, match="cannot be written: File name too long"):
        check_output(tmp_path / ("n" * 300), False)


def test_an_old_output_that_cannot_be_deleted_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = store(tmp_path / "out.zarr")
    monkeypatch.setattr(shutil, "rmtree", no_links)
    with pytest.raises(
        OutputError, match=r"is written, but the older one could not be deleted; delete .*\.old"
    ):
        save(path, directory=True)
    assert (path / "c" / "0").read_text() == "new"


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o444])
@pytest.mark.usefixtures("links")
def test_the_permissions_of_what_is_replaced_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: int
) -> None:
    path = tmp_path / "out.npy"
    path.write_text("old")
    path.chmod(mode)
    save(path)
    assert (path.read_text(), path.stat().st_mode & 0o777) == ("new", mode)


@pytest.mark.parametrize("fails", [False, True])
def test_a_signal_waits_until_the_block_has_ended(fails: bool) -> None:
    done = []

    def block() -> None:
        with signals_held():
            signal.raise_signal(signal.SIGINT)
            done.append("block")
            if fails:
                raise ValueError("the block failed")

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt) as caught:
        block()
    assert done == ["block"]
    assert isinstance(caught.value.__context__, ValueError) is fails
    assert signal.getsignal(signal.SIGINT) is before


def test_a_signal_without_a_python_handler_is_not_held() -> None:
    previous = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        with signals_held():
            assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    finally:
        signal.signal(signal.SIGTERM, previous)


def test_signals_of_other_threads_and_ignored_ones_are_left_alone() -> None:
    seen: list[object] = []

    def block() -> None:
        with signals_held():
            seen.append(signal.getsignal(signal.SIGINT))

    def other() -> None:  # only the main thread may set a handler
        block()
        with deferred_interrupts() as stop:
            seen.extend([signal.getsignal(signal.SIGINT), stop.asked])

    thread = threading.Thread(target=other)
    thread.start()
    thread.join()
    assert seen == [signal.getsignal(signal.SIGINT)] * 2 + [False]
    previous = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        block()
        os.kill(os.getpid(), signal.SIGINT)
        assert seen[3] == signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, previous)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_the_first_signal_asks_and_the_second_interrupts(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with deferred_interrupts() as stop:
        os.kill(os.getpid(), number)
        assert stop.asked
        os.kill(os.getpid(), number)  # the same request, delivered twice
        stop.since -= 2
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)
    assert signal.getsignal(number) is before


def test_an_ignored_signal_asks_for_nothing() -> None:
    previous = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with deferred_interrupts() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not stop.asked
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, previous)


@pytest.mark.parametrize("block", [signals_held, deferred_interrupts])
def test_a_signal_while_handlers_are_put_back_leaves_none_replaced(
    monkeypatch: pytest.MonkeyPatch, block: Callable[[], Any]
) -> None:
    before = {number: signal.getsignal(number) for number in files.STOP_SIGNALS}
    put_back, set_handler = [], signal.signal

    def interrupted(number: int, handler: Any) -> Any:
        previous = set_handler(number, handler)
        if handler is signal.default_int_handler and not put_back:
            put_back.append(number)
            signal.raise_signal(signal.SIGINT)  # comes as soon as its handler is back
        return previous

    def run() -> None:
        with block():
            monkeypatch.setattr(files.signal, "signal", interrupted)

    with pytest.raises(KeyboardInterrupt):
        run()
    monkeypatch.undo()
    assert put_back == [signal.SIGINT]
    assert {number: signal.getsignal(number) for number in files.STOP_SIGNALS} == before


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
    clear_leftovers([tmp_path / "out.zarr"])
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
        elsewhere = foreign.with_name(foreign.name.replace(files._machine(), "0123abcd"))
        foreign.rename(elsewhere)
        clear_leftovers([target])
        assert names(tmp_path) == sorted(path.name for path in [*kept, elsewhere, target])
        process.communicate()
    with monkeypatch.context() as patched:
        patched.setattr(os, "kill", lambda *_: (_ for _ in ()).throw(PermissionError()))
        clear_leftovers([target])
        assert len(names(tmp_path)) == 5
    clear_leftovers([target])
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
    clear_leftovers([tmp_path / "out.npy"])
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
    clear_leftovers([tmp_path / "out.npy", tmp_path / f"{long}2"])
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
    clear_leftovers([target])
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
    clear_leftovers([tmp_path / "no" / "out.npy"])


resource = pytest.importorskip("resource")


@pytest.fixture
def few():
    """A limit of 200 files beside those that are open, the hard one left as it is."""
    limit, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (open_files() + 200, most))
    yield 200
    resource.setrlimit(resource.RLIMIT_NOFILE, (limit, most))


def limits() -> tuple[int, int]:
    return resource.getrlimit(resource.RLIMIT_NOFILE)


def opened(path: Path, count: int) -> int:
    files = []
    try:
        for _ in range(count):
            files.append(path.open("rb"))
        return len(files)
    finally:
        for file in files:
            file.close()


def test_more_files_than_the_limit_can_be_opened(few, tmp_path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"")
    before = limits()
    with pytest.raises(OSError, match="Too many open files"):
        opened(path, 300)
    with many_files(300):
        assert opened(path, 300) == 300
    assert limits() == before


PLACES = [
    ("https://host/run.fhz", None, "run.fhz", "https://host/run.fhz"),
    ("simplecache::https://host/run.fhz", None, "run.fhz", "simplecache::https://host/run.fhz"),
    ("memory:///run.fhz", None, "run.fhz", "memory:///run.fhz"),
    ("https://me:secret@host/a/run.fhz?k=a/b#c", None, "run.fhz", "https://host/a/run.fhz"),
    ("zip://in/run.fhz::s3://me:x@b/a.zip?k", None, "run.fhz", "zip://in/run.fhz::s3://b/a.zip"),
    ("https://host", None, "host", "https://host"),
    ("file:///data/run.fhz", "/data/run.fhz", "run.fhz", "file:///data/run.fhz"),
    ("local:///data/a%20b.fhz", "/data/a%20b.fhz", "a%20b.fhz", "local:///data/a%20b.fhz"),
    ("file://run.fhz", "run.fhz", "run.fhz", "file://run.fhz"),
    ("FILE:///C:/run.fhz", "C:/run.fhz", "run.fhz", "FILE:///C:/run.fhz"),
]
"""A URL, the path that it names, the last name, and what of it may be kept."""


@pytest.mark.parametrize(("place", "path", "name", "shown"), PLACES)
def test_urls(place: str, path: str | None, name: str, shown: str) -> None:
    assert is_url(place)
    assert local_path(place) == (None if path is None else Path(path))
    assert (file_name(place), without_secrets(place)) == (name, shown)
    assert not is_url(Path(place))


@pytest.mark.parametrize(
    "place",
    ["run.fhz", "/data/what?.fhz", "C:\\run.fhz", "C://run.fhz", "a::b.fhz", "12:00://x", ""],
)
def test_paths(place: str) -> None:
    assert not is_url(place)
    assert local_path(place) == Path(place)
    assert (file_name(place), without_secrets(place)) == (Path(place).name, place)


def test_a_limit_that_does_is_left_alone(few) -> None:
    before = limits()
    with many_files(few - OTHERS - 8):  # listing them opens one more
        assert limits() == before
    with pytest.raises(KeyError), many_files(few):
        raise KeyError
    with many_files(1 << 40):
        assert limits()[0] <= before[1] or before[1] == resource.RLIM_INFINITY
    assert limits() == before


@pytest.mark.parametrize(
    ("free", "text", "there"),
    [
        (5_480_000_000, "5.48 GB", "5.48 GB"),
        (1, "2 B", "1 B"),
        (2 * 10**15, "2e+03 TB", "2e+03 TB"),
    ],
)
def test_what_fits_exactly_is_allowed_and_one_byte_more_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, free: int, text: str, there: str
) -> None:
    asked: list[Path] = []
    usage = SimpleNamespace(free=free)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: asked.append(folder) or usage)
    check_space(tmp_path / "run.h5", free)
    message = rf"up to {re.escape(text)} are needed.* has {re.escape(there)} free.*another folder"
    with pytest.raises(OutputError, match=message):
        check_space(tmp_path / "run.h5", free + 1)
    assert asked == [tmp_path, tmp_path]


def test_a_folder_that_is_not_there_is_left_to_the_writer(tmp_path: Path) -> None:
    check_space(tmp_path / "none" / "x.h5", 2**60)
    with pytest.raises(OutputError):
        check_space(tmp_path / "x.h5", 2**60)
