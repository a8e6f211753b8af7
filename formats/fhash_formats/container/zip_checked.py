"""Safe opening of a container's ZIP: every field is checked before it is used to allocate memory.

The comment holds a digest of the directory, the members lie one after the other from the first byte
to the directory, and each field has the value that `layout` writes. So a changed byte is refused:
in the directory by its digest, in a member's header by the directory, in its data by their CRC-32.
The CRC-32 of a deflated document is that of its text: bytes that inflate to the same text, such as
others in the unused bits at the end, are the same document.
"""

from __future__ import annotations

import re
import zlib

from fhash_formats.container.layout import (
    COMMENT,
    DEFLATED,
    END,
    END_64,
    END_64_MARK,
    END_MARK,
    ENTRY,
    ENTRY_MARK,
    LOCATOR_64,
    MAX_16,
    MAX_32,
    OFFSET_64,
    STORED,
    Member,
    check_major,
    comment,
    directory_entry,
    end_records,
    local_header,
)
from fhash_formats.container.source import Source
from fhash_formats.errors import DamagedFileError

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
