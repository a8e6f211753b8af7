"""Full disks, kills, growing files and little memory leave the older output or the new one."""

from __future__ import annotations

import errno
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from faulty import COMMANDS, GROWING, PRESETS, Bench, moments
from folders import Listing
from injections import BOUND, frame
from reporting import LONG, record

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_formats.series import AXES, Series, index_coordinate

pytestmark = pytest.mark.hard

EACH_ALONE = ("render pictures",)
"""Commands with several outputs, each of which is complete or absent by itself."""


@pytest.mark.parametrize("name", COMMANDS)
def test_a_disk_that_fills_up_at_any_operation_changes_nothing(bench: Bench, name: str) -> None:
    count, failed = bench.operations(name), 0
    for number in moments(count):
        before = bench.old(name)
        ended = bench.run(name, ("at_operation", bench.out, number, errno.ENOSPC))
        now = bench.now()
        if ended.code == 0:  # the operation was not needed, such as a link
            assert now == bench.new(name), (number, ended.output)
            continue
        failed += 1
        assert ended.code == 1, (number, ended.output)
        assert ended.line.startswith("fhash: error: "), number
        assert "no space left on the disk" in ended.line, number
        if name in EACH_ALONE:
            assert now.keys() == before.keys()
            assert all(
                data in (before[place], bench.new(name)[place]) for place, data in now.items()
            ), number
        else:
            assert now == before, number
    assert failed
    record(
        "a full disk",
        {"command": name, "operations": count, "tried": len(moments(count)), "refused": failed},
    )


