"""Peers of `fhash bench rate` that are programs: how one is run, and what it must give back.

A program codes one part of a series after the other, each into a file of its own in a temporary
folder. Whatever it does, its temporary files go away, and an error of it is one line.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from fhash_codec.bench.rate.layouts import Values, joined, parts_of
from fhash_formats.errors import InputError

__all__ = ["Coded", "Program", "ProgramVariant", "called", "executable", "folder_of"]

TIMEOUT = 900.0
"""Seconds after which a call of a program is ended."""
SHOWN = 200
"""Letters of a program's message that are shown."""


class Program(Protocol):
    """A codec that is a program: it codes one array into one file."""

    def encode(self, part: Values, file: Path, scale: tuple[float, float], level: float) -> None:
        """Write an array coded.

        part: finite values, two to four axes.
        file: the file to write; others beside it are scratch.
        scale: smallest value of the series, and its range.
        level: quality in dB, as of `Variant.setting`.

        Raises InputError where the program fails.
        """

    def decode(self, file: Path, shape: tuple[int, ...], scale: tuple[float, float]) -> Values:
        """An array of that shape from its file; raises InputError where the program fails."""


@dataclass(frozen=True, kw_only=True)
class Coded:
    """A series as a program coded it.

    Attributes:
        files: of the parts.
        shape: of the series (t, z, y, x).
        scale: smallest value of the series, and its range.
    """

    files: tuple[Path, ...]
    shape: tuple[int, ...]
    scale: tuple[float, float]

    @property
    def bytes(self) -> int:
        """Bytes of all files."""
        return sum(file.stat().st_size for file in self.files)


@dataclass(frozen=True, kw_only=True)
class ProgramVariant:
    """One mode and layout of a program; see `peers.Variant`, whose attributes it shares."""

    peer: str
    mode: str
    layout: str
    goals: tuple[str, ...]
    program: Program
    step: float = 0.0
    lossless: bool = False

    @property
    def name(self) -> str:
        """Description such as "TTHRESH PSNR, a file per series"."""
        return f"{self.peer} {self.mode}, a file per {self.layout}"

    def encode(self, values: Values, data_range: float, level: float, folder: Path) -> Coded:
        """Code values (t, z, y, x) at a level into files in a folder; raises InputError."""
        scale = (float(values.min()), data_range)
        files = []
        for number, part in enumerate(parts_of(values, self.layout)):
            file = folder / f"part-{number}"
            try:
                self.program.encode(np.ascontiguousarray(part), file, scale, level)
            except InputError as error:
                raise InputError(f"{self.name}: {error}") from error
            if not file.is_file():
                raise InputError(f"{self.name}: the program wrote no file")
            files.append(file)
        return Coded(files=tuple(files), shape=values.shape, scale=scale)

    def decode(self, coded: Coded) -> Values:
        """The values (t, z, y, x) of coded files; raises InputError."""
        steps, planes, *plane = coded.shape
        shapes = {
            "frame": (planes, *plane),
            "plane": (steps, *plane),
            "series": coded.shape,
            "folded": (steps * planes, *plane),
            "turned": (steps * planes, *plane),
        }
        try:
            parts = [
                self.program.decode(file, shapes[self.layout], coded.scale) for file in coded.files
            ]
        except InputError as error:
            raise InputError(f"{self.name}: {error}") from error
        return joined(parts, self.layout, coded.shape)


@contextmanager
def folder_of(parent: Path) -> Iterator[Path]:
    """A folder for one coded series, which is removed with all that a program left there."""
    with tempfile.TemporaryDirectory(prefix="peer-", dir=parent) as name:
        yield Path(name)


def executable(name: str, path: str) -> str:
    """The program at a path, or found by its name; raises InputError where there is none."""
    found = shutil.which(path)
    if found is None:
        raise InputError(f"peer {name}: '{path}' is no program that can be run")
    return os.path.abspath(found)


def called(arguments: Sequence[str | Path], timeout: float = TIMEOUT) -> bytes:
    """Run a program on one thread where it can be told so; what it printed on stdout.

    Raises InputError, in one line, where it cannot be run, fails, or takes too long. Then it is
    ended with all that it started.
    """
    words = [str(argument) for argument in arguments]
    name = Path(words[0]).name
    try:
        process = subprocess.Popen(
            words,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )
    except OSError as error:
        raise InputError(f"{name} cannot be run: {error.strerror or error}") from error
    with process:
        try:
            printed, told = process.communicate(timeout=timeout)
        except subprocess.TimeoutExpired as error:
            _end(process)
            raise InputError(f"{name} was ended after {timeout:g} s") from error
        except BaseException:
            _end(process)
            raise
    if process.returncode:
        raise InputError(f"{name} failed with {process.returncode}: {_last_line(told or printed)}")
    return printed


def _end(process: subprocess.Popen[Any]) -> None:
    """End a process and those of its session."""
    with suppress(OSError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()
    process.wait()


def _last_line(told: bytes) -> str:
    """The last line that says something, without letters that a terminal would act on."""
    lines = [line.strip() for line in told.decode("utf-8", "replace").splitlines()]
    last = next((line for line in reversed(lines) if line), "it said nothing")
    return "".join(letter if letter.isprintable() else "?" for letter in last)[:SHOWN]
