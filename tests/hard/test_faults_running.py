"""Signals, sources that change, and commands at once leave whole outputs and one line."""

from __future__ import annotations

import itertools
import os
import random
import re
import shutil
import signal
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from faulty import COMMANDS, COMPACT, PRESETS, Bench, Server, moments, values
from folders import listing
from reporting import LONG, record
from sources import FORMS

pytestmark = pytest.mark.hard

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
EACH_ALONE = ("render pictures",)
"""Commands with several outputs, each of which is complete or absent by itself."""
COMMITTED = (
    "encode default",
    "encode published",
    "encode several",
    "merge",
    "append",
    "decode npy",
    "decode h5",
    "decode zarr",
    "decode pvd",
    "render png",
    "render gif",
)


def stages(bench: Bench, name: str, noted: Path) -> list[tuple[str, int]]:
    """Return the first and the last report of each stage of a command; in the long set, all
    reports."""
    noted.unlink(missing_ok=True)
    words = [word for word in bench.words(name) if word != "-q"]
    ended = bench.server.run(*words, inject=[("note_stages", noted)])
    assert ended.code == 0, ended.output
    reports_of_all = [
        (line.rpartition(" ")[0], int(line.rpartition(" ")[2]))
        for line in noted.read_text().splitlines()
    ]
    chosen = []
    for _, group in itertools.groupby(dict.fromkeys(reports_of_all), key=lambda report: report[0]):
        reports = list(group)
        chosen += reports if LONG else dict.fromkeys([reports[0], reports[-1]])
    return list(dict.fromkeys(chosen))


@pytest.mark.parametrize("name", COMMANDS)
def test_a_signal_at_each_stage_leaves_the_older_output(
    bench: Bench, name: str, tmp_path: Path
) -> None:
    bench.old(name)
    moments_of_stages = stages(bench, name, tmp_path / "stages")
    assert moments_of_stages or name.startswith("decode vtp")
    if name in [f"encode {preset}" for preset in PRESETS]:
        assert {stage for stage, _ in moments_of_stages} >= {
            "scanning",
            "measuring",
            "training" if "published" in name else "coding",
        }
    for turn, (stage, done) in enumerate(moments_of_stages):
        number = SIGNALS[turn % len(SIGNALS)]
        before = bench.old(name)
        ended = bench.run(name, ("signal_at", stage, done, number))
        assert ended.code == 130, (stage, done, ended.output)
        assert ended.line.startswith("fhash: error: interrupted"), (stage, done)
        now = bench.now()
        kept = {place: data for place, data in now.items() if not place.endswith(".checkpoint")}
        assert kept.keys() == before.keys(), (stage, done)
        # The last report of writing comes when the new file has its name, and the line says so.
        written = stage == "writing" and "was written" in ended.line
        assert written == (stage == "writing" and done > 0), (stage, done, ended.line)
        assert name in EACH_ALONE or written or kept == before, (stage, done)
        assert len(now) == len(kept) or stage in ("training", "coding tables", "measuring"), (
            stage,
            done,
        )
    ended = bench.run(name)  # resumes from the checkpoint, if there is one
    assert ended.code == 0, ended.output
    assert bench.now() == bench.new(name)
    record(
        "a signal at each stage",
        {
            "command": name,
            "stages": len({stage for stage, _ in moments_of_stages}),
            "signals": len(moments_of_stages),
        },
    )


@pytest.mark.parametrize("name", COMMITTED)
def test_a_signal_at_any_operation_leaves_one_of_the_two_outputs(bench: Bench, name: str) -> None:
    count = bench.operations(name)
    for turn, place in enumerate(moments(count)):
        before = bench.old(name)
        ended = bench.run(name, ("at_operation", bench.out, place, -SIGNALS[turn % len(SIGNALS)]))
        now = bench.now()
        if ended.code == 0:  # the signal came after the end of the work
            assert now == bench.new(name), place
            continue
        assert ended.code == 130, (place, ended.output)
        assert ended.line.startswith("fhash: error: interrupted"), place
        kept = {name: data for name, data in now.items() if not name.endswith(".checkpoint")}
        assert kept in (before, bench.new(name)), place
    record(
        "a signal at an operation",
        {"command": name, "operations": count, "signals": len(moments(count))},
    )


