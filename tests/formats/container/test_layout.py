"""The bytes of the ZIP: fixed for ever, and right where 32 bits do not suffice."""

from __future__ import annotations

import io
import json
import zipfile

import pytest

from fhash_formats.container.zip_file import (
    Member,
    comment,
    directory_entry,
    ending,
    local_header,
    read_members,
)
from fhash_formats.errors import DamagedFileError

MEMBER = Member(name="a/b", offset=0x01020304, size=0x05060708, crc=0x090A0B0C)


def test_bytes_of_a_local_header() -> None:
    expected = "504b0304 1400 0000 0000 0000 2100 0c0b0a09 08070605 08070605 0300 0000 612f62"
    assert local_header(MEMBER) == bytes.fromhex(expected)


def test_bytes_of_a_directory_entry() -> None:
    expected = (
        "504b0102 1403 1400 0000 0000 0000 2100 0c0b0a09 08070605 08070605 "
        "0300 0000 0000 0000 0000 0000a481 04030201 612f62"
    )
    assert directory_entry(MEMBER) == bytes.fromhex(expected)


def test_bytes_of_a_far_directory_entry() -> None:
    far = Member(name="a/b", offset=0x100000000, size=1, crc=0)
    expected = (
        "504b0102 2d03 2d00 0000 0000 0000 2100 00000000 01000000 01000000 "
        "0300 0c00 0000 0000 0000 0000a481 ffffffff 612f62"
    )
    assert directory_entry(far) == bytes.fromhex(expected + "0100 0800 0000000001000000")


def test_comment_is_a_digest() -> None:
    assert (
        comment(b"")
        == b"fhash 2 sha256=e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
    )


class Sparse(io.RawIOBase):
    """A file with only its end; the data of its members would be many gigabytes."""

    def __init__(self, begin: int, tail: bytes) -> None:
        self.begin, self.tail, self.size, self.at = begin, tail, begin + len(tail), 0

    def read(self, *arguments):
        """`read(offset, size)` as a source, `read(size)` or `read()` as a file."""
        offset, size = (
            arguments if len(arguments) == 2 else (self.at, *(arguments or (self.size - self.at,)))
        )
        start = offset - self.begin
        self.at = offset + size
        # zipfile looks for the end record a little further back than it is.
        assert start > -(1 << 17), "the data of the members are not there"
        return bytes(max(0, -start)) + self.tail[max(0, start) : max(0, start + size)]

    def seek(self, offset, whence=0):
        self.at = offset + (0, self.at, self.size)[whence]
        return self.at

    def tell(self):
        return self.at

    def seekable(self):
        return True


def sparse(sizes):
    members, position = [], 0
    for number, size in enumerate(sizes):
        members.append(Member(name=f"m/{number}", offset=position, size=size, crc=number))
        position = members[-1].end
    return members, Sparse(position, ending(members))


@pytest.mark.parametrize(
    "sizes",
    [
        pytest.param([2**31] * 4, id="beyond 4 GiB"),
        pytest.param([2**31 - 33, 2**31 - 33 - 1, 1], id="offset of 4 GiB - 1"),
        pytest.param([2**31 - 33, 2**31 - 33 - 2, 1], id="offset of 4 GiB - 2"),
        pytest.param([1] * 65534, id="65534 members"),
        pytest.param([1] * 65535, id="65535 members"),
        pytest.param([1] * 70000, id="70000 members"),
        pytest.param([], id="none"),
    ],
)
def test_zip64_is_read_by_us_and_by_zipfile(sizes) -> None:
    members, source = sparse(sizes)
    assert list(read_members(source).values()) == members
    with zipfile.ZipFile(source) as archive:
        entries = [
            (info.filename, info.header_offset, info.file_size) for info in archive.infolist()
        ]
    assert entries == [(member.name, member.offset, member.size) for member in members]


@pytest.mark.parametrize("back", range(1, 100, 3))
def test_zip64_records_are_in_the_digest(back) -> None:
    _, source = sparse([2**31] * 3)
    tail = bytearray(source.tail)
    tail[-79 - back] ^= 1
    source.tail = bytes(tail)
    with pytest.raises(DamagedFileError):
        read_members(source)


def test_zipfile_finds_a_sound_zip_of_stored_chunks(sample) -> None:
    with zipfile.ZipFile(sample) as archive:
        assert archive.testzip() is None
        assert archive.namelist()[-1] == "zarr.json"
        assert {(info.date_time, info.create_system) for info in archive.infolist()} == {
            ((1980, 1, 1, 0, 0, 0), 3)
        }
        methods = {
            (info.filename.endswith("zarr.json"), info.compress_type) for info in archive.infolist()
        }
        assert methods >= {(True, zipfile.ZIP_DEFLATED), (False, zipfile.ZIP_STORED)}
        assert (False, zipfile.ZIP_DEFLATED) not in methods
        assert json.loads(archive.read("zarr.json"))["attributes"]["fhash"]["format"] == "fhash"
