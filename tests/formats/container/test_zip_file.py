"""Bytes at offsets: of a file, counted, and of a file whose end is not written yet."""

from __future__ import annotations

import io
import json
import os
import random
import struct
import threading
import tracemalloc
import zipfile
import zlib
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import product

import numpy as np
import pytest
from forked import ended_well, forked, needs_fork
from hostile_files import FLAGS, FULL_SIZE, METHOD, OFFSET, ROOT, SIZE, read_everything, refused
from tiled_files import NAME, random_values, write_tiled

from fhash_formats.container import Container
from fhash_formats.container.array import ArrayMetadata, plain_codecs
from fhash_formats.container.stored import NativeFile
from fhash_formats.container.zip_file import (
    FileSource,
    Member,
    OpenFileSource,
    PreviewSource,
    comment,
    deflated,
    directory_entry,
    ending,
    local_header,
    merged,
)
from fhash_formats.errors import (
    DamagedFileError,
    InputError,
    MissingInputError,
    UnsupportedFileError,
)


def test_no_file_folder_and_pipe(tmp_path) -> None:
    with pytest.raises(MissingInputError, match="no such file"):
        Container.open(tmp_path / "none.fhz")
    os.mkfifo(tmp_path / "pipe.fhz")
    for path in (tmp_path, tmp_path / "pipe.fhz"):
        with pytest.raises(InputError, match="regular file"):
            Container.open(path)


def test_file_cut_while_open(tmp_path, samples) -> None:
    path = write_tiled(tmp_path / "a.fhz", samples, random_values((99, 999)), (99, 333), (1, 3))
    with Container.open(path) as container:
        path.write_bytes(path.read_bytes()[:100])
        with pytest.raises(InputError, match="the file changed since it was opened; open it again"):
            container.arrays[NAME].read()
    source = FileSource(path)
    path.write_bytes(b"")
    with pytest.raises(DamagedFileError, match="cut short"):
        source.read(90, 10)
    assert source.changed()
    source.close()


def test_a_file_is_damaged_rather_than_changed_if_nobody_wrote_to_it_since(tmp_path) -> None:
    (tmp_path / "a").write_bytes(b"abcdefgh")
    source = FileSource(tmp_path / "a")
    assert source.read(0, 8) == b"abcdefgh"
    assert not source.changed()
    (tmp_path / "b").write_bytes(b"another file")
    (tmp_path / "b").replace(tmp_path / "a")
    assert source.read(0, 8) == b"abcdefgh"
    assert not source.changed()
    source.close()
    assert not source.changed()


def test_a_preview_is_the_file_followed_by_its_tail(tmp_path) -> None:
    (tmp_path / "a").write_bytes(b"abcdefgh")
    preview = PreviewSource(FileSource(tmp_path / "a"), 5, b"XYZ")
    expected = b"abcdeXYZ"
    assert preview.size == len(expected)
    for start, stop in product(range(9), range(9)):
        if start <= stop:
            assert preview.read(start, stop - start) == expected[start:stop]
    for offset, size in ((0, 9), (8, 1), (-1, 1), (3, -1)):
        with pytest.raises(DamagedFileError, match="outside the file of 8 bytes"):
            preview.read(offset, size)
    preview.close()


@pytest.mark.skipif(not hasattr(os, "pread"), reason="one thread at a time without os.pread")
def test_threads_read_side_by_side_and_the_last_one_lets_go(tmp_path, monkeypatch) -> None:
    (tmp_path / "a").write_bytes(b"abcdefgh")
    source, pread, both = FileSource(tmp_path / "a"), os.pread, threading.Barrier(2, timeout=30)

    def slow(file: int, size: int, offset: int) -> bytes:
        both.wait()
        source.close()
        return pread(file, size, offset)

    monkeypatch.setattr(os, "pread", slow)
    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(source.read, (0, 5), (3, 3))) == [b"abc", b"fgh"]
    assert source._file.closed
    with pytest.raises(InputError, match="closed"):
        source.read(0, 1)


