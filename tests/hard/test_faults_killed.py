"""A command that is killed keeps the older output, bit for bit.

The next call gives the result of an undisturbed call and removes what was left.
"""

from __future__ import annotations

import random
import shutil
import signal
import time
from pathlib import Path

import pytest
from faulty import COMMANDS, GROWING, PROFILES, Bench, Listing, moments
from reporting import LONG, record

KILLED = (
    (
        "encode compact",
        "encode paper",
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


@pytest.mark.parametrize("profile", PROFILES)
def test_a_kill_at_a_random_moment_loses_nothing(bench: Bench, profile: str) -> None:
    name = f"encode {profile}"
    eager = [("eager_checkpoints",)] if profile == "paper" else []
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
        {"profile": profile, "kills": kills, "with a checkpoint": checkpoints},
    )


def test_a_kill_while_a_checkpoint_is_written_loses_neither_it_nor_the_output(bench: Bench) -> None:
    name, eager = "encode paper", ("eager_checkpoints",)
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


@pytest.mark.parametrize("name", ["encode compact", "decode zarr"])
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
