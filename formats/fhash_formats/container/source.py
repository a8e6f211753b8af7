"""Sources of bytes at offsets: a file on disk or an open one, or a file with an unwritten end."""

from __future__ import annotations

import io
import os
import stat
import struct
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Protocol

from fhash_formats.errors import DamagedFileError, InputError, MissingInputError
from fhash_formats.support.fork_lock import ForkLock

Range = tuple[int, int]
"""Offset and number of bytes, at least 1."""


@dataclass(frozen=True, kw_only=True)
class Request:
    """Bytes that are asked for at once.

    Attributes:
        start, stop: offsets of the first byte and of the one after the last.
        ranges: those that the bytes were asked for, by offset.
    """

    start: int
    stop: int
    ranges: tuple[Range, ...]

    @property
    def place(self) -> Range:
        """The range that all others lie in."""
        return self.start, self.size

    @property
    def size(self) -> int:
        """Number of bytes."""
        return self.stop - self.start


def merged(ranges: Iterable[Range], gap: int, most: int) -> list[Request]:
    """Requests for all ranges, by offset; each range lies in one request.

    Args:
        ranges: in any order; they may repeat and overlap.
        gap: bytes between two ranges up to which both are in one request.
        most: bytes of a request of several ranges.
    """
    requests: list[Request] = []
    start = stop = 0
    group: list[Range] = []
    for offset, size in sorted(set(ranges)):
        end = max(stop, offset + size)
        if group and (offset - stop > gap or end - start > most):
            requests.append(Request(start=start, stop=stop, ranges=tuple(group)))
            group = []
        if not group:
            start, end = offset, offset + size
        stop = end
        group.append((offset, size))
    if group:
        requests.append(Request(start=start, stop=stop, ranges=tuple(group)))
    return requests


CHANGED = "the file changed since it was opened; open it again"
"""Told of a file that another took the place of."""


@contextmanager
def damage_named(path: object, source: Source | None = None) -> Iterator[None]:
    """A block whose errors about a file begin with its path.

    source: of the file; where its bytes are damaged because it changed meanwhile, that is told.

    Other errors that a hostile or unreadable file provokes become DamagedFileError. MemoryError
    passes: the coders refuse sizes that the bytes of a chunk cannot hold, so that only a machine
    with too little memory for a sound file is left as its cause. A user who is told that a file is
    damaged may delete it.
    """
    try:
        yield
    except DamagedFileError as error:
        if source is not None and source.changed():
            raise InputError(f"{path}: {CHANGED}") from error
        raise type(error)(f"{path}: {error}") from error
    except (RecursionError, OverflowError, UnicodeError, struct.error) as error:
        raise DamagedFileError(f"{path}: the file is damaged: {type(error).__name__}") from error
    except OSError as error:
        if error.errno is None:
            raise
        raise DamagedFileError(f"{path}: the file cannot be read: {error.strerror}") from error


class Source(Protocol):
    """A source that a container is read from; several threads may call its methods.

    Classes derive from it for what has a default here, which suits files at hand.

    Attributes:
        size: number of bytes.
        gap: bytes that are better read than left out by another request; 0 where a read of its own
            costs nothing. Only with a gap does `prefetch` do anything.
    """

    size: int
    gap: int = 0

    def read(self, offset: int, size: int) -> bytes:
        """Exactly `size` bytes from `offset`; raises DamagedFileError if they are not there."""
        ...

    def prefetch(self, ranges: Iterable[Range]) -> None:
        """Begin to fetch ranges that will be read soon, each as it stands here; waits for none."""
        return None

    def changed(self) -> bool:
        """Whether the file is known to be another one than was opened."""
        return False

    def close(self) -> None:
        """Release the file."""
        ...


def check_range(source: Source, offset: int, size: int) -> None:
    """Raise DamagedFileError for a range that reaches beyond a source."""
    if offset < 0 or size < 0 or offset + size > source.size:
        raise DamagedFileError(
            f"{size} bytes at offset {offset} are outside the file of {source.size} bytes"
        )


