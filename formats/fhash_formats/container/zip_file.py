"""Bytes of a file: ranges at offsets, and members of a ZIP, written and checked."""

from __future__ import annotations

import hashlib
import io
import os
import re
import stat
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Protocol

from fhash_formats.errors import (
    DamagedFileError,
    InputError,
    MissingInputError,
)
from fhash_formats.support.threads import ForkLock

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
    def span(self) -> Range:
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


FORMAT_VERSION = (3, 0)
"""(major, minor) of the format that is written; FORMAT.md says what a change of each means."""
COMMENT = re.compile(rb"fhash ([0-9]{1,4}) sha256=[0-9a-f]{64}\Z")
"""The comment at the end of a container: major version of the format, digest of the directory."""

LOCAL = struct.Struct("<4s5H3I2H")
ENTRY = struct.Struct("<4s4B4H3I5H2I")
OFFSET_64 = struct.Struct("<2HQ")
END_64 = struct.Struct("<4sQ2H2I4Q")
LOCATOR_64 = struct.Struct("<4sIQI")
END = struct.Struct("<4s4H2IH")

LOCAL_MARK = b"PK\x03\x04"
ENTRY_MARK = b"PK\x01\x02"
END_MARK = b"PK\x05\x06"
END_64_MARK = b"PK\x06\x06"
LOCATOR_64_MARK = b"PK\x06\x07"

VERSION = 20
"""ZIP version 2.0, in tenths."""
VERSION_64 = 45
"""ZIP version 4.5, in tenths: the first with 64-bit offsets."""
UNIX = 3
"""The system on which a member was made, which gives its attributes a meaning."""
FILE_MODE = 0o100644 << 16
"""External attributes of a member: a regular file of mode 0644."""
TIME = 0
"""Midnight, as MS-DOS writes times."""
DATE = (1980 - 1980) << 9 | 1 << 5 | 1
"""1 January 1980, as MS-DOS writes dates."""
STORED = 0
"""Method of a member whose data are stored as they are."""
DEFLATED = 8
"""Method of a member whose data are deflated (RFC 1951)."""
MAX_16 = 0xFFFF
"""Value of a 16-bit field whose true value stands in a 64-bit record."""
MAX_32 = 0xFFFFFFFF
"""Value of a 32-bit field whose true value stands in a 64-bit record."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Member:
    """One file in the ZIP. Sizes stay below 4 GiB, offsets need not.

    Attributes:
        name: path in the ZIP, ASCII.
        offset: offset of the local header.
        size: bytes of the data in the ZIP.
        crc: CRC-32 of the full data.
        full_size: bytes of the inflated data; None for data that are stored as they are.
    """

    name: str
    offset: int
    size: int
    crc: int
    full_size: int | None = None

    @property
    def method(self) -> int:
        """ZIP's number of the compression method."""
        return STORED if self.full_size is None else DEFLATED

    @property
    def sizes(self) -> tuple[int, int]:
        """Bytes of the data in the file, and bytes of the full data."""
        return self.size, self.size if self.full_size is None else self.full_size

    @property
    def header_size(self) -> int:
        """Bytes of the local header and the name."""
        return LOCAL.size + len(self.name)

    @property
    def data_offset(self) -> int:
        """Offset of the data."""
        return self.offset + self.header_size

    @property
    def end(self) -> int:
        """Offset of the byte after the data."""
        return self.offset + self.header_size + self.size


def local_header(member: Member) -> bytes:
    """The bytes before a member's data: the local header and the name."""
    name = member.name.encode("ascii")
    return (
        LOCAL.pack(
            LOCAL_MARK,
            VERSION,
            0,
            member.method,
            TIME,
            DATE,
            member.crc,
            *member.sizes,
            len(name),
            0,
        )
        + name
    )


def deflated(data: bytes) -> bytes:
    """The raw deflate stream (RFC 1951) of a member's data."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS)
    return packer.compress(data) + packer.flush()


def document_member(name: str, offset: int, data: bytes) -> tuple[Member, bytes]:
    """The member of a metadata document, and its data in the file, deflated where that is shorter.

    Args:
        name: path of the document in the ZIP.
        offset: offset of its local header.
        data: bytes of the document.
    """
    packed = deflated(data)
    if len(packed) >= len(data):
        return Member(name=name, offset=offset, size=len(data), crc=zlib.crc32(data)), data
    return Member(
        name=name, offset=offset, size=len(packed), crc=zlib.crc32(data), full_size=len(data)
    ), packed


def directory_entry(member: Member) -> bytes:
    """A member's entry in the directory.

    An offset of 2^32 - 1 or more stands in an extra field (zip64).
    """
    name = member.name.encode("ascii")
    far = member.offset >= MAX_32
    extra = OFFSET_64.pack(1, 8, member.offset) if far else b""
    version = VERSION_64 if far else VERSION
    offset = MAX_32 if far else member.offset
    sizes = (member.crc, *member.sizes)
    lengths = (len(name), len(extra), 0, 0, 0)
    return (
        ENTRY.pack(
            ENTRY_MARK,
            version,
            UNIX,
            version,
            0,
            0,
            member.method,
            TIME,
            DATE,
            *sizes,
            *lengths,
            FILE_MODE,
            offset,
        )
        + name
        + extra
    )


def end_records(count: int, size: int, offset: int) -> bytes:
    """The end records behind a directory, up to the comment; zip64 records only where needed.

    Args:
        count: entries of the directory.
        size: bytes of the directory.
        offset: offset of the directory.
    """
    comment_size = len(comment(b""))
    limited = (min(count, MAX_16), min(count, MAX_16), min(size, MAX_32), min(offset, MAX_32))
    end = END.pack(END_MARK, 0, 0, *limited, comment_size)
    if count < MAX_16 and size < MAX_32 and offset < MAX_32:
        return end
    end_64 = END_64.pack(
        END_64_MARK, END_64.size - 12, VERSION_64, VERSION_64, 0, 0, count, count, size, offset
    )
    return end_64 + LOCATOR_64.pack(LOCATOR_64_MARK, 0, offset + size, 1) + end


def comment(directory: bytes) -> bytes:
    """The signature of a container: the major version of the format and a SHA-256.

    `directory` is what is digested: every byte from the first directory entry to the comment.
    """
    digest = hashlib.sha256(directory).hexdigest().encode("ascii")
    return b"fhash %d sha256=%s" % (FORMAT_VERSION[0], digest)


def ending(members: Sequence[Member]) -> bytes:
    """The bytes after the data of the last member: directory, end records and comment."""
    entries = b"".join(directory_entry(member) for member in members)
    directory = entries + end_records(len(members), len(entries), members[-1].end if members else 0)
    return directory + comment(directory)


MAX_MEMBER = 1 << 31
"""Bytes of a member's data in the file."""
DOCUMENT = "zarr.json"
"""Name of a metadata document, the last in its path."""
MAX_NAME = 512
"""Bytes of a member's name."""

_FOLDER = r"[A-Za-z0-9_-][A-Za-z0-9._-]*"
NAME = re.compile(rf"{_FOLDER}(/{_FOLDER})*")
"""A member's name: a relative path without spaces, in which no name starts with a dot."""

_MAX_COMMENT = 128
"""Bytes at the end of a file in which the signature is looked for."""


def is_signed(source: Source) -> bool:
    """Whether a file ends in the signature of a container, of whatever version."""
    start = max(0, source.size - _MAX_COMMENT)
    return COMMENT.search(source.read(start, source.size - start)) is not None
