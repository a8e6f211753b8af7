"""The bytes of a container's ZIP (PKWARE APPNOTE 6.3).

The file has three parts. Numbers are little-endian.

1. the members, one after the other without gaps: a local header of 30 bytes, the name, the data;
2. the directory: one entry per member, in the same order;
3. the end records with the comment.

Every field that carries no information is fixed, so that one content has one file.
"""

from __future__ import annotations

import hashlib
import re
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

from fhash_formats.errors import UnsupportedFileError

FORMAT_VERSION = (2, 0)
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


def check_major(major: int, version: str) -> None:
    """Raise UnsupportedFileError for a file of another major version of the format.

    version: as it is shown, such as "1.8".
    """
    known = FORMAT_VERSION[0]
    if major != known:
        advice = "upgrade" if major > known else "encode the source again"
        raise UnsupportedFileError(
            f"the file is of format {version}; this fhash reads format {known}.x: {advice}"
        )


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
