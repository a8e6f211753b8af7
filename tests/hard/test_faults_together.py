"""Two writers of one output, folders without permission to write, and memory that runs out."""

from __future__ import annotations

import os
import random
import shutil
import signal
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from faulty import COMPACT, Bench, listing, moments
from forks import Server
from reporting import LONG, record

NOBODY = 65534


@pytest.mark.parametrize("force", [True, False])
@pytest.mark.parametrize("name", ["encode compact", "encode paper", "decode zarr", "decode pvd"])
def test_two_at_once_leave_the_whole_output_of_one(bench: Bench, name: str, force: bool) -> None:
    chance = random.Random(0)
    first, second = bench.old(name), bench.new(name)
    codes = []
    for _ in range(20 if LONG else 2):
        bench.old(name) if force else bench.empty()
        words = [
            [word for word in bench.words(name, number) if force or word != "--force"]
            for number in (1, 0)
        ]
        running = [bench.server.start(*words[0])]
        time.sleep(chance.uniform(0, 0.02))
        running.append(bench.server.start(*words[1]))
        ended = [one.wait() for one in running]
        codes.append(tuple(one.code for one in ended))
        assert 0 in codes[-1], [one.output for one in ended]
        for one in ended:
            if one.code:
                assert one.code == (1 if force else 2), one.output
                assert one.line.startswith("fhash: error: ")
                assert "meanwhile" in one.line or "exists; use --force" in one.line, one.line
        now = bench.now()
        if name == "decode pvd":  # several outputs, each complete, with the same names
            assert now.keys() == first.keys()
            assert all(data in (first[place], second[place]) for place, data in now.items())
        else:
            assert now in (first, second)
    record(
        "two at once",
        {
            "command": name,
            "force": force,
            "both wrote": codes.count((0, 0)),
            "one was refused": len(codes) - codes.count((0, 0)),
        },
    )


@pytest.mark.parametrize("name", ["encode compact", "decode zarr"])
def test_what_appears_while_it_is_made_is_not_replaced_without_leave(
    bench: Bench, name: str
) -> None:
    """The command is stopped at each operation while another one writes the same output."""
    bench.old(name)
    kept = bench.now()
    refused = 0
    for number in moments(bench.operations(name), 5):
        bench.empty()
        words = [word for word in bench.words(name) if word != "--force"]
        stopped = bench.server.start(
            *words, inject=[("at_operation", bench.out, number, -signal.SIGSTOP)]
        )
        code = None
        while (
            code is None
            and Path(f"/proc/{stopped.pid}/stat").read_text().rpartition(")")[2].split()[0]
            not in "TZ"
        ):
            time.sleep(0.005)
        other = bench.server.run(*[word for word in bench.words(name, 1) if word != "--force"])
        stopped.kill(signal.SIGCONT)
        ended = stopped.wait()
        assert sorted((ended.code, other.code)) == [0, 2], (number, ended.output, other.output)
        if ended.code:
            refused += 1
            assert "exists" in ended.line
            assert bench.now() == kept, number
        else:
            assert "exists" in other.line
            assert bench.now() == bench.new(name), number
    assert refused


@pytest.fixture
def locked(bench: Bench) -> Iterator[Path]:
    """A folder that may be read but not written, with an output in it.

    It lies in the temporary folder, which any user may enter.
    """
    place = Path(tempfile.mkdtemp(prefix="fhash-locked-"))
    place.chmod(0o755)
    shutil.copy(bench.folder / "0" / "in.npy", place / "in.npy")
    shutil.copy(bench.folder / "0" / "run.fhz", place / "run.fhz")
    (place / "out").mkdir()
    (place / "out" / "old.fhz").write_bytes(b"old")
    (place / "out" / "old.npy").write_bytes(b"old")
    (place / "out" / "old.png").write_bytes(b"old")
    (place / "out").chmod(0o555)
    yield place
    (place / "out").chmod(0o755)
    shutil.rmtree(place)


