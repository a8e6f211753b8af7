"""The bytes of the ZIP: fixed for ever, and right where 32 bits do not suffice."""

from __future__ import annotations

import io
import json
import struct
import tracemalloc
import zipfile
import zlib

import pytest
from hostile_files import FLAGS, FULL_SIZE, METHOD, OFFSET, ROOT, SIZE, read_everything, refused

from fhash_formats.container.zip_file import (
    Member,
    comment,
    deflated,
    directory_entry,
    ending,
    local_header,
    read_members,
)
from fhash_formats.errors import DamagedFileError, UnsupportedFileError

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


ENTRIES = {
    "deflated to nothing less": (METHOD, "<H", 8, "deflated and"),
    "packed otherwise": (METHOD, "<H", 14, "ZIP method 14"),
    "encrypted": (FLAGS, "<H", 1, "encrypted"),
    "data descriptor": (FLAGS, "<H", 8, "does not allow"),
    "utf-8 names": (FLAGS, "<H", 0x800, "does not allow"),
    "sizes differ": (SIZE, "<I", 5, "equal sizes"),
    "huge": (FULL_SIZE, "<I", 0xFFFFFFFF, "equal sizes"),
    "another date": (14, "<H", 0x5000, "does not allow"),
    "link": (38, "<I", 0o120777 << 16, "does not allow"),
    "extra field": (30, "<H", 4, "does not allow"),
    "comment of a member": (32, "<H", 1, "does not allow"),
    "another disk": (34, "<H", 1, "does not allow"),
    "offset outside": (OFFSET, "<I", 0x7FFFFFFF, "overlaps another or leaves a gap"),
    "zip64 offset without its field": (OFFSET, "<I", 0xFFFFFFFF, "does not allow|overlaps"),
    "longer name": (28, "<H", 0xFFFF, "not allowed"),
    "no mark": (0, "<I", 0, "without its mark"),
}


@pytest.mark.parametrize("case", ENTRIES)
def test_directory_entry(sample, samples, case) -> None:
    at, form, value, message = ENTRIES[case]
    data = bytearray(samples.pack(samples.unpack(sample.read_bytes())))
    struct.pack_into(form, data, samples.directory_at(bytes(data)) + at, value)
    refused(sample, samples.reseal(bytes(data)), message)


@pytest.mark.parametrize(
    "name",
    [
        "../evil",
        "a/../../evil",
        "/etc/evil",
        "a\\evil",
        "folder/",
        "a//b",
        ".",
        "C:evil",
        "a b",
        "a\nb",
        ".hidden",
        "",
    ],
)
def test_member_names(sample, samples, name) -> None:
    parts = samples.unpack(sample.read_bytes())
    refused(sample, samples.pack([(name, b"x"), *parts]), "not allowed")


def test_name_beyond_ascii(sample, samples) -> None:
    parts = [("coordx", b""), *samples.unpack(sample.read_bytes())]
    refused(
        sample,
        samples.reseal(samples.pack(parts).replace(b"coordx", "coor\u00e9".encode())),
        "not allowed",
    )


def test_duplicate_member(sample, samples) -> None:
    parts = samples.unpack(sample.read_bytes())
    refused(sample, samples.pack([*parts, parts[-1]]), "twice")


def test_overlapping_members(sample, samples) -> None:
    """The second entry points at the first member, as in a quoted-overlap ZIP bomb."""
    data = bytearray(sample.read_bytes())
    second = data.index(b"PK\x01\x02", samples.directory_at(bytes(data)) + 4)
    struct.pack_into("<I", data, second + OFFSET, 0)
    refused(sample, samples.reseal(bytes(data)), "overlaps")


def test_hidden_bytes_between_members_and_directory(sample, samples) -> None:
    data = sample.read_bytes()
    at = samples.directory_at(data)
    longer = bytearray(data[:at] + b"hidden" + data[at:])
    struct.pack_into("<I", longer, len(longer) - 79 - 6, at + 6)
    refused(sample, samples.reseal(bytes(longer)), "are declared")


