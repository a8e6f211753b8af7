"""Programs as peers: what they must give back, and errors in one line."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fhash_codec.bench.rate.layouts import LAYOUTS, Values
from fhash_codec.bench.rate.programs.program import (
    ProgramVariant,
    called,
    executable,
    folder_of,
)
from fhash_formats.errors import InputError

Script = Callable[[str, str], str]
VALUES = np.random.default_rng(0).normal(size=(3, 4, 5, 6)).astype(np.float32)


class Keeper:
    """A codec that keeps everything."""

    def __init__(self, *, writes: bool = True) -> None:
        self.writes = writes
        self.shapes: list[tuple[int, ...]] = []

    def encode(self, part: Values, file: Path, scale: tuple[float, float], level: float) -> None:
        self.shapes.append(part.shape)
        assert part.flags.c_contiguous
        assert scale == (float(VALUES.min()), 2.5)
        if level < 0:
            raise InputError("it is too coarse")
        if self.writes:
            part.tofile(file)

    def decode(self, file: Path, shape: tuple[int, ...], scale: tuple[float, float]) -> Values:
        return np.fromfile(file, np.float32).reshape(shape)


def variant(program: Keeper, layout: str = "series") -> ProgramVariant:
    return ProgramVariant(peer="Keeper", mode="all", layout=layout, goals=(), program=program)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_parts_of_a_layout_come_back(tmp_path: Path, layout: str) -> None:
    program = Keeper()
    coded = variant(program, layout).encode(VALUES, 2.5, 40.0, tmp_path)
    assert coded.bytes == VALUES.nbytes
    np.testing.assert_array_equal(variant(program, layout).decode(coded), VALUES)
    shapes = {
        "frame": [(4, 5, 6)] * 3,
        "plane": [(3, 5, 6)] * 4,
        "series": [(3, 4, 5, 6)],
        "folded": [(12, 5, 6)],
        "turned": [(12, 5, 6)],
    }
    assert program.shapes == shapes[layout]


def test_errors_name_the_variant(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Keeper all, a file per series: it is too coarse"):
        variant(Keeper()).encode(VALUES, 2.5, -1.0, tmp_path)
    with pytest.raises(InputError, match="the program wrote no file"):
        variant(Keeper(writes=False)).encode(VALUES, 2.5, 1.0, tmp_path)


def test_a_program_is_found_or_refused(script: Script, tmp_path: Path) -> None:
    path = script("here", "")
    assert executable("qoz", path) == path
    for missing in (tmp_path / "gone", tmp_path):
        with pytest.raises(InputError, match=r"peer qoz: '.*' is no program that can be run"):
            executable("qoz", str(missing))


def test_what_a_program_says_last_is_the_error(script: Script) -> None:
    assert called([script("fine", "print('out')")]) == b"out\n"
    code = "print('first', file=sys.stderr)\nprint('last \\x1b[1m', file=sys.stderr)\nsys.exit(3)"
    with pytest.raises(InputError, match=r"^bad failed with 3: last \?\[1m$"):
        called([script("bad", code)])
    with pytest.raises(InputError, match="mute failed with 1: it said nothing"):
        called([script("mute", "sys.exit(1)")])
    path = Path(script("broken", ""))
    path.write_text("no program")
    with pytest.raises(InputError, match="broken cannot be run: "):
        called([path])


@pytest.mark.skipif(os.name != "posix", reason="sessions are those of Unix")
def test_a_program_that_takes_too_long_is_ended_with_its_children(
    script: Script, tmp_path: Path
) -> None:
    mark = tmp_path / "mark"
    child = f"import time; time.sleep(1.5); open({str(mark)!r}, 'w')"
    code = f"import subprocess, time\nsubprocess.Popen([sys.executable, '-c', {child!r}])\n"
    with pytest.raises(InputError, match=r"slow was ended after 0.5 s"):
        called([script("slow", code + "time.sleep(60)")], 0.5)
    time.sleep(2)
    assert not mark.exists()


def test_temporary_files_go_away(tmp_path: Path) -> None:
    def fail() -> None:
        with folder_of(tmp_path) as folder:
            (folder / "a").write_text("a")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert list(tmp_path.iterdir()) == []