@pytest.mark.parametrize("name", COMMANDS)
def test_a_file_that_may_not_become_so_long_changes_nothing(bench: Bench, name: str) -> None:
    before = bench.old(name)
    longest = max(len(data) for data in bench.new(name).values() if data is not None)
    for size in {
        longest - 1,
        longest // 2,
        min(700, longest // 4),
    }:  # larger than the message, which goes to a file, too
        ended = bench.run(name, ("file_limit", size))
        assert ended.code == 1, (size, ended.output)
        assert ended.line.startswith("fhash: error: "), size
        assert "cannot be written: File too large" in ended.line, (size, ended.line)
        if name not in EACH_ALONE:
            assert bench.now() == before, size
        before = bench.old(name)


STEPS = 7
LAYER = 2
KINDS = {"a full disk": errno.ENOSPC, "Ctrl-C": -signal.SIGINT, "kill -9": -signal.SIGKILL}


def steps_of(path: Path) -> int:
    """Return the number of steps of a file that grows, and check all of them."""
    with fhash_codec.open(path) as volume:
        volume.verify()
        values = volume[...]
    expected = np.stack([frame(step) for step in range(len(values))])
    np.testing.assert_allclose(values, expected, atol=BOUND)
    return len(values)


def operations(bench: Bench, *words: object) -> int:
    counted = bench.folder / "counted"
    ended = bench.server.run(*words, inject=[("at_operation", bench.out, 0, 0, counted)])
    assert ended.code == 0, ended.output
    return int(counted.read_text())


@pytest.mark.parametrize("resumes", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_a_file_that_grows_has_whole_layers_whatever_happens(
    bench: Bench, tmp_path: Path, kind: str, resumes: bool
) -> None:
    path, old = bench.out / "a.fhz", tmp_path / "old.fhz"
    words = ("writer", path, STEPS, "yes" if resumes else "no")
    if resumes:
        assert bench.server.run("writer", old, 2 * LAYER, "no").code == 0
    else:
        old.write_bytes((bench.folder / "0" / "run.fhz").read_bytes())
    shutil.copy(old, path)
    count, lengths = operations(bench, *words), set()
    for number in moments(count, 8):
        bench.empty()
        shutil.copy(old, path)
        ended = bench.server.run(*words, inject=[("at_operation", bench.out, number, KINDS[kind])])
        if ended.code == 0:  # the operation was not needed, such as a link
            assert steps_of(path) == STEPS
            continue
        if kind != "kill -9":
            assert ended.code == {"a full disk": 1, "Ctrl-C": 130}[kind], ended.output
            assert ended.line.startswith("fhash: error: "), number
            assert [place.name for place in bench.out.iterdir()] == ["a.fhz"], number
        if path.read_bytes() != old.read_bytes():
            lengths.add(steps_of(path))
        assert bench.server.run("writer", path, STEPS, "no").code == 0
        assert [place.name for place in bench.out.iterdir()] == ["a.fhz"], number
        assert steps_of(path) == STEPS
    # Ctrl-C keeps what was appended, a shorter last layer included.
    assert lengths <= set(range(1, STEPS + 1))
    assert kind == "Ctrl-C" or all(n % LAYER == 0 or n == STEPS for n in lengths)
    record("a file that grows", {"kind": kind, "resumes": resumes, "operations": count})


@pytest.mark.parametrize("how", ["vanish", "shrink", "other"])
@pytest.mark.parametrize("name", ["merge", "append", "encode several"])
def test_an_input_that_changes_while_it_is_read_changes_nothing(
    bench: Bench, tmp_path: Path, name: str, how: str
) -> None:
    before = bench.old(name)
    stage, source = {
        "merge": ("merging", bench.folder / "0" / "part2.fhz"),
        "append": ("appending", bench.folder / "more.npy"),
        "encode several": ("coding", bench.folder / "0" / "several.h5"),
    }[name]
    kept = tmp_path / "kept"
    shutil.copy(source, kept)
    other = tmp_path / "other"
    other.write_bytes(bytes(reversed(kept.read_bytes())))
    try:
        done = 0 if name == "merge" else 1
        act = str(other) if how == "other" else how
        ended = bench.run(name, ("change_at", stage, done, source, act))
    finally:
        shutil.copy(kept, source)
    now = bench.now()
    if ended.code == 0:  # all of it had been read, or the file is open although it has no name
        assert now == bench.new(name)
        return
    assert ended.code in (2, 4), ended.output
    assert ended.line.startswith("fhash: error: "), ended.output
    assert now == before


KILLED = (
    (
        "encode default",
        "encode published",
        "encode several",
        "merge",
        "append",
        "decode h5",
        "decode zarr",
        "decode vti",
        "render png",
        "render pictures",
    )
    if not LONG
    else tuple(COMMANDS)
)


def leftovers(now: Listing) -> set[str]:
    """Return the names of the temporary files in a folder."""
    return {
        place.split("/")[0] for place in now if place.split("/")[0].endswith((".partial", ".old"))
    }


def check_killed(bench: Bench, name: str, before: Listing) -> None:
    """Check the folder after a kill: each output is old or new, all else is temporary files."""
    now, after = bench.now(), bench.new(name)
    extra = leftovers(now)
    kept = {place: data for place, data in now.items() if place.split("/")[0] not in extra}
    if kept.keys() != before.keys():
        # A folder is replaced by two renames. Between them it has its temporary name.
        aside = [place for place in extra if place.endswith(".old")]
        assert name == "decode zarr"
        assert not kept
        assert len(aside) == 1
        assert {
            "a.zarr" + place.removeprefix(aside[0]): data
            for place, data in now.items()
            if place.startswith(aside[0])
        } == before
    elif name in ("decode vti", "decode vtr", "decode pvd", "decode raw", "render pictures"):
        assert all(
            data in (before[place], after[place]) for place, data in kept.items()
        )  # several outputs, each of them complete
    else:
        assert kept in (before, after)


@pytest.mark.parametrize("name", KILLED)
def test_a_kill_at_any_operation_loses_nothing_and_the_next_call_clears_up(
    bench: Bench, name: str
) -> None:
    killed = moments(bench.operations(name))
    left = 0
    for number in killed:
        before = bench.old(name)
        ended = bench.run(name, ("at_operation", bench.out, number, -signal.SIGKILL))
        assert (ended.code, ended.output) == (-signal.SIGKILL, ""), number
        check_killed(bench, name, before)
        left += bool(leftovers(bench.now()))
        if name in GROWING:  # counts of coefficients are a share where steps are dropped
            shutil.copy(bench.folder / "grown.fhz", bench.out / "a.fhz")
        ended = bench.run(name)
        assert ended.code == 0, (number, ended.output)
        assert bench.now() == bench.new(name), number
    assert left
    record(
        "kill -9 at an operation", {"command": name, "kills": len(killed), "left something": left}
    )


def test_a_folder_that_was_moved_aside_comes_back_before_anything_else(bench: Bench) -> None:
    """Without --force, the user is told that an output exists, even if the killed command had just
    moved it away."""
    name, seen = "decode zarr", 0
    for number in range(bench.operations(name), 0, -1):
        before = bench.old(name)
        bench.run(name, ("at_operation", bench.out, number, -signal.SIGKILL))
        if "a.zarr" not in bench.now():
            seen += 1
            ended = bench.run(name, force=False)
            assert ended.code == 2
            assert "exists; use --force" in ended.line
            assert bench.now() == before
        elif seen:
            break
    assert seen


@pytest.mark.parametrize("preset", PRESETS)
def test_a_kill_at_a_random_moment_loses_nothing(bench: Bench, preset: str) -> None:
    name = f"encode {preset}"
    eager = [("eager_checkpoints",)] if preset == "published" else []
    begun = time.monotonic()
    before = bench.old(name)
    assert bench.run(name, *eager).code == 0
    seconds = time.monotonic() - begun
    chance = random.Random(0)
    kills = finished = checkpoints = 0
    while kills < (50 if LONG else 4) and finished < 1000:
        before = bench.old(name)
        running = bench.start(name, *eager)
        time.sleep(chance.uniform(0, 0.8 * seconds))
        running.kill(signal.SIGKILL)
        if running.wait().code != -signal.SIGKILL:
            finished += 1
            continue
        kills += 1
        now = bench.now()
        assert now["a.fhz"] in (before["a.fhz"], bench.new(name)["a.fhz"])
        assert all(
            place == "a.fhz" or place.endswith((".partial", ".old", ".checkpoint")) for place in now
        )
        checkpoints += any(place.endswith(".checkpoint") for place in now)
        ended = bench.run(name, *eager)  # resumes from the checkpoint, if there is one
        assert ended.code == 0, ended.output
        assert bench.now() == bench.new(name)
    assert kills >= 4
    record(
        "kill -9 at a random moment",
        {"preset": preset, "kills": kills, "with a checkpoint": checkpoints},
    )


def test_a_kill_while_a_checkpoint_is_written_loses_neither_it_nor_the_output(bench: Bench) -> None:
    name, eager = "encode published", ("eager_checkpoints",)
    counted = bench.folder / "operations"
    before = bench.old(name)
    assert bench.run(name, eager, ("at_operation", bench.out, 0, 0, counted)).code == 0
    killed = resumed = 0
    for number in moments(int(counted.read_text()), 12):
        bench.old(name)
        ended = bench.run(name, eager, ("at_operation", bench.out, number, -signal.SIGKILL))
        if ended.code == 0:  # the number of checkpoints depends on how long saving takes
            continue
        killed += 1
        assert ended.code == -signal.SIGKILL, ended.output
        assert bench.now()["a.fhz"] in (before["a.fhz"], bench.new(name)["a.fhz"])
        resumed += any(place.endswith(".checkpoint") for place in bench.now())
        ended = bench.run(name)
        assert ended.code == 0, ended.output
        assert bench.now() == bench.new(name), number
    assert killed >= 4
    assert resumed
    record("kill -9 while checkpoints are written", {"kills": killed, "with a checkpoint": resumed})


@pytest.mark.parametrize("name", ["encode default", "decode zarr"])
def test_a_living_writer_is_not_disturbed_by_another(bench: Bench, name: str) -> None:
    for number in moments(bench.operations(name), 4):
        bench.old(name)
        stopped = bench.start(name, ("at_operation", bench.out, number, -signal.SIGSTOP))
        wait_stopped(stopped.pid)
        mine = leftovers(bench.now())
        other = bench.server.run(*bench.words(name, 1))
        assert mine == leftovers(bench.now())
        stopped.kill(signal.SIGCONT)
        ended = stopped.wait()
        assert other.code == 0, other.output
        if ended.code == 0:
            assert bench.now() in (bench.new(name), bench.old(name)), (
                number
            )  # the writer that took the name last
        else:  # another folder took the name after this writer moved the older one aside
            assert (ended.code, name) == (1, "decode zarr"), ended.output
            assert "another process wrote it meanwhile" in ended.line
            assert bench.now() == bench.old(name), number


def wait_stopped(pid: int) -> None:
    """Wait until a process has stopped."""
    for _ in range(2000):
        if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "T":
            return
        time.sleep(0.005)
    raise AssertionError("it did not stop")


MIB = 2**20
LIMITS = (
    (1, 2, 4, 8, 12, 16, 20, 24, 28, 32, 40, 48, 64, 80, 96, 128, 192, 256, 400)
    if LONG
    else (2, 256)
)
"""Data in MiB that a command may use beyond what the interpreter and the libraries use already.

The last one suffices: the series may be coded as one tile of 3 M vertices.
"""
SHAPE = (12, 48, 64, 80)


@pytest.fixture(scope="module")
def larger(_bench: Bench) -> Path:
    """A container whose decoding needs memory beyond that of the libraries."""
    place = _bench.folder / "larger"
    place.mkdir()
    field = np.random.default_rng(0).standard_normal(SHAPE).astype(np.float32).cumsum(3)
    np.save(place / "in.npy", field)
    fhash_codec.encode(field, place / "run.fhz", EncodeConfig(effort=1))
    return place


COMMANDS = {
    "encode": ("encode", "{in}", "--effort", "1", "-o", "a.fhz"),
    "decode npy": ("decode", "{run}", "-o", "a.npy"),
    "decode raw": ("decode", "{run}", "-o", "a.raw"),
    "decode vti": ("decode", "{run}", "--t", "1", "-o", "a.vti"),
    "render": ("render", "{run}", "--size", "200x200", "-o", "a.png"),
    "verify": ("verify", "{run}"),
}
"""Commands by name. HDF5, OpenBLAS and scikit-image end the process without memory and are left
out."""


@pytest.mark.parametrize("name", COMMANDS)
def test_any_limit_gives_a_result_or_one_line(bench: Bench, larger: Path, name: str) -> None:
    taken = data_of(bench.server.process.pid)
    places = {"in": str(larger / "in.npy"), "run": str(larger / "run.fhz")}
    words = [word.format_map(places) for word in COMMANDS[name]]
    words[-1:] = [str(bench.out / words[-1])] if "-o" in words else words[-1:]
    done = died = 0
    for limit in LIMITS:
        bench.empty()
        running = bench.server.start(*words, inject=[("memory_limit", taken + limit * MIB)])
        timer = threading.Timer(60, running.kill, [signal.SIGKILL])
        timer.start()
        ended = running.wait()
        timer.cancel()
        if ended.code == 0:
            done += 1
            continue
        if LONG and ended.code in (-signal.SIGSEGV, -signal.SIGKILL):
            # CPython 3.11: a thread without memory to start dies, and `Thread.start` sometimes
            # waits for it forever.
            died += 1
            continue
        assert ended.code == 1, (limit, ended.output)
        assert ended.line.startswith("fhash: error: "), limit
        assert "memory" in ended.line, limit
        assert "please report" not in ended.line, limit
        assert bench.now() == {}, limit
    assert done
    assert died <= 3
    record(
        "little memory",
        {
            "command": name,
            "limits": len(LIMITS),
            "done": done,
            "the interpreter died or hung": died,
        },
    )


def data_of(pid: int) -> int:
    """Return the bytes of data of a process."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmData"))


class Streamed(Series):
    """A moving wave that is made frame by frame and never held in memory."""

    def __init__(self, shape: tuple[int, int, int, int]) -> None:
        self.source, self.name, self.units, self.attributes = "streamed", "wave", "", {}
        self.dtype, self.shape = np.dtype(np.float32), shape
        self.coords = {
            axis: index_coordinate(axis, length) for axis, length in zip(AXES, shape, strict=True)
        }
        z, y, x = np.meshgrid(
            *(np.linspace(0, 6, n, dtype=np.float32) for n in shape[1:]), indexing="ij", sparse=True
        )
        self.still, self.moving = np.sin(3 * x) * np.cos(2 * y), np.cos(z + y)

    def read(self, step: int) -> np.ndarray[Any, Any]:
        self.require_step(step)
        return np.ascontiguousarray(
            self.still + np.float32(np.sin(0.2 * step)) * self.moving, dtype=np.float32
        )


@pytest.fixture(scope="module")
def huge(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, int, float]]:
    """A container of a series of 3 GiB, the bytes of the series, and the largest error."""
    path = tmp_path_factory.mktemp("huge") / "wave.fhz"
    series = Streamed((48, 256, 256, 256))
    raw = 4 * int(np.prod(series.shape))
    begun = time.perf_counter()
    figures = fhash_codec.encode(series, path, EncodeConfig(effort=1, psnr=40))
    record(
        "a large series",
        {
            "bytes": raw,
            "container": figures["bytes"],
            "psnr": figures["psnr"],
            "seconds": time.perf_counter() - begun,
        },
    )
    yield path, raw, figures["max_abs_error"]
    path.unlink()


LIMITED = """
import resource, sys
resource.setrlimit(resource.RLIMIT_AS, (2**30, 2**30))
from fhash_cli.main import main
sys.argv = ["fhash", *sys.argv[2:]]
try:
    main()
finally:
    # not getrusage, which begins with the parent's peak
    lines = open("/proc/self/status").read().splitlines()
    open(PEAK, "w").write(next(line.split()[1] for line in lines if line.startswith("VmHWM")))
"""


@pytest.mark.skipif(not LONG, reason="minutes, and 3 GiB of disk: FHASH_HARD=1")
@pytest.mark.parametrize("suffix", ["raw", "npy", "h5", "zarr", "nc", "vti", "statistics", "png"])
def test_a_large_file_is_decoded_within_one_gibibyte(
    huge: tuple[Path, int, float], tmp_path: Path, suffix: str
) -> None:
    path, raw, error = huge
    output, peak = tmp_path / f"out.{suffix}", tmp_path / "peak"
    words = ["decode", str(path), "-q"] + ([] if suffix == "statistics" else ["-o", str(output)])
    if suffix == "png":
        words = ["render", str(path), "--size", "300x300", "-o", str(output), "-q"]
    script = LIMITED.replace("PEAK", repr(str(peak)))
    environment = {
        **os.environ,
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "FHASH_THREADS": "2",
    }
    done = subprocess.run(
        [sys.executable, "-c", script, "-", *words],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )
    if (
        suffix == "zarr" and done.returncode
    ):  # its threads reserve much more than they use; the limit is on reserved memory
        assert done.returncode in (1, 4)
        assert len(done.stderr.splitlines()) == 1
        assert "memory" in done.stderr
        assert not output.exists()
        return
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    record(
        "a large decode within 1 GiB",
        {"output": suffix, "bytes": raw, "peak resident bytes": 1024 * int(peak.read_text())},
    )
    if suffix in ("raw", "npy"):
        offset = output.stat().st_size - raw
        series = Streamed((48, 256, 256, 256))
        for step in (0, 17, 47):
            count = int(np.prod(series.shape[1:]))
            frame = np.fromfile(output, np.float32, count, offset=offset + step * 4 * count)
            assert np.abs(frame.reshape(series.shape[1:]) - series.read(step)).max() <= error
