"""The bytes of a container's ZIP (PKWARE APPNOTE 6.3), written and checked.

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

from fhash_formats.container.source import Source
from fhash_formats.errors import DamagedFileError, UnsupportedFileError

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


MAX_DIRECTORY = 1 << 28
"""Bytes of the directory."""
MAX_MEMBER = 1 << 31
"""Bytes of a member's data in the file."""
MAX_DOCUMENT = 16 << 20
"""Bytes of a full metadata document; no other members are deflated."""
DOCUMENT = "zarr.json"
"""Name of a metadata document, the last in its path."""
MAX_NAME = 512
"""Bytes of a member's name."""

_FOLDER = r"[A-Za-z0-9_-][A-Za-z0-9._-]*"
NAME = re.compile(rf"{_FOLDER}(/{_FOLDER})*")
"""A member's name: a relative path without spaces, in which no name starts with a dot."""

_MAX_COMMENT = 128
"""Bytes at the end of a file in which the signature is looked for."""
_PIECE = 1 << 20
"""Bytes of a member that `check_member` reads at a time."""


def find_signature(source: Source) -> tuple[int, bytes] | None:
    """Major version of the format and comment; None for a file that ends in no signature."""
    start = max(0, source.size - _MAX_COMMENT)
    end = source.read(start, source.size - start)
    match = COMMENT.search(end)
    return (int(match[1]), match[0]) if match else None


def read_members(source: Source) -> dict[str, Member]:
    """Every member by name, in the order of the file.

    Raises DamagedFileError for a ZIP that `layout` could not have written, and
    UnsupportedFileError for another format.
    """
    signature = find_signature(source)
    if signature is None:
        raise DamagedFileError(
            "not an fhash container, or one that was cut short: no fhash signature at its end"
        )
    major, signed = signature
    comment_at = source.size - len(signed)
    check_major(major, f"{major}.x")
    count, size, offset = _read_end(source, comment_at)
    directory = source.read(offset, comment_at - offset)
    if comment(directory) != signed:
        raise DamagedFileError(
            "the ZIP directory is damaged: its SHA-256 differs from the one in the comment"
        )
    if directory[size:] != end_records(count, size, offset):
        raise DamagedFileError("the end record of the ZIP directory contradicts itself")
    return _parse(directory[:size], count, offset)


def read_member(source: Source, member: Member) -> memoryview:
    """The full data of a member, checked; raises DamagedFileError that names the member."""
    try:
        stored = source.read(member.offset, member.header_size + member.size)
    except DamagedFileError as error:
        raise DamagedFileError(f"member {member.name}: {error}") from error
    if stored[: member.header_size] != local_header(member):
        raise DamagedFileError(f"member {member.name}: its header differs from the directory")
    data = memoryview(stored)[member.header_size :]
    if member.full_size is not None:
        data = memoryview(_inflated(member, data, member.full_size))
    if zlib.crc32(data) != member.crc:
        raise DamagedFileError(f"member {member.name}: its CRC-32 differs, the data are damaged")
    return data


def check_member(source: Source, member: Member) -> None:
    """Check a member as `read_member` does, but piece by piece, without holding its data."""
    if member.full_size is not None:
        read_member(source, member)
        return
    pieces = [
        (member.data_offset + start, min(_PIECE, member.size - start))
        for start in range(0, member.size, _PIECE)
    ]
    source.prefetch([(member.offset, member.header_size), *pieces])
    if source.read(member.offset, member.header_size) != local_header(member):
        raise DamagedFileError(f"member {member.name}: its header differs from the directory")
    crc = 0
    for offset, size in pieces:
        crc = zlib.crc32(source.read(offset, size), crc)
    if crc != member.crc:
        raise DamagedFileError(f"member {member.name}: its CRC-32 differs, the data are damaged")


def _inflated(member: Member, data: memoryview, size: int) -> bytes:
    """The inflated data of a member; no more than the declared `size` bytes are ever made."""
    inflate = zlib.decompressobj(-zlib.MAX_WBITS)
    try:
        full = inflate.decompress(data, size + 1)
    except zlib.error as error:
        raise DamagedFileError(
            f"member {member.name}: its deflated data are damaged: {error}"
        ) from error
    if len(full) != size or not inflate.eof or inflate.unused_data:
        raise DamagedFileError(
            f"member {member.name}: it does not inflate to the {size} bytes that are declared"
        )
    return full


