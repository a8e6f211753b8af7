"""Readers hold for mutated files: each is read or refused by one line, within limits."""

from __future__ import annotations

import struct
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

import readers
from reporting import LONG

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="limits on memory and time are those of Linux"
)


PLAIN = b"NRRD0004\ntype: uchar\ndimension: 3\nsizes: 1 1 1\nencoding: raw\n"
GRID = b"object 1 class gridpositions counts 1 1 1\nobject 3 class array type double "
NAMED = struct.pack(">I4sI", 1, b"x\0\0\0", 1)
LARGE = {
    "quotes.nrrd": PLAIN + b'labels: "' + b'\\"' * 60_000 + b"\n\n1",
    "brackets.nrrd": PLAIN + b"space directions: " + b"( " * 60_000 + b"\n\n1",
    "items.dx": GRID + b"items 1 " * 30_000 + b"\n",
    # a variable of 20,000 dimensions
    "many.nc": b"CDF\1"
    + struct.pack(">3I", 0, 10, 1)
    + NAMED
    + struct.pack(">4I", 0, 0, 11, 1)
    + NAMED[:8]
    + struct.pack(">I", 20_000)
    + bytes(80_000)
    + struct.pack(">5I", 0, 0, 1, 4, 200)
    + bytes(400),
}
"""Files whose work once grew with the square of their length."""


def test_hostile_files_are_refused_within_limits() -> None:
    """Each of them once hung, or took gigabytes."""
    batch = [(path.name, path.read_bytes()) for path in sorted(readers.HOSTILE.iterdir())]
    batch += LARGE.items()
    assert len(batch) > 15
    wrong = readers.run_batch(batch)
    assert not wrong, "\n".join(f"{batch[number][0]}: {why}" for number, why in wrong)


def test_the_fuzzer_sees_a_hang_a_crash_and_other_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without this, the fuzzer could find nothing at all."""

    def harmful(path: Path) -> str:
        if path.name == "hang":
            monkeypatch.undo()
            while True:
                pass
        if path.name == "memory":
            bytearray(2 * readers.MEMORY)
        return "several lines\nof a message" if path.name == "text" else ""

    monkeypatch.setattr(readers, "problem", harmful)
    monkeypatch.setattr(readers, "SECONDS", 1)
    batch = [(name, b"") for name in ("fine", "hang", "text", "memory", "fine")]
    wrong = readers.run_batch(batch)
    assert [number for number, _ in wrong] == [1, 2, 3]
    assert "SIGXCPU" in wrong[0][1]
    assert wrong[1][1] == "several lines\nof a message"
    assert "exit code" in wrong[2][1]


def test_the_same_seed_makes_the_same_files() -> None:
    first, second = readers.inputs(3), readers.inputs(3)
    assert [next(first) for _ in range(20)] == [next(second) for _ in range(20)]


@pytest.mark.hard
def test_mutated_files_are_read_or_refused(tmp_path: Path) -> None:
    done, wrong = readers.fuzz(tmp_path, seconds=60 if LONG else 2, seed=1)
    assert done > 100
    assert not wrong, wrong[0].with_name(f"{wrong[0].name}.txt").read_text(encoding="utf-8")
