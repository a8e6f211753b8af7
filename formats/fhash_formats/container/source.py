"""Sources of bytes at offsets: a file on disk, or the beginning of a file with an unwritten end."""

from __future__ import annotations

import stat
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from fhash_formats.errors import DamagedFileError, InputError, MissingInputError


@contextmanager
def damage_named(path: object) -> Iterator[None]:
    """A block whose errors about a file begin with its path.

    Other errors that a hostile or unreadable file provokes become DamagedFileError. MemoryError
    passes: the coders refuse sizes that the bytes of a chunk cannot hold, so that only a machine
    with too little memory for a sound file is left as its cause. A user who is told that a file is
    damaged may delete it.
    """
    try:
        yield
    except DamagedFileError as error:
        raise type(error)(f"{path}: {error}") from error
    except (RecursionError, OverflowError, UnicodeError, struct.error) as error:
        raise DamagedFileError(f"{path}: the file is damaged: {type(error).__name__}") from error
    except OSError as error:
        if error.errno is None:
            raise
        raise DamagedFileError(f"{path}: the file cannot be read: {error.strerror}") from error


class Source(Protocol):
    """A source that a container is read from; several threads may call `read`.

    `size` is the number of bytes.
    """

    size: int

    def read(self, offset: int, size: int) -> bytes:
        """Exactly `size` bytes from `offset`; raises DamagedFileError if they are not there."""

    def close(self) -> None:
        """Release the file."""


class FileSource:
    """A regular file on disk; raises MissingInputError or InputError if it cannot be opened."""

    def __init__(self, path: Path) -> None:
        try:
            # The kind is asked before opening, because opening a named pipe waits for a writer.
            if not stat.S_ISREG(path.stat().st_mode):
                raise InputError(f"{path}: not a regular file; a .fhz container is one file")
            self._file = path.open("rb", buffering=0)
        except FileNotFoundError as error:
            raise MissingInputError(f"{path}: no such file") from error
        except OSError as error:
            raise InputError(f"{path}: cannot be opened: {error.strerror}") from error
        self._lock = threading.Lock()
        self.size = self._file.seek(0, 2)

    def read(self, offset: int, size: int) -> bytes:
        """Exactly `size` bytes from `offset`; raises DamagedFileError if they are not there."""
        if offset < 0 or size < 0 or offset + size > self.size:
            raise DamagedFileError(
                f"{size} bytes at offset {offset} are outside the file of {self.size} bytes"
            )
        pieces = []
        # Windows lacks os.pread, so a lock is needed. Decoding takes longer, and is outside it.
        with self._lock:
            if self._file.closed:
                raise InputError("the container is closed")
            self._file.seek(offset)
            while size > 0:
                piece = self._file.read(size)
                if not piece:
                    raise DamagedFileError(
                        "the file was cut short while it was read, "
                        f"{size} bytes from offset {offset} are missing"
                    )
                pieces.append(piece)
                size -= len(piece)
                offset += len(piece)
        return pieces[0] if len(pieces) == 1 else b"".join(pieces)

    def close(self) -> None:
        """Release the file, once no other thread reads it."""
        with self._lock:
            self._file.close()


class CountedSource:
    """A source that counts in `bytes_read` how many bytes were read from it."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._lock = threading.Lock()
        self.size = source.size
        self.bytes_read = 0

    def read(self, offset: int, size: int) -> bytes:
        """Exactly `size` bytes from `offset`; raises DamagedFileError if they are not there."""
        data = self._source.read(offset, size)
        with self._lock:
            self.bytes_read += size
        return data

    def close(self) -> None:
        """Release the file."""
        self._source.close()


class PreviewSource:
    """A container as it will be once its end is written.

    Its bytes are the first `length` bytes of a file, followed by `tail`.
    """

    def __init__(self, begin: FileSource, length: int, tail: bytes) -> None:
        self._begin = begin
        self._length = length
        self._tail = tail
        self.size = length + len(tail)

    def read(self, offset: int, size: int) -> bytes:
        """Exactly `size` bytes from `offset`; raises DamagedFileError if they are not there."""
        if offset < 0 or size < 0 or offset + size > self.size:
            raise DamagedFileError(
                f"{size} bytes at offset {offset} are outside the file of {self.size} bytes"
            )
        from_file = max(0, min(offset + size, self._length) - offset)
        begin = self._begin.read(offset, from_file) if from_file else b""
        start = offset + from_file - self._length
        return begin + self._tail[start : start + size - from_file] if size > from_file else begin

    def close(self) -> None:
        """Release the file."""
        self._begin.close()