def test_local_header_that_differs(sample) -> None:
    data = bytearray(sample.read_bytes())
    data[8] ^= 8
    refused(sample, bytes(data), "header differs")


DEFLATED = {
    "bomb": (lambda data: deflated(bytes(15 << 20)), 15 << 20, "not valid JSON|JSON"),
    "more than declared": (lambda data: deflated(bytes(1 << 26)), 1 << 20, "does not inflate"),
    "less than declared": (lambda data: deflated(data), 1 << 20, "does not inflate"),
    "beyond the limit": (lambda data: deflated(data), (16 << 20) + 1, "the limit is 16777216"),
    "cut": (lambda data: deflated(data)[:-3], None, "does not inflate"),
    "with a tail": (lambda data: deflated(data) + b"tail", None, "does not inflate"),
    "no deflate": (lambda data: b"\xff" * 40, None, "deflated data are damaged"),
}


@pytest.mark.parametrize("case", DEFLATED)
def test_deflated_metadata(sample, samples, case) -> None:
    make, declared, message = DEFLATED[case]
    parts = samples.unpack(sample.read_bytes())
    members, chunks, position = [], [], 0
    for name, data in parts:
        stored = make(data) if name == ROOT else data
        full = None if name != ROOT else declared or len(data)
        # The CRC is right where the content is what is declared.
        crc = zlib.crc32(bytes(15 << 20) if case == "bomb" and name == ROOT else data)
        member = Member(name=name, offset=position, size=len(stored), crc=crc, full_size=full)
        members.append(member)
        chunks += [local_header(member), stored]
        position = member.end
    container = b"".join([*chunks, ending(members)])
    sample.write_bytes(container)
    tracemalloc.start()
    with pytest.raises(DamagedFileError, match=message):
        read_everything(sample)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # Metadata may be as large as they declare, up to the limit, and are held as bytes, as text and
    # as values at most.
    assert peak < 4 * (declared or len(container)) + (4 << 20)


def test_chunks_are_never_deflated(sample, samples) -> None:
    parts = samples.unpack(sample.read_bytes())
    name = next(name for name, _ in parts if not name.endswith(ROOT))
    members, chunks, position = [], [], 0
    for other, content in parts:
        packed = deflated(content) if other == name else content
        full = len(content) if other == name else None
        member = Member(
            name=other, offset=position, size=len(packed), crc=zlib.crc32(content), full_size=full
        )
        members.append(member)
        chunks += [local_header(member), packed]
        position = member.end
    refused(sample, b"".join([*chunks, ending(members)]), "only metadata may be")


@pytest.mark.parametrize(
    ("field", "form", "value", "message"),
    [
        (8, "<H", 3, "contradicts"),
        (10, "<H", 3, "contradicts|entries"),
        (12, "<I", 2**31, "limit"),
        (16, "<I", 1, "it ends at"),
        (10, "<H", 65535, "ZIP64"),
    ],
)
def test_end_record(sample, samples, field, form, value, message) -> None:
    data = bytearray(sample.read_bytes())
    struct.pack_into(form, data, len(data) - 79 - 22 + field, value)
    # The end record no longer leads to the directory, so the digest is made right by hand.
    start = samples.directory_at(sample.read_bytes())
    directory = bytes(data[start:-79])
    refused(sample, bytes(data[:start]) + directory + comment(directory), message)


@pytest.mark.parametrize(
    ("major", "advice"), [(b"1", "encode the source again"), (b"3", "upgrade")]
)
def test_another_format(sample, major, advice) -> None:
    data = sample.read_bytes()
    refused(
        sample,
        data.replace(b"fhash 2 sha256", b"fhash %s sha256" % major),
        rf"of format {major.decode()}\.x; this fhash reads format 2\.x: {advice}",
        UnsupportedFileError,
    )