class FileSource(Source):
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
        self._lock = ForkLock()
        self._readers, self._closed = 0, False
        self.size = self._file.seek(0, 2)
        self._state = self._current_state()

    def read(self, offset: int, size: int) -> bytes:
        """Exactly `size` bytes from `offset`; raises DamagedFileError if they are not there.

        Threads read side by side: where a file lies far away, each waits for its own bytes alone.
        """
        check_range(self, offset, size)
        with self._lock:
            if self._closed:
                raise InputError("the container is closed")
            self._readers += 1
        try:
            return b"".join(_pieces(self._read_at, offset, size))
        finally:
            with self._lock:
                self._readers -= 1
                self._close_if_idle()

    def _read_at(self, offset: int, size: int) -> bytes:
        """Bytes from an offset, up to `size`.

        Forked processes read the same open file, and share its position; only Windows, which has no
        os.pread, does not fork.
        """
        if hasattr(os, "pread"):
            return os.pread(self._file.fileno(), size, offset)
        with self._lock:
            self._file.seek(offset)
            return self._file.read(size)

    def changed(self) -> bool:
        """Whether the file was written to since it was opened, as a growing file's are in turns."""
        with self._lock:
            try:
                return not self._closed and self._current_state() != self._state
            except OSError:  # of a server that knows the file no more
                return True

    def _current_state(self) -> tuple[int, int]:
        """Time of the last change, in ns, and bytes."""
        found = os.fstat(self._file.fileno())
        return found.st_mtime_ns, found.st_size

    def close(self) -> None:
        """Read no more; the file is released once no thread reads it."""
        with self._lock:
            self._closed = True
            self._close_if_idle()

    def _close_if_idle(self) -> None:
        if self._closed and not self._readers:
            self._file.close()


class OpenFileSource(Source):
    """A binary file that the caller opened, and closes after the container: `open(...)`, BytesIO.

    Raises InputError for a file of text, one that is closed, not for reading or cannot seek. A
    forked process cannot read it: it shares the place in the file with its parent.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._process = os.getpid()
        self._lock = ForkLock()
        self._closed = False
        try:
            self.size = file.seek(0, 2)
            text = not isinstance(file.read(0), bytes)
        except (OSError, ValueError, AttributeError) as error:
            raise InputError(
                f"{file!r}: cannot seek and read ({error}); give a file opened with 'rb', or"
                " io.BytesIO of its bytes"
            ) from error
        if text:
            raise InputError(f"{file!r}: a file of text; open it with 'rb'")

    def read(self, offset: int, size: int) -> bytes:
        """Exactly `size` bytes from `offset`; raises DamagedFileError if they are not there."""
        check_range(self, offset, size)
        if os.getpid() != self._process and not isinstance(self._file, io.BytesIO):
            raise InputError(
                "the container was opened in the process that this one was forked from, from an"
                " open file; open it by its path, or open it in this process"
            )
        with self._lock:
            if self._closed or getattr(self._file, "closed", False):
                raise InputError("the container is closed, or the file that it was opened from")
            self._file.seek(offset)
            return b"".join(_pieces(lambda _, rest: self._file.read(rest), offset, size))

    def close(self) -> None:
        """Read no more; the file stays open."""
        with self._lock:
            self._closed = True


def _pieces(read: Callable[[int, int], bytes], offset: int, size: int) -> Iterator[bytes]:
    """Exactly `size` bytes from `offset`, as they come; raises DamagedFileError at the file's end.

    read: the bytes from an offset, up to a number, and none at the end.
    """
    while size > 0:
        piece = read(offset, size)
        if not piece:
            raise DamagedFileError(
                "the file was cut short while it was read, "
                f"{size} bytes from offset {offset} are missing"
            )
        yield piece
        size -= len(piece)
        offset += len(piece)


class CountedSource(Source):
    """A source that counts in `bytes_read` how many bytes were read from it."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._lock = ForkLock()
        self.size, self.gap = source.size, source.gap
        self.bytes_read = 0

    def read(self, offset: int, size: int) -> bytes:
        """Exactly `size` bytes from `offset`; raises DamagedFileError if they are not there."""
        data = self._source.read(offset, size)
        with self._lock:
            self.bytes_read += size
        return data

    def prefetch(self, ranges: Iterable[Range]) -> None:
        """Begin to fetch ranges that will be read soon; they count once they are read."""
        self._source.prefetch(ranges)

    def changed(self) -> bool:
        """Whether the file is known to be another one than was opened."""
        return self._source.changed()

    def close(self) -> None:
        """Release the file."""
        self._source.close()


class PreviewSource(Source):
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
        check_range(self, offset, size)
        from_file = max(0, min(offset + size, self._length) - offset)
        begin = self._begin.read(offset, from_file) if from_file else b""
        start = offset + from_file - self._length
        return begin + self._tail[start : start + size - from_file] if size > from_file else begin

    def close(self) -> None:
        """Release the file."""
        self._begin.close()
