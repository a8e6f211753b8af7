"""Faults while a file grows: it always holds whole layers, those that were written before.

Each operation on files fails as on a full disk, or the process gets a signal or `kill -9` there.
The file is then the older one, or a complete file of the first layers; nothing is left beside it
once a further process has written.
"""

from __future__ import annotations

import errno
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
from faulty import Bench, moments
from injections import BOUND, frame
from reporting import record

import fhash_codec

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
