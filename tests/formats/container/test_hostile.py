"""Files made to do harm, each with all of its checksums right: refused, and before anything big is allocated."""

from __future__ import annotations

import json
import struct
import tracemalloc
import zlib

import numcodecs.zstd
import numpy as np
import pytest

from fhash_formats.container import Container
from fhash_formats.container.coding import PlainCoder, crc32c, plain_codecs
from fhash_formats.container.layout import Member, comment, deflated, ending, local_header
from fhash_formats.errors import DamagedFileError, UnsupportedFileError

ROOT = "zarr.json"
METHOD, FLAGS, CRC, SIZE, FULL_SIZE, OFFSET = 10, 8, 16, 20, 24, 42
"""Offsets of fields in a directory entry."""


def read_everything(path):
    with Container.open(path) as container:
        container.verify()
        for array in container.arrays.values():
            array.read()


def refused(path, data, message, kind=DamagedFileError):
    """Whether the file is refused for the right reason, with little memory."""
    path.write_bytes(data)
    tracemalloc.start()
    with pytest.raises(kind, match=message) as caught:
        read_everything(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert "\n" not in str(caught.value)
    assert peak < 20 * len(data) + (4 << 20)
    if kind is DamagedFileError:
        assert not isinstance(caught.value, UnsupportedFileError)


# -- the ZIP -------------------------------------------------------------------------------------------------------------------

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
def test_directory_entry(sample, samples, case):
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
def test_member_names(sample, samples, name):
    parts = samples.unpack(sample.read_bytes())
    refused(sample, samples.pack([(name, b"x"), *parts]), "not allowed")


def test_name_beyond_ascii(sample, samples):
    parts = [("coordx", b""), *samples.unpack(sample.read_bytes())]
    refused(
        sample,
        samples.reseal(samples.pack(parts).replace(b"coordx", "coor\u00e9".encode())),
        "not allowed",
    )


def test_duplicate_member(sample, samples):
    parts = samples.unpack(sample.read_bytes())
    refused(sample, samples.pack([*parts, parts[-1]]), "twice")


def test_overlapping_members(sample, samples):
    """The second entry points at the first member, as in a quoted-overlap ZIP bomb."""
    data = bytearray(sample.read_bytes())
    second = data.index(b"PK\x01\x02", samples.directory_at(bytes(data)) + 4)
    struct.pack_into("<I", data, second + OFFSET, 0)
    refused(sample, samples.reseal(bytes(data)), "overlaps")


def test_hidden_bytes_between_members_and_directory(sample, samples):
    data = sample.read_bytes()
    at = samples.directory_at(data)
    longer = bytearray(data[:at] + b"hidden" + data[at:])
    struct.pack_into("<I", longer, len(longer) - 79 - 6, at + 6)
    refused(sample, samples.reseal(bytes(longer)), "are declared")


def test_local_header_that_differs(sample):
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
def test_deflated_metadata(sample, samples, case):
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
    whole = b"".join([*chunks, ending(members)])
    sample.write_bytes(whole)
    tracemalloc.start()
    with pytest.raises(DamagedFileError, match=message):
        read_everything(sample)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # Metadata may be as large as they say, up to their limit, and are held as bytes, as text and as values at most.
    assert peak < 4 * (declared or len(whole)) + (4 << 20)


def test_chunks_are_never_deflated(sample, samples):
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


def test_version_1_has_nothing_deflated(sample, samples):
    data = sample.read_bytes()
    start = samples.directory_at(data)
    directory = data[start : -len(comment(b""))]
    refused(sample, data[:start] + directory + comment(directory, 1), "from layout version 2 on")
    stored = samples.pack(samples.unpack(data))
    start = samples.directory_at(stored)
    directory = stored[start : -len(comment(b""))]
    sample.write_bytes(stored[:start] + directory + comment(directory, 1))
    read_everything(sample)


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
def test_end_record(sample, samples, field, form, value, message):
    data = bytearray(sample.read_bytes())
    struct.pack_into(form, data, len(data) - 79 - 22 + field, value)
    # The digest is made right by hand, because the directory can no longer be found by the end record.
    start = samples.directory_at(sample.read_bytes())
    directory = bytes(data[start:-79])
    refused(sample, bytes(data[:start]) + directory + comment(directory), message)


def test_newer_layout(sample):
    data = sample.read_bytes()
    refused(
        sample,
        data.replace(b"fhash 2 sha256", b"fhash 3 sha256"),
        "newer fhash layout 3; this version reads up to 2; upgrade",
        UnsupportedFileError,
    )


# -- the hierarchy -------------------------------------------------------------------------------------------------------------


def edited(sample, samples, name, change):
    """The file with one JSON document changed in place by `change`."""
    parts = samples.unpack(sample.read_bytes())
    return samples.pack(
        [(n, changed_json(data, change) if n == name else data) for n, data in parts]
    )


def changed_json(data, change):
    values = json.loads(data)
    change(values)
    return json.dumps(values).encode()


DOCUMENT = "coords/time/zarr.json"
ARRAYS = {
    "huge shape": (lambda v: v.update(shape=[2**60]), "chunks; .* are declared", DamagedFileError),
    "huge chunk": (
        lambda v: v["chunk_grid"].update(configuration={"chunk_shape": [2**60]}),
        "limit",
        DamagedFileError,
    ),
    "both huge": (
        lambda v: v.update(
            shape=[2**60], chunk_grid={"name": "regular", "configuration": {"chunk_shape": [2**60]}}
        ),
        "limit",
        DamagedFileError,
    ),
    "larger chunk": (
        lambda v: v["chunk_grid"].update(configuration={"chunk_shape": [2**20]}),
        "zstd declares",
        DamagedFileError,
    ),
    "beyond": (lambda v: v.update(shape=[2**80]), "shape", DamagedFileError),
    "negative": (lambda v: v.update(shape=[-4]), "shape", DamagedFileError),
    "bool length": (lambda v: v.update(shape=[True]), "shape", DamagedFileError),
    "float length": (lambda v: v.update(shape=[4.0]), "shape", DamagedFileError),
    "many axes": (lambda v: v.update(shape=[1] * 99), "axes", DamagedFileError),
    "other rank": (lambda v: v.update(shape=[4, 1]), "axes", DamagedFileError),
    "wrong dtype": (
        lambda v: v.update(data_type="float32"),
        "zstd declares|asks for float64",
        DamagedFileError,
    ),
    "unknown dtype": (
        lambda v: v.update(data_type="complex128"),
        "data_type",
        UnsupportedFileError,
    ),
    "dtype object": (
        lambda v: v.update(data_type={"name": "object"}),
        "data_type",
        UnsupportedFileError,
    ),
    "unknown codec": (
        lambda v: v["codecs"].insert(1, {"name": "pickle"}),
        "codecs",
        UnsupportedFileError,
    ),
    "first codec": (
        lambda v: v["codecs"].__setitem__(0, {"name": "vlen-utf8"}),
        "codecs",
        UnsupportedFileError,
    ),
    "big endian": (
        lambda v: v["codecs"][0]["configuration"].update(endian="big"),
        "codecs",
        UnsupportedFileError,
    ),
    "no checksum": (lambda v: v["codecs"].pop(), "codecs", UnsupportedFileError),
    "no codecs": (lambda v: v.update(codecs=[]), "codecs", UnsupportedFileError),
    "codecs no list": (lambda v: v.update(codecs={"a": 1}), "codecs", DamagedFileError),
    "codec no object": (lambda v: v.update(codecs=["bytes", 5]), "codecs", DamagedFileError),
    "fill value": (lambda v: v.update(fill_value=1.0), "fill_value", UnsupportedFileError),
    "chunk keys": (
        lambda v: v["chunk_key_encoding"].update(name="v2"),
        "chunk_key_encoding",
        UnsupportedFileError,
    ),
    "chunk grid": (
        lambda v: v["chunk_grid"].update(name="rectangular"),
        "chunk_grid",
        UnsupportedFileError,
    ),
    "transformers": (
        lambda v: v.update(storage_transformers=[{"name": "x"}]),
        "storage_transformers",
        UnsupportedFileError,
    ),
    "unknown key": (
        lambda v: v.update(surprise={"must_understand": True}),
        "surprise",
        UnsupportedFileError,
    ),
    "attributes": (lambda v: v.update(attributes=[1]), "attributes", DamagedFileError),
    "missing key": (lambda v: v.pop("codecs"), "codecs is missing", DamagedFileError),
    "zarr 2": (lambda v: v.update(zarr_format=2), "Zarr v3", UnsupportedFileError),
    "node type": (lambda v: v.update(node_type="table"), "Zarr v3", UnsupportedFileError),
    "dimension names": (
        lambda v: v.update(dimension_names=[1]),
        "dimension_names",
        DamagedFileError,
    ),
}


@pytest.mark.parametrize("case", ARRAYS)
def test_array_metadata(sample, samples, case):
    change, message, kind = ARRAYS[case]
    refused(sample, edited(sample, samples, DOCUMENT, change), message, kind)


def test_key_that_need_not_be_understood(sample, samples):
    sample.write_bytes(
        edited(sample, samples, DOCUMENT, lambda v: v.update(surprise={"must_understand": False}))
    )
    read_everything(sample)


def extra_array(shape):
    metadata = {
        "shape": shape,
        "data_type": "uint8",
        "fill_value": 0,
        "chunk_key_encoding": {"name": "default"},
        "zarr_format": 3,
        "node_type": "array",
    }
    grid = {"name": "regular", "configuration": {"chunk_shape": [1] * len(shape)}}
    codecs = [
        {"name": "bytes"},
        {"name": "zstd", "configuration": {"level": 1, "checksum": False}},
        {"name": "crc32c"},
    ]
    return json.dumps({**metadata, "chunk_grid": grid, "codecs": codecs}).encode()


PLACES = {
    "chunk missing": (
        lambda p: [part for part in p if part[0] != "coords/time/c/0"],
        "coords/time has 0 chunks",
    ),
    "all but the root missing": (lambda p: p[-1:], "array coords/time is missing"),
    "root missing": (lambda p: p[:-1], "zarr.json is missing"),
    "nothing": (lambda p: [], "zarr.json is missing"),
    "group missing": (
        lambda p: [part for part in p if part[0] != "coords/zarr.json"],
        "lies in no group",
    ),
    "chunk outside the grid": (lambda p: [("coords/time/c/1", b"x"), *p], "member coords/time/c/1"),
    "chunk of other rank": (
        lambda p: [("coords/time/c/0/0", b"x"), *p],
        "member coords/time/c/0/0",
    ),
    "chunk under another name": (
        lambda p: [("coords/time/c/00", b"x"), *p],
        "member coords/time/c/00",
    ),
    "chunk number too long": (
        lambda p: [("coords/time/c/" + "9" * 400, b"x"), *p],
        "member coords/time/c/999",
    ),
    "chunk of no array": (lambda p: [("coords/none/c/0", b"x"), *p], "belongs to no array"),
    "file of no array": (lambda p: [("readme.txt", b"x"), *p], "belongs to no array"),
    "array in an array": (
        lambda p: [("coords/time/a/zarr.json", extra_array([1])), *p],
        "lies in no group",
    ),
    "many chunks declared": (
        lambda p: [("more/zarr.json", extra_array([2**31, 2**31])), *p],
        "has 0 chunks",
    ),
    "table missing": (
        lambda p: [part for part in p if not part[0].startswith("tables/level_2")],
        "tables/level_2 is missing",
    ),
}


@pytest.mark.parametrize("case", PLACES)
def test_members_and_arrays(sample, samples, case):
    change, message = PLACES[case]
    refused(sample, samples.pack(change(samples.unpack(sample.read_bytes()))), message)


TEXTS = {
    "NaN": (b'{"a": NaN}', "NaN"),
    "Infinity": (b'{"a": -Infinity}', "Infinity"),
    "beyond float64": (b'{"a": 1e999}', "beyond float64"),
    "many digits": (b'{"a": ' + b"9" * 5000 + b"}", "JSON"),
    "twice": (b'{"a": 1, "a": 2}', "twice"),
    "deep lists": (b'{"a": ' + b"[" * 100_000 + b"]" * 100_000 + b"}", "deep"),
    "deep objects": (b'{"a":' * 50_000 + b"1" + b"}" * 50_000, "deep"),
    "deep and cut": (b"[" * 1_000_000, "deep"),
    "no JSON": (b"zarr", "JSON"),
    "cut": (b'{"a": 1', "JSON"),
    "list": (b"[1]", "object"),
    "empty": (b"", "JSON"),
    "not UTF-8": (b'{"a": "\xff"}', "JSON"),
    "half a pair": (b'{"a": "\\ud800"}', "JSON"),
    "too long": (b" " * ((16 << 20) + 1), "limit"),
}


@pytest.mark.parametrize("case", TEXTS)
@pytest.mark.parametrize("name", [ROOT, DOCUMENT])
def test_metadata_text(sample, samples, case, name):
    text, message = TEXTS[case]
    parts = samples.unpack(sample.read_bytes())
    refused(
        sample,
        samples.pack([(n, text if n == name else data) for n, data in parts]),
        f"member {name}: .*{message}",
    )


ROOTS = {
    "newer major": (
        lambda v: v.update(format_version=[2, 0]),
        "newer fhash format 2.0; this version reads 1.x; upgrade",
        UnsupportedFileError,
    ),
    "older major": (lambda v: v.update(format_version=[0, 9]), "format_version", DamagedFileError),
    "feature": (
        lambda v: v.update(required_features=["teleport"]),
        "feature 'teleport'",
        UnsupportedFileError,
    ),
    "profile": (
        lambda v: v["model"].update(profile="magic"),
        "profile is 'magic'",
        UnsupportedFileError,
    ),
    "another format": (lambda v: v.update(format="zhash"), "format is 'zhash'", DamagedFileError),
}


@pytest.mark.parametrize("case", ROOTS)
def test_root(sample, samples, case):
    change, message, kind = ROOTS[case]
    refused(
        sample,
        edited(sample, samples, ROOT, lambda v: change(v["attributes"]["fhash"])),
        message,
        kind,
    )


def test_root_is_an_ordinary_zarr_group(sample, samples):
    refused(
        sample,
        edited(sample, samples, ROOT, lambda v: v.update(attributes={})),
        "not the group of an fhash container",
    )


def test_newer_minor_is_read(sample, samples):
    sample.write_bytes(
        edited(
            sample,
            samples,
            ROOT,
            lambda v: v["attributes"]["fhash"].update(format_version=[1, 7], novelty={"a": 1}),
        )
    )
    read_everything(sample)
    with Container.open(sample) as container:
        assert container.header["novelty"] == {"a": 1}


@pytest.mark.parametrize("steps", [[0, 0], [3, 0], [-1, 3], [0, 4]])
def test_key_frames_increase_within_the_domain(sample, samples, steps):
    coded = numcodecs.zstd.compress(np.array(steps, dtype="<i8"), 1)
    coded += struct.pack("<I", crc32c(coded))
    parts = samples.unpack(sample.read_bytes())
    refused(
        sample,
        samples.pack([(n, coded if n == "key_frames/c/0" else data) for n, data in parts]),
        "key_frames",
    )


# -- the data of a chunk -------------------------------------------------------------------------------------------------------


def frame(content, *, size=None):
    """A zstd frame of one raw block, which declares `size` bytes of content or, without, none (RFC 8878)."""
    head = (
        struct.pack("<IB", 0xFD2FB528, 0x00) + b"\x58"
        if size is None
        else struct.pack("<IBQ", 0xFD2FB528, 0xE0, size)
    )
    return head + struct.pack("<I", len(content) << 3 | 1)[:3] + content


CHUNKS = {
    "bomb": (
        lambda right: numcodecs.zstd.compress(bytes(1 << 26), 1),
        "zstd declares 67108864 bytes; the chunk has 32",
    ),
    "bomb of unknown size": (lambda right: frame(bytes(1 << 16)), "zstd declares None"),
    "bomb that lies": (lambda right: frame(bytes(1 << 16), size=32), "zstd data are damaged"),
    "two frames": (lambda right: numcodecs.zstd.compress(right, 1) * 2, "zstd data are damaged"),
    "fewer bytes": (lambda right: frame(right[:16], size=32), "zstd data are damaged"),
    "declares 2^63": (lambda right: frame(right, size=2**63), "zstd declares"),
    "other content": (lambda right: right, "not a zstd frame"),
    "empty": (lambda right: b"", "not a zstd frame"),
    "header only": (
        lambda right: frame(right, size=32)[:8],
        "the header of the zstd frame is cut short",
    ),
}


@pytest.mark.parametrize("case", CHUNKS)
def test_chunk_data(sample, samples, case):
    make, message = CHUNKS[case]
    coded = make(np.arange(4, dtype="<f8").tobytes())
    coded += struct.pack("<I", crc32c(coded))
    parts = samples.unpack(sample.read_bytes())
    data = samples.pack([(n, coded if n == "coords/time/c/0" else old) for n, old in parts])
    refused(sample, data, f"member coords/time/c/0: {message}")


def test_a_frame_cannot_declare_more_than_zstd_packs_into_its_bytes():
    """So that what does not fit in memory is not taken for damage, and damage not for a lack of memory."""
    float64 = np.dtype("<f8")
    most = PlainCoder(plain_codecs(float64)[:-1], float64, (2**17,))
    assert not most.decode(memoryview(numcodecs.zstd.compress(bytes(2**20), 19))).any()
    with pytest.raises(DamagedFileError, match="which 17 bytes cannot hold"):
        PlainCoder(plain_codecs(float64)[:-1], float64, (2**40,)).decode(
            memoryview(frame(b"abc"[:1], size=2**43))
        )


@pytest.mark.parametrize(
    "coded", [b"", b"abc", b"abcd", numcodecs.zstd.compress(bytes(32), 1) + b"abcd"]
)
def test_chunk_without_its_crc(sample, samples, coded):
    parts = samples.unpack(sample.read_bytes())
    data = samples.pack([(n, coded if n == "coords/time/c/0" else old) for n, old in parts])
    refused(sample, data, "member coords/time/c/0: .*CRC-32C")


def test_frame_made_by_hand_is_read(sample, samples):
    """The hostile frames above differ from this one only in what they are refused for."""
    right = np.arange(4, dtype="<f8")
    coded = frame(right.tobytes(), size=32)
    coded += struct.pack("<I", crc32c(coded))
    parts = samples.unpack(sample.read_bytes())
    sample.write_bytes(
        samples.pack([(n, coded if n == "coords/time/c/0" else old) for n, old in parts])
    )
    with Container.open(sample) as container:
        np.testing.assert_array_equal(container.arrays["coords/time"].read(), right)