@needs_fork
def test_forked_processes_read_one_open_file_at_once(tmp_path) -> None:
    numbers = np.arange(50_000, dtype="<u4")
    (tmp_path / "a").write_bytes(numbers.tobytes())
    source = FileSource(tmp_path / "a")

    def reads_right(seed: int) -> bool:
        places = np.random.default_rng(seed).integers(0, numbers.size, 20_000).tolist()
        return all(source.read(4 * n, 4) == n.to_bytes(4, "little") for n in places)

    children = [forked(partial(reads_right, seed)) for seed in range(2)]
    assert reads_right(2)
    assert [ended_well(process) for process in children] == [True, True]
    source.close()


@needs_fork
def test_a_forked_process_reads_bytes_but_not_a_file_that_its_parent_opened(tmp_path) -> None:
    (tmp_path / "a").write_bytes(b"abcdefgh")

    def refused() -> bool:
        with pytest.raises(InputError, match=r"this one was forked from.*open it by its path"):
            source.read(2, 3)
        return True

    with (tmp_path / "a").open("rb") as file:
        source = OpenFileSource(file)
        assert ended_well(forked(refused))
        assert source.read(2, 3) == b"cde"
    held = OpenFileSource(io.BytesIO(b"abcdefgh"))
    assert ended_well(forked(lambda: held.read(2, 3) == b"cde"))


def places(requests) -> list[tuple[int, int]]:
    return [(request.start, request.stop) for request in requests]


def test_neighbours_are_one_request() -> None:
    assert places(merged([(20, 5), (0, 10), (10, 5)], gap=5, most=100)) == [(0, 25)]
    assert places(merged([(20, 5), (0, 10), (10, 5)], gap=4, most=100)) == [(0, 15), (20, 25)]


def test_a_request_of_several_ranges_has_a_limit() -> None:
    assert places(merged([(0, 6), (6, 6), (12, 6)], gap=0, most=12)) == [(0, 12), (12, 18)]
    assert places(merged([(0, 60), (60, 6)], gap=0, most=12)) == [(0, 60), (60, 66)]


def test_every_range_lies_in_one_request() -> None:
    for seed in range(200):
        draw = random.Random(seed)
        ranges = [(draw.randrange(300), draw.randrange(1, 40)) for _ in range(draw.randrange(1, 9))]
        gap, most = draw.randrange(20), draw.randrange(1, 120)
        requests = merged(ranges, gap, most)
        assert sorted(place for request in requests for place in request.ranges) == sorted(
            set(ranges)
        )
        for request in requests:
            covered = set()
            for offset, size in request.ranges:
                assert request.start <= offset
                assert offset + size <= request.stop
                covered.update(range(offset, offset + size))
            assert request.size - len(covered) <= gap * (len(request.ranges) - 1)
            assert len(request.ranges) == 1 or request.size <= most


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
        == b"fhash 3 sha256=e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
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


def sparse(path, samples, sizes):
    """A container whose first array has chunks of so many bytes, which are not there."""
    write_tiled(path, samples, random_values((2,)), (2,))
    document = {
        **ArrayMetadata(
            shape=(len(sizes),),
            dtype=np.dtype("u1"),
            chunk_shape=(1,),
            codecs=plain_codecs(np.dtype("u1")),
        ).to_dict()
    }
    members, position = [], 0
    for number, size in enumerate(sizes):
        name = f"{NAME}/c/{number}"
        members.append(Member(name=name, offset=position, size=size, crc=number))
        position = members[-1].end
    begin, tail = position, []
    for name, data in samples.unpack(path.read_bytes()):
        if name.startswith(f"{NAME}/t/"):
            continue
        content = json.dumps(document).encode() if name == f"{NAME}/zarr.json" else data
        member = Member(name=name, offset=position, size=len(content), crc=zlib.crc32(content))
        members.append(member)
        tail += [local_header(member), content]
        position = member.end
    return members, Sparse(begin, b"".join([*tail, ending(members)]))


@pytest.mark.parametrize(
    "sizes",
    [
        pytest.param([2**31] * 4, id="beyond 4 GiB"),
        pytest.param([2**31 - 33, 2**31 - 96, 1], id="offset of 4 GiB - 1"),
        pytest.param([1] * 65528, id="65534 members", marks=pytest.mark.every),
        pytest.param([1] * 65535, id="65535 members"),
    ],
)
def test_zip64_is_read_by_us_and_by_zipfile(tmp_path, samples, sizes) -> None:
    members, source = sparse(tmp_path / "a.fhz", samples, sizes)
    source.gap = 0
    opened = NativeFile(source, 0)
    (node,) = [node for node in opened.nodes() if node.path == NAME]
    assert node.stored_bytes == sum(sizes)
    last = members[len(sizes) - 1]
    place = (last.data_offset, last.size, last.name)
    assert opened.stored(node.number, (len(sizes) - 1,)) == place
    opened.close()
    with zipfile.ZipFile(source) as archive:
        entries = [
            (info.filename, info.header_offset, info.file_size) for info in archive.infolist()
        ]
    assert entries == [(member.name, member.offset, member.size) for member in members]