@pytest.mark.parametrize("old", [False, True])
@pytest.mark.parametrize("command", ["encode", "decode", "render"])
def test_a_folder_that_cannot_be_written_is_said_in_one_line(
    bench: Bench, locked: Path, command: str, old: bool
) -> None:
    stem = "old" if old else "new"
    words: dict[str, tuple[object, ...]] = {
        "encode": ("encode", locked / "in.npy", "-o", locked / "out" / f"{stem}.fhz", *COMPACT),
        "decode": ("decode", locked / "run.fhz", "-o", locked / "out" / f"{stem}.npy"),
        "render": (
            "render",
            locked / "run.fhz",
            "-o",
            locked / "out" / f"{stem}.png",
            "--size",
            "20x20",
        ),
    }
    inject = [("user", NOBODY)] if os.geteuid() == 0 else []  # root ignores permissions
    before = listing(locked)
    ended = bench.server.run(*words[command], "--force", inject=inject)
    assert ended.code == 2, ended.output  # before any work
    assert ended.line.startswith("fhash: error: ")
    assert "no permission to write in" in ended.line
    assert listing(locked) == before


@pytest.mark.parametrize("folder", [False, True])
def test_a_source_that_may_not_be_read_is_said_in_one_line(
    bench: Bench, locked: Path, folder: bool
) -> None:
    if os.geteuid() != 0:
        pytest.skip("only root can become somebody who may not read what the test wrote")
    target = locked if folder else locked / "in.npy"
    mode = target.stat().st_mode
    target.chmod(0)
    ended = bench.server.run(
        "encode", locked / "in.npy", "-o", bench.out / "a.fhz", inject=[("user", NOBODY)]
    )
    target.chmod(mode)
    assert ended.code in (1, 2), ended.output
    assert ended.line.startswith("fhash: error: ")
    assert "unexpected" not in ended.line
    assert bench.now() == {}


PLACES = [
    ("encode compact", "fhash_codec.features.scan", "range_and_sum"),
    ("encode compact", "fhash_formats.transform.encoding", "encode_integers"),
    ("encode compact", "fhash_codec.compact.encode", "code"),
    ("encode compact", "fhash_codec.encoding", "measure"),
    ("encode compact", "fhash_formats.container.writer", "ContainerWriter._tail"),
    ("encode paper", "fhash_codec.paper.train", "load_checkpoint"),
    ("encode paper", "fhash_codec.paper.train", "train"),
    ("encode paper", "fhash_codec.paper.encode", "write_tables"),
    ("decode h5", "fhash_codec.volume", "Volume.read_steps"),
    ("decode h5", "fhash_formats.writers.labelled", "_create_hdf5"),
    ("decode zarr", "fhash_formats.writers.labelled", "flush"),
    ("decode nc", "fhash_formats.container.reader", "Container.open"),
    ("decode vtp", "fhash_codec.isosurface", "isosurface"),
    ("render png", "fhash_codec.rendering.renderer", "Renderer.render"),
    ("render gif", "fhash_codec.rendering.image", "Image.to_uint8"),
]


@pytest.mark.parametrize(("name", "module", "place"), PLACES, ids=str)
def test_no_memory_anywhere_is_one_line(bench: Bench, name: str, module: str, place: str) -> None:
    before = bench.old(name)
    ended = bench.run(name, ("no_memory_in", module, place))
    assert ended.code == 1, ended.output
    assert ended.line.startswith("fhash: error: out of memory; ")
    assert bench.now() == before


@pytest.mark.parametrize("name", ["encode compact", "encode paper", "decode zarr", "render gif"])
def test_no_memory_at_any_stage_is_one_line(bench: Bench, name: str) -> None:
    stage = {"encode compact": "coding", "encode paper": "training"}.get(
        name, "decoding" if "decode" in name else "rendering"
    )
    before = bench.old(name)
    ended = bench.run(name, ("no_memory_at", stage, 1))
    assert (ended.code, ended.line[:27]) == (1, "fhash: error: out of memory"), ended.output
    assert bench.now() == before


def test_the_server_runs_what_the_console_script_runs(server: Server) -> None:
    assert server.run("--version").output.startswith("fhash ")
    assert server.run("nonsense").code == 2
