"""Bytes at offsets: a file on disk, or the beginning of one with an end that is not written yet."""

from __future__ import annotations

import stat
import threading
from pathlib import Path
from typing import Protocol

from fhash_formats.errors import DamagedFileError, InputError, MissingInputError


class Source(Protocol):
    """What a container is read from; `read` may be called by several threads."""

    size: int

    def read(self, offset: int, size: int) -> bytes:
        """Exactly `size` bytes from `offset`; raises DamagedFileError if they are not there."""

    def close(self) -> None:
        """Release the file."""


class FileSource:
    """A regular file; raises MissingInputError or InputError if it cannot be opened."""

    def __init__(self, path: Path) -> None:
        try:
            # Asked before opening, because opening a named pipe waits for a writer.
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
        parts = []
        # A lock and not os.pread, which Windows lacks; decoding, the greater part of the time, is outside of it.
        with self._lock:
            if self._file.closed:
                raise InputError("the container is closed")
            self._file.seek(offset)
            while size > 0:
                part = self._file.read(size)
                if not part:
                    raise DamagedFileError(
                        f"the file was cut short while it was read, {size} bytes from offset {offset} are missing"
                    )
                parts.append(part)
                size -= len(part)
                offset += len(part)
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def close(self) -> None:
        """Release the file, once no other thread reads it."""
        with self._lock:
            self._file.close()


class CountedSource:
    """Any source, and how many bytes were read from it."""

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
    """The first `length` bytes of a file followed by `tail`: a container as it will be once its end is written."""

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
