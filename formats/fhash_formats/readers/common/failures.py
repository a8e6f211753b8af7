"""Errors of readers: a library's message on one line, and a source that changes while read."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from fhash_formats.errors import FhashError, InputError, MissingDependencyError

LONGEST_MESSAGE = 240
"""Characters kept of a library's message; HDF5 and zarr write paragraphs."""


def condense(error: BaseException) -> str:
    """A library's message on one line, cut to a length that a terminal shows.

    The name of the error's type stands for an empty message.
    """
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= LONGEST_MESSAGE else text[: LONGEST_MESSAGE - 3] + "..."


@contextmanager
def refusing(what: str) -> Iterator[None]:
    """Turn any error of a library on damaged or unsuitable data into an InputError "what: message".

    The catch is wide on purpose: on the same broken file h5py raises OSError, RuntimeError or
    KeyError, and zarr whatever its codecs raise. Errors of this project and a lack of memory pass.
    """
    try:
        yield
    except (FhashError, MemoryError):
        raise
    except Exception as error:
        raise InputError(f"{what}: {condense(error)}") from error


@contextmanager
def naming(source: str) -> Iterator[None]:
    """Put the name of a file before each message of this project that is raised inside.

    Errors of libraries become InputError, as in `refusing`.
    """
    try:
        with refusing(f"{source} cannot be read"):
            yield
    except (InputError, MissingDependencyError) as error:
        if source in str(error):
            raise
        raise type(error)(f"{source}: {error}") from error


@dataclass(frozen=True)
class Stamp:
    """Size, time of change and identity of a file when it was opened.

    Readers check it around every frame.
    """

    path: Path
    size: int
    changed: int
    identity: int

    @classmethod
    def of(cls, path: Path) -> Stamp:
        """The stamp of a file as it is now; raises InputError if it is gone."""
        with refusing(f"{path} cannot be read"):
            found = os.stat(path)
        return cls(path, found.st_size, found.st_mtime_ns, found.st_ino)

    def check(self) -> None:
        """Raise InputError if the file has changed, so that frames of two states never mix."""
        now = Stamp.of(self.path)
        if now != self:
            grown = (
                f"{self.size} bytes before, {now.size} now"
                if now.size != self.size
                else "same size, written again"
            )
            raise InputError(
                f"{self.path} changed while it was being read ({grown}); wait until it is complete"
                " and start again"
            )


@dataclass(frozen=True)
class FolderStamp:
    """Content of a folder: number of files, their bytes, and a digest of names, sizes and times.

    It looks at every file, which is too slow around every frame: `Series.check` uses it.
    """

    path: Path
    files: int
    size: int
    digest: bytes

    @classmethod
    def of(cls, path: Path) -> FolderStamp:
        """The stamp of a folder as it is now; raises InputError if it is gone."""
        files, size, digest = 0, 0, hashlib.sha256()
        with refusing(f"{path} cannot be read"):
            folders = [os.fspath(path)]
            while folders:
                folder = folders.pop()
                with os.scandir(folder) as found:
                    entries = sorted(found, key=lambda entry: entry.name)
                for entry in entries:
                    if entry.is_dir():
                        folders.append(entry.path)
                        continue
                    state = os.stat(entry.path)
                    files, size = files + 1, size + state.st_size
                    figures = f"{state.st_size} {state.st_mtime_ns} {state.st_ino}"
                    digest.update(f"{entry.path}\0{figures}\0".encode(errors="surrogateescape"))
        return cls(path, files, size, digest.digest())

    def check(self) -> None:
        """Raise InputError if anything in the folder has changed since it was opened."""
        now = FolderStamp.of(self.path)
        if now != self:
            what = "something in it was written again"
            if (now.files, now.size) != (self.files, self.size):
                what = (
                    f"{self.files} files and {self.size} bytes before,"
                    f" {now.files} and {now.size} now"
                )
            raise InputError(
                f"{self.path} changed while it was being read ({what}); wait until it is complete"
                " and start again"
            )
