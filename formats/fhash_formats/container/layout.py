"""The bytes of a container's ZIP: every field that carries no information is fixed, so that one content has one file.

Layout (PKWARE APPNOTE 6.3): members one after the other without gaps, each a local header of 30 bytes, its name and its data; then the
directory (one entry per member, in the same order); then the end records with the comment. Numbers are little-endian.
"""

from __future__ import annotations

import hashlib
import re
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

LAYOUT_VERSION = 2
"""Of what is written; version 1 has no deflated members."""
COMMENT = re.compile(rb"fhash ([0-9]{1,4}) sha256=[0-9a-f]{64}\Z")

LOCAL = struct.Struct("<4s5H3I2H")
ENTRY = struct.Struct("<4s4B4H3I5H2I")
OFFSET_64 = struct.Struct("<2HQ")
END_64 = struct.Struct("<4sQ2H2I4Q")
LOCATOR_64 = struct.Struct("<4sIQI")
END = struct.Struct("<4s4H2IH")

LOCAL_MARK, ENTRY_MARK, END_MARK = b"PK\x03\x04", b"PK\x01\x02", b"PK\x05\x06"
END_64_MARK, LOCATOR_64_MARK = b"PK\x06\x06", b"PK\x06\x07"

VERSION, VERSION_64 = 20, 45
UNIX = 3
FILE_MODE = 0o100644 << 16
TIME, DATE = 0, (1980 - 1980) << 9 | 1 << 5 | 1
STORED, DEFLATED = 0, 8
MAX_16, MAX_32 = 0xFFFF, 0xFFFFFFFF
"""A field of this value says that the true one is in the 64-bit record."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Member:
    """One file in the ZIP: `offset` of its local header, `size` of its data there. Sizes stay below 4 GiB, offsets need not.

    full_size: of the data once they are inflated; None where they are stored as they are. crc: CRC-32 of the full data.
    """

    name: str
    offset: int
    size: int
    crc: int
    full_size: int | None = None

    @property
    def method(self) -> int:
        """How ZIP calls what was done with the data."""
        return STORED if self.full_size is None else DEFLATED

    @property
    def sizes(self) -> tuple[int, int]:
        """Of the data in the file and in full."""
        return self.size, self.size if self.full_size is None else self.full_size

    @property
    def header_size(self) -> int:
        """Bytes of the local header."""
        return LOCAL.size + len(self.name)

    @property
    def data_offset(self) -> int:
        """Offset of its data."""
        return self.offset + self.header_size

    @property
    def end(self) -> int:
        """Offset of the byte after the data."""
        return self.offset + self.header_size + self.size


def local_header(member: Member) -> bytes:
    """The bytes before a member's data."""
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
    """The member of a metadata document, and its data in the file: deflated where that is shorter."""
    packed = deflated(data)
    if len(packed) >= len(data):
        return Member(name=name, offset=offset, size=len(data), crc=zlib.crc32(data)), data
    return Member(
        name=name, offset=offset, size=len(packed), crc=zlib.crc32(data), full_size=len(data)
    ), packed


def directory_entry(member: Member) -> bytes:
    """A member's entry in the directory; an offset of 4 GiB or more goes to the zip64 extra field."""
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
    """What follows a directory of `count` entries and `size` bytes at `offset`, up to the comment; zip64 records only where needed."""
    comment_size = len(comment(b""))
    short = (min(count, MAX_16), min(count, MAX_16), min(size, MAX_32), min(offset, MAX_32))
    end = END.pack(END_MARK, 0, 0, *short, comment_size)
    if count < MAX_16 and size < MAX_32 and offset < MAX_32:
        return end
    end_64 = END_64.pack(
        END_64_MARK, END_64.size - 12, VERSION_64, VERSION_64, 0, 0, count, count, size, offset
    )
    return end_64 + LOCATOR_64.pack(LOCATOR_64_MARK, 0, offset + size, 1) + end


def comment(directory: bytes, version: int = LAYOUT_VERSION) -> bytes:
    """The signature of a container: its layout version and the SHA-256 of everything from the first directory entry to the comment."""
    return b"fhash %d sha256=%s" % (version, hashlib.sha256(directory).hexdigest().encode("ascii"))


def ending(members: Sequence[Member]) -> bytes:
    """Everything after the data of the last member: directory, end records and comment."""
    entries = b"".join(directory_entry(member) for member in members)
    directory = entries + end_records(len(members), len(entries), members[-1].end if members else 0)
    return directory + comment(directory)