def _read_end(source: Source, comment_at: int) -> tuple[int, int, int]:
    """(entries, bytes, offset) of the directory, from the end records before the comment."""
    end_at = comment_at - END.size
    if end_at < 0:
        raise DamagedFileError("the ZIP end record is missing")
    mark, _, _, _, count, size, offset, comment_size = END.unpack(source.read(end_at, END.size))
    if (
        mark != END_MARK
        or comment_size != source.size - comment_at
        or comment_size != len(comment(b""))
    ):
        raise DamagedFileError("the ZIP end record is damaged")
    records_at = end_at
    if count == MAX_16 or MAX_32 in (size, offset):
        records_at = end_at - LOCATOR_64.size - END_64.size
        if records_at < 0:
            raise DamagedFileError("the ZIP64 end record is missing")
        mark, _, _, _, _, _, _, count, size, offset = END_64.unpack(
            source.read(records_at, END_64.size)
        )
        if mark != END_64_MARK:
            raise DamagedFileError("the ZIP64 end record is damaged")
    if size > MAX_DIRECTORY:
        raise DamagedFileError(
            f"the ZIP directory declares {size} bytes; the limit is {MAX_DIRECTORY}"
        )
    if offset + size != records_at:
        raise DamagedFileError(
            f"the ZIP directory is declared at {offset} with {size} bytes, "
            f"but it ends at {records_at}"
        )
    return count, size, offset


def _parse(directory: bytes, count: int, data_end: int) -> dict[str, Member]:
    """The members of a directory.

    Args:
        directory: bytes of its entries.
        count: number of entries that the end record declares.
        data_end: offset at which the members end and the directory begins.
    """
    members: dict[str, Member] = {}
    at = position = 0
    while at < len(directory):
        member, length = _parse_entry(directory, at)
        if member.name in members:
            raise DamagedFileError(f"member {member.name} is there twice")
        if member.offset != position or member.end > data_end:
            raise DamagedFileError(
                f"member {member.name} at {member.offset} overlaps another or leaves a gap; "
                f"{position} was expected"
            )
        members[member.name] = member
        position = member.end
        at += length
    if len(members) != count or position != data_end:
        raise DamagedFileError(
            f"the ZIP directory has {len(members)} entries that end at {position}; "
            f"{count} and {data_end} are declared"
        )
    return members


def _parse_entry(directory: bytes, at: int) -> tuple[Member, int]:
    """The member whose entry starts at `at`, and the number of bytes of the entry.

    The fields that the format fixes are not checked one by one: the entry must equal the one that
    `layout` writes for the member.
    """
    if at + ENTRY.size > len(directory):
        raise DamagedFileError("the ZIP directory ends within an entry")
    fields = ENTRY.unpack_from(directory, at)
    mark, flags, method, crc, size, full_size, name_size, extra_size, offset = (
        fields[i] for i in (0, 5, 6, 9, 10, 11, 12, 13, 18)
    )
    if mark != ENTRY_MARK:
        raise DamagedFileError("the ZIP directory has an entry without its mark")
    name_at = at + ENTRY.size
    extra_at = name_at + name_size
    name = _checked_name(directory[name_at:extra_at], name_size)
    if flags & 1:
        raise DamagedFileError(f"member {name} is encrypted")
    may_be_deflated = name.rpartition("/")[2] == DOCUMENT
    if method != STORED and not (may_be_deflated and method == DEFLATED):
        raise DamagedFileError(
            f"member {name} is compressed by ZIP method {method}; only metadata may be, by 8"
        )
    _check_sizes(name, method, size, full_size)
    has_offset_64 = offset == MAX_32 and extra_size == OFFSET_64.size
    if has_offset_64 and extra_at + extra_size <= len(directory):
        offset = OFFSET_64.unpack_from(directory, extra_at)[2]
    member = Member(
        name=name,
        offset=offset,
        size=size,
        crc=crc,
        full_size=full_size if method == DEFLATED else None,
    )
    canonical = directory_entry(member)
    if directory[at : at + len(canonical)] != canonical:
        raise DamagedFileError(
            f"member {name} has fields in its directory entry that the format does not allow"
        )
    return member, len(canonical)


def _checked_name(name_bytes: bytes, size: int) -> str:
    """A member's name; `size` is the number of bytes that its entry declares for it."""
    name = name_bytes.decode("ascii", "replace")
    if size > MAX_NAME or not name_bytes.isascii() or not NAME.fullmatch(name):
        raise DamagedFileError(
            f"member name {name[:80]!a} is not allowed; "
            "names are relative paths of A-Z a-z 0-9 . _ -"
        )
    return name


def _check_sizes(name: str, method: int, size: int, full_size: int) -> None:
    if method == DEFLATED:
        if not size < full_size <= MAX_DOCUMENT:
            raise DamagedFileError(
                f"member {name} declares {size} deflated and {full_size} full bytes; "
                f"the limit is {MAX_DOCUMENT}"
            )
    elif size != full_size or size > MAX_MEMBER:
        raise DamagedFileError(
            f"member {name} declares {size} stored and {full_size} full bytes; "
            f"equal sizes up to {MAX_MEMBER} are allowed"
        )
