"""How a reader reports trouble: one line of what a library said, and a source that changes under it."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from fhash_formats.errors import FhashError, InputError

LONGEST_MESSAGE = 240
"""Characters kept of a library's message; HDF5 and zarr write paragraphs."""


def condense(error: BaseException) -> str:
    """A library's message on one line, cut at a length that a terminal can show; the type's name where it says nothing."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= LONGEST_MESSAGE else text[: LONGEST_MESSAGE - 3] + "..."


@contextmanager
def refusing(what: str) -> Iterator[None]:
    """Turn whatever a library raises on damaged or unsuitable data into an InputError "what: message".

    The catch is wide on purpose: on the same broken file h5py raises OSError, RuntimeError or KeyError, and zarr whatever its codecs do.
    Errors of this project and a lack of memory pass.
    """
    try:
        yield
    except (FhashError, MemoryError):
        raise
    except Exception as error:
        raise InputError(f"{what}: {condense(error)}") from error


@dataclass(frozen=True)
class Stamp:
    """Size, time of change and identity of a file when it was opened: readers check it around every frame."""

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
        """Raise InputError if the file is no longer the one that was opened, so that frames of two states are never mixed."""
        now = Stamp.of(self.path)
        if now != self:
            grown = (
                f"{self.size} bytes before, {now.size} now"
                if now.size != self.size
                else "same size, written again"
            )
            raise InputError(
                f"{self.path} changed while it was being read ({grown}); wait until it is complete and start again"
            )


@dataclass(frozen=True)
class FolderStamp:
    """What is below a folder: number of files, their bytes, and a digest of their names, sizes, times and identities.

    One look at every file, which is too dear around every frame: `Series.check` is for it.
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
                    digest.update(
                        f"{entry.path}\0{state.st_size} {state.st_mtime_ns} {state.st_ino}\0".encode(
                            errors="surrogateescape"
                        )
                    )
        return cls(path, files, size, digest.digest())

    def check(self) -> None:
        """Raise InputError if anything in the folder is no longer what it was when the folder was opened."""
        now = FolderStamp.of(self.path)
        if now != self:
            what = "something in it was written again"
            if (now.files, now.size) != (self.files, self.size):
                what = f"{self.files} files and {self.size} bytes before, {now.files} and {now.size} now"
            raise InputError(
                f"{self.path} changed while it was being read ({what}); wait until it is complete and start again"
            )