STAGES = {
    "default": ["scanning", "selecting", "planning", "coding", "measuring"],
    "published": ["scanning", "selecting", "gathering", "training", "measuring"],
}
HOW = ("vanish", "shrink", "grow", "touch", "other")
QUICK = {
    ("default", "scanning", "other"),
    ("default", "selecting", "touch"),
    ("default", "coding", "shrink"),
    ("default", "measuring", "vanish"),
    ("published", "training", "other"),
}


@pytest.mark.parametrize("form", FORMS)
def test_a_source_that_changes_is_refused(bench: Bench, tmp_path: Path, form: str) -> None:
    module = {"NetCDF": "h5netcdf", "NetCDF 3": "scipy"}.get(form)
    if module:
        pytest.importorskip(module)
    tried = 0
    for preset, stages in STAGES.items():
        for stage in stages:
            for how in HOW:
                if not LONG and (preset, stage, how) not in QUICK:
                    continue
                if form == "a mask" and stage != "selecting":
                    continue  # it is read in this stage only
                check(bench, tmp_path / "source", form, preset, stage, how)
                tried += 1
    assert tried > 0
    record("a source that changes", {"form": form, "changes": tried})


def check(bench: Bench, folder: Path, form: str, preset: str, stage: str, how: str) -> None:
    what = (preset, stage, how)
    for place in (folder / "here", folder / "other"):
        place.mkdir(parents=True)
    other, _ = FORMS[form](folder / "other", values(7))
    target, words = FORMS[form](folder / "here", values(0))
    before = bench.old(f"encode {preset}")
    act = str(other) if how == "other" else how
    if target.is_dir() and how in ("shrink", "grow", "touch"):
        target = target / "c" / "1" / "0" / "0" / "0"  # a chunk
    ended = bench.server.run(
        "encode",
        *words,
        "-o",
        bench.out / "a.fhz",
        "--force",
        *PRESETS[preset],
        inject=[("change_at", stage, 0 if stage == "planning" else 1, target, act)],
    )
    assert ended.code == 2, (what, ended.output)
    assert ended.line.startswith("fhash: error: "), what
    assert re.search("(changed|removed) while it was being read|cannot be read", ended.line), (
        what,
        ended.line,
    )
    assert "please report" not in ended.line
    assert {
        place: data for place, data in bench.now().items() if not place.endswith(".checkpoint")
    } == before, what
    shutil.rmtree(folder)


NOBODY = 65534


@pytest.mark.parametrize("force", [True, False])
@pytest.mark.parametrize(
    "name", ["encode default", "encode published", "decode zarr", "decode pvd"]
)
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


@pytest.mark.parametrize("name", ["encode default", "decode zarr"])
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
    ("encode default", "fhash_codec.features.scan", "row_sums"),
    ("encode default", "fhash_formats.transform.tile", "_coded"),
    ("encode default", "fhash_codec.compact.encode", "code"),
    ("encode default", "fhash_codec.encoding", "measure"),
    ("encode default", "fhash_formats.container.writer", "ContainerWriter._tail"),
    ("encode published", "fhash_codec.paper.fit", "load_checkpoint"),
    ("encode published", "fhash_codec.paper.fit", "train"),
    ("encode published", "fhash_codec.paper.encode", "write_tables"),
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


@pytest.mark.parametrize(
    "name", ["encode default", "encode published", "decode zarr", "render gif"]
)
def test_no_memory_at_any_stage_is_one_line(bench: Bench, name: str) -> None:
    stage = {"encode default": "coding", "encode published": "training"}.get(
        name, "decoding" if "decode" in name else "rendering"
    )
    before = bench.old(name)
    ended = bench.run(name, ("no_memory_at", stage, 1))
    assert (ended.code, ended.line[:27]) == (1, "fhash: error: out of memory"), ended.output
    assert bench.now() == before


def test_the_server_runs_what_the_console_script_runs(server: Server) -> None:
    assert server.run("--version").output.startswith("fhash ")
    assert server.run("nonsense").code == 2