@pytest.mark.parametrize("back", range(1, 100, 3))
def test_zip64_records_are_in_the_digest(tmp_path, samples, back) -> None:
    _, source = sparse(tmp_path / "a.fhz", samples, [2**31] * 3)
    source.gap = 0
    tail = bytearray(source.tail)
    tail[-79 - back] ^= 1
    source.tail = bytes(tail)
    with pytest.raises(DamagedFileError):
        NativeFile(source, 0)


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
    "deflated to nothing less": (METHOD, "<H", 8, "may not be deflated so"),
    "packed otherwise": (METHOD, "<H", 14, "sizes that are not allowed"),
    "encrypted": (FLAGS, "<H", 1, "encrypted"),
    "data descriptor": (FLAGS, "<H", 8, "does not allow"),
    "utf-8 names": (FLAGS, "<H", 0x800, "does not allow"),
    "sizes differ": (SIZE, "<I", 5, "sizes that are not allowed"),
    "huge": (FULL_SIZE, "<I", 0xFFFFFFFF, "sizes that are not allowed"),
    "another date": (14, "<H", 0x5000, "does not allow"),
    "link": (38, "<I", 0o120777 << 16, "does not allow"),
    "extra field": (30, "<H", 4, "does not allow"),
    "comment of a member": (32, "<H", 1, "does not allow"),
    "another disk": (34, "<H", 1, "does not allow"),
    "offset outside": (OFFSET, "<I", 0x7FFFFFFF, "overlaps another or leaves a gap"),
    "zip64 offset without its field": (OFFSET, "<I", 0xFFFFFFFF, "does not allow|overlaps"),
    "longer name": (28, "<H", 0xFFFF, "not allowed"),
    "no mark": (0, "<I", 0, "a damaged entry"),
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
    "more than declared": (lambda data: deflated(bytes(1 << 26)), 1 << 20, "do not inflate"),
    "less than declared": (lambda data: deflated(data), 1 << 20, "do not inflate"),
    "beyond the limit": (lambda data: deflated(data), (16 << 20) + 1, "may not be deflated so"),
    "cut": (lambda data: deflated(data)[:-3], None, "do not inflate"),
    "with a tail": (lambda data: deflated(data) + b"tail", None, "do not inflate"),
    "no deflate": (lambda data: b"\xff" * 40, None, "deflated data are damaged"),
}


@pytest.mark.parametrize("case", DEFLATED)
def test_deflated_metadata(sample, samples, case) -> None:
    make, declared, message = DEFLATED[case]
    parts = samples.unpack(sample.read_bytes())
    data = dict(parts)[ROOT]
    # The CRC is right where the content is what is declared.
    crc = zlib.crc32(bytes(15 << 20) if case == "bomb" else data)
    container = samples.pack(parts, {ROOT: (make(data), declared or len(data), crc)})
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
    name, data = next(part for part in parts if not part[0].endswith(ROOT))
    packed = samples.pack(parts, {name: (deflated(data), len(data), zlib.crc32(data))})
    refused(sample, packed, "may not be deflated so")


@pytest.mark.parametrize(
    ("field", "form", "value", "message"),
    [
        (8, "<H", 3, "contradicts"),
        (10, "<H", 3, "contradicts|entries"),
        (12, "<I", 2**31, "does not end where"),
        (16, "<I", 1, "does not end where"),
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
    ("major", "advice"), [(b"2", "encode the source again"), (b"4", "upgrade")]
)
def test_another_format(sample, major, advice) -> None:
    data = sample.read_bytes()
    refused(
        sample,
        data.replace(b"fhash 3 sha256", b"fhash %s sha256" % major),
        rf"of format {major.decode()}\.x; this version reads format 3\.x: {advice}",
        UnsupportedFileError,
    )
