"""Containers as lists of members and back, without the checks of a writer."""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Iterable

from fhash_formats.container.zip_file import END, Member, comment, ending, local_header
from fhash_formats.native import crc32c

Parts = list[tuple[str, bytes]]
"""Name and inflated data of each member, in the order of the file."""


def unpack(data: bytes) -> Parts:
    """Return the members of a sound container, with documents inflated."""
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        return [(name, file.read(name)) for name in file.namelist()]


def pack(parts: Iterable[tuple[str, bytes]]) -> bytes:
    """Return a file of any members, with correct checksums."""
    return pack_members([(name, data, None, zlib.crc32(data)) for name, data in parts])


def pack_members(given: Iterable[tuple[str, bytes, int | None, int]]) -> bytes:
    """Return a file of members as they are given.

    A member is (name, data as stored, declared full size if deflated, declared CRC-32).
    """
    members, chunks, position = [], [], 0
    for name, data, full_size, crc in given:
        member = Member(name=name, offset=position, size=len(data), crc=crc, full_size=full_size)
        members.append(member)
        chunks += [local_header(member), data]
        position = member.end
    return b"".join([*chunks, ending(members)])


def directory_of(data: bytes) -> int:
    """Return the offset of the directory of a sound file."""
    return int(END.unpack_from(data, len(data) - len(comment(b"")) - END.size)[6])


def resealed(data: bytes, start: int) -> bytes:
    """Return the file with a correct digest of its directory, which begins at `start`."""
    directory = data[start : -len(comment(b""))]
    return data[:start] + directory + comment(directory)


def with_crc(data: bytes) -> bytes:
    """Return the data of a chunk with their CRC-32C."""
    return data + crc32c(data).to_bytes(4, "little")
