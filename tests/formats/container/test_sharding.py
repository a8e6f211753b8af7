"""Shards: many chunks in one member, each read and decoded alone."""

from __future__ import annotations

import json
import struct
import threading
import tracemalloc
from itertools import product

import numpy as np
import pytest
import zarr

from fhash_formats.container import Container, ContainerWriter, coding, shard_order
from fhash_formats.container.coding import crc32c
from fhash_formats.container.sharding import ABSENT, MAX_SHARD_CHUNKS, parse_index, sharding_codecs
from fhash_formats.errors import DamagedFileError, InputError, RegionError, UnsupportedFileError
from fhash_formats.support import threads as parallel

NAME = "extra/values"
CASES = {
    "one shard": ((4, 6), (2, 3), (4, 6)),
    "shards that are full": ((8, 6), (2, 3), (4, 3)),
    "cut inner chunks": ((7, 5), (2, 3), (4, 6)),
    "inner chunks beyond the end": ((3, 4), (2, 3), (8, 12)),
    "one inner chunk a shard": ((5, 5), (2, 2), (2, 2)),
    "four axes": ((5, 4, 6, 7), (2, 2, 3, 3), (4, 4, 6, 6)),
}


def cut(values, index, chunk_shape):
    return values[tuple(slice(i * n, (i + 1) * n) for i, n in zip(index, chunk_shape, strict=True))]


def write(path, samples, values, chunk_shape, shard_shape, chunks=None, **options):
    """A compact container with one more array, which is sharded."""
    header = samples.compact_header()
    if chunks is None:
        chunks = (
            cut(values, index, chunk_shape)
            for index in shard_order(values.shape, chunk_shape, shard_shape)
        )
    with ContainerWriter(path, force=True) as writer:
        writer.add_whole("tables/level_1", np.zeros(header["model"]["levels"][0], dtype=np.float32))
        settings = {
            "shape": values.shape,
            "dtype": values.dtype,
            "chunk_shape": chunk_shape,
            "shard_shape": shard_shape,
            **options,
        }
        writer.add_sharded(NAME, chunks=chunks, **settings)
        writer.commit(header)
    return path


def numbers(shape):
    return np.random.default_rng(3).standard_normal(shape).astype(np.float32)


@pytest.fixture
def file(tmp_path, samples):
    """Two shards of 2 x 2 inner chunks of 2 x 3, of which the last is cut, and its values."""
    values = numbers((7, 6))
    return write(tmp_path / "a.fhz", samples, values, (2, 3), (4, 6)), values


@pytest.mark.parametrize("case", CASES)
def test_every_region_reads_equal(tmp_path, samples, case):
    shape, chunk_shape, shard_shape = CASES[case]
    values = numbers(shape)
    path = write(
        tmp_path / "a.fhz",
        samples,
        values,
        chunk_shape,
        shard_shape,
        dimension_names=["a"] * len(shape),
        attributes={"a": 1},
    )
    rng = np.random.default_rng(0)
    with Container.open(path) as container:
        array = container.arrays[NAME]
        assert (array.shape, array.chunk_shape, array.shard_shape) == (
            shape,
            chunk_shape,
            shard_shape,
        )
        assert array.grid == tuple(-(-n // c) for n, c in zip(shape, chunk_shape, strict=True))
        assert array.attributes == {"a": 1}
        np.testing.assert_array_equal(array.read(), values)
        for _ in range(40):
            region = tuple(slice(*sorted(int(i) for i in rng.integers(0, n + 1, 2))) for n in shape)
            np.testing.assert_array_equal(array.read(region), values[region])
        assert container.verify() == 2


@pytest.mark.parametrize("case", CASES)
def test_zarr_library_reads_equal(tmp_path, samples, case):
    shape, chunk_shape, shard_shape = CASES[case]
    values = numbers(shape)
    path = write(tmp_path / "a.fhz", samples, values, chunk_shape, shard_shape)
    with zarr.storage.ZipStore(path, read_only=True) as store:
        array = zarr.open_array(store, path=NAME, mode="r")
        assert (array.chunks, array.shards) == (chunk_shape, shard_shape)
        np.testing.assert_array_equal(array[...], values)


def test_bytes_of_a_shard(tmp_path, samples):
    """Inner chunks in C order without gaps, then (offset, bytes) of each, then the CRC-32C of these."""
    values = np.arange(3, dtype=np.uint8)
    path = write(tmp_path / "a.fhz", samples, values, (2,), (6,))
    with Container.open(path) as container:
        member = container.arrays[NAME].chunks[0,]
    data = path.read_bytes()[member.data_offset : member.end]
    coder = coding.chunk_coder(coding.plain_codecs(values.dtype), values.dtype, (2,))
    first, second = coder.encode(values[:2]), coder.encode(np.array([2, 0], np.uint8))
    index = struct.pack("<6Q", 0, len(first), len(first), len(second), ABSENT, ABSENT)
    assert data == first + second + index + struct.pack("<I", crc32c(index))


def test_region_reads_only_the_index_and_its_inner_chunks(file):
    path, values = file
    with Container.open(path) as container:
        array = container.arrays[NAME]
        before = container.bytes_read
        reads = []
        read = container._source.read
        container._source.read = lambda offset, size: (
            reads.append((offset, size)) or read(offset, size)
        )
        np.testing.assert_array_equal(array.read((slice(2, 4), slice(3, 5))), values[2:4, 3:5])
        member = array.chunks[0, 0]
        index_bytes = 4 * 16 + 4
        assert reads[0] == (member.end - index_bytes, index_bytes)
        offset, size = reads[1]
        assert len(reads) == 2
        assert member.data_offset < offset
        assert offset + size == member.end - index_bytes
        assert container.bytes_read == before + index_bytes + size
        array.read((slice(2, 4), slice(3, 6)))
        assert len(reads) == 2
        array.read((slice(0, 2), slice(3, 6)))
        assert len(reads) == 3


def test_of_a_large_index_only_the_entries_that_are_needed_are_read(tmp_path, samples):
    values = numbers((40, 6))
    path = write(tmp_path / "a.fhz", samples, values, (2, 3), (40, 6))
    with Container.open(path) as container:
        array = container.arrays[NAME]
        member = array.chunks[0, 0]
        start, reads, read = member.end - 4 - 40 * 16, [], container._source.read
        container._source.read = lambda offset, size: (
            reads.append((offset, size)) or read(offset, size)
        )
        np.testing.assert_array_equal(array.read((slice(3, 5), slice(0, 2))), values[3:5, :2])
        entries = [at for at in reads if at[0] >= start]
        assert entries == [(start + 2 * 16, 16), (start + 4 * 16, 16)]
        before = container.bytes_read
        np.testing.assert_array_equal(array.read((slice(2, 6), slice(0, 3))), values[2:6, :3])
        assert container.bytes_read == before
        np.testing.assert_array_equal(array.read((slice(0, 40), slice(0, 1))), values[:, :1])
        assert (start, 40 * 16 + 4) in reads


def test_several_inner_chunks_are_decoded_at_the_same_time(tmp_path, samples, monkeypatch):
    monkeypatch.setattr(parallel, "usable_threads", lambda: 4)
    together = threading.Barrier(4, timeout=30)

    class Waiting(coding.PlainCoder):
        def decode(self, data):
            together.wait()
            return super().decode(data)

    values = numbers((8,))
    path = write(tmp_path / "a.fhz", samples, values, (2,), (8,))
    monkeypatch.setitem(coding.ARRAY_CODECS, "bytes", Waiting)
    with Container.open(path) as container:
        np.testing.assert_array_equal(container.arrays[NAME].read((slice(1, 8),)), values[1:])
        # From the cache, without decoding and waiting.
        np.testing.assert_array_equal(container.arrays[NAME].read((slice(0, 7),)), values[:7])
        with pytest.raises(ValueError, match="read-only"):
            container.arrays[NAME].decode_chunk((1,))[:] = 0


class Halving:
    """A coder of its own, uncompressed: at level of detail n every 2^n-th value."""

    def __init__(self, codecs, dtype, shape):
        self.dtype, self.shape = dtype, shape
        assert list(codecs) == [{"name": "fhash.transform", "configuration": {"a": 1}}]

    def encode(self, chunk):
        return chunk.tobytes()

    def decode(self, data, lod=0):
        return np.frombuffer(data, self.dtype).reshape(self.shape)[:: 1 << lod].copy()


def test_coded_chunks_and_levels_of_detail(tmp_path, samples, monkeypatch):
    monkeypatch.setitem(coding.ARRAY_CODECS, "fhash.transform", Halving)
    codecs = [{"name": "fhash.transform", "configuration": {"a": 1}}, {"name": "crc32c"}]
    values = numbers((12, 2))
    coded = {(i, 0): values[4 * i : 4 * i + 4].tobytes() for i in range(3)}
    # In any order within a shard.
    chunks = [((1, 0), coded[1, 0]), ((0, 0), coded[0, 0]), ((2, 0), coded[2, 0])]
    path = write(tmp_path / "a.fhz", samples, values, (4, 2), (8, 2), chunks=chunks, codecs=codecs)
    again = write(
        tmp_path / "b.fhz", samples, values, (4, 2), (8, 2), chunks=coded.values(), codecs=codecs
    )
    assert path.read_bytes() == again.read_bytes()
    with Container.open(path) as container:
        array = container.arrays[NAME]
        np.testing.assert_array_equal(array.read(), values)
        np.testing.assert_array_equal(array.decode_chunk((1, 0)), values[4:8])
        np.testing.assert_array_equal(array.decode_chunk((1, 0), 1), values[4:8:2])
        before = container.bytes_read
        np.testing.assert_array_equal(array.decode_chunk((1, 0), lod=1), values[4:8:2])
        np.testing.assert_array_equal(array.decode_chunk((1, 0)), values[4:8])
        assert container.bytes_read == before
        container.verify()
        with pytest.raises(InputError, match="level of detail -1"):
            array.decode_chunk((0, 0), -1)
        with pytest.raises(InputError, match="level of detail 1"):
            container.arrays["tables/level_1"].decode_chunk((0, 0, 0, 0), 1)


@pytest.mark.parametrize("index", [(4, 0), (0, 2), (-1, 0), (0,)])
def test_chunk_outside_the_grid(file, index):
    with Container.open(file[0]) as container, pytest.raises(RegionError, match="outside the grid"):
        container.arrays[NAME].decode_chunk(index)


def test_no_more_than_one_shard_is_held(tmp_path, samples):
    """While a shard is given, those before it are in the file."""
    values = np.random.default_rng(0).integers(0, 256, (16, 1 << 16), dtype=np.uint8)

    def chunks():
        for i in range(16):
            if i == 15:
                assert tracemalloc.get_traced_memory()[0] - begun < 3 << 17
            yield values[i : i + 1]

    tracemalloc.start()
    begun = tracemalloc.get_traced_memory()[0]
    write(tmp_path / "a.fhz", samples, values, (1, 1 << 16), (2, 1 << 16), chunks=chunks())
    tracemalloc.stop()


BAD_CHUNKS = {
    "too few": (lambda given: given[:-1], "was not given"),
    "too many": (lambda given: [*given, given[0]], "more chunks"),
    "of a later shard": (lambda given: [((2, 0), given[4])], r"chunk \(2, 0\) is none of shard"),
    "twice": (lambda given: [((0, 0), given[0]), ((0, 0), given[0])], "given twice"),
    "in order after all": (lambda given: [((0, 1), given[1]), given[0], given[0]], "given twice"),
    "other type": (lambda given: [given[0].astype(np.float64)], r"float64 \(2, 3\)"),
    "other shape": (lambda given: [given[0][:1]], r"float32 \(1, 3\)"),
}


@pytest.mark.parametrize("case", BAD_CHUNKS)
def test_chunks_that_do_not_fit(tmp_path, samples, case):
    change, message = BAD_CHUNKS[case]
    values = numbers((7, 6))
    given = [cut(values, index, (2, 3)) for index in shard_order((7, 6), (2, 3), (4, 6))]
    with pytest.raises(InputError, match=message):
        write(tmp_path / "a.fhz", samples, values, (2, 3), (4, 6), chunks=change(given))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("chunk_shape", "shard_shape"),
    [((2, 3), (4, 7)), ((2,), (4, 6)), ((2, 0), (4, 6)), ((1, 1), (2048, 2048))],
)
def test_shards_that_do_not_fit(tmp_path, samples, chunk_shape, shard_shape):
    with pytest.raises(InputError, match="sharding_indexed"):
        write(tmp_path / "a.fhz", samples, numbers((7, 6)), chunk_shape, shard_shape, chunks=[])


def test_shards_need_the_feature(tmp_path, samples):
    header = samples.header()
    with ContainerWriter(tmp_path / "a.fhz") as writer:
        for name, array in samples.arrays(header).items():
            writer.add_whole(name, array)
        writer.add_sharded(
            NAME,
            shape=(2,),
            dtype="uint8",
            chunk_shape=(1,),
            shard_shape=(2,),
            chunks=[np.zeros(1, np.uint8)] * 2,
        )
        with pytest.raises(
            InputError, match="array extra/values has codecs of the feature transform"
        ):
            writer.commit(header)
        writer.commit({**header, "required_features": ["transform"]})


# -- hostile -------------------------------------------------------------------------------------------------------------------

BIG = 2**60
INDICES = {
    "offset outside": (lambda t: t[1].__setitem__(0, BIG), "overlap"),
    "size outside": (lambda t: t[1].__setitem__(1, BIG), "larger than the shard"),
    "sizes that overflow": (
        lambda t: (t[0].__setitem__(1, 2**63), t[1].__setitem__(1, 2**63)),
        "larger than the shard",
    ),
    "overlap": (lambda t: t[1].__setitem__(0, 0), "overlap"),
    "two at one place": (lambda t: t.__setitem__(1, list(t[0])), "overlap"),
    "gap": (lambda t: t[1].__setitem__(1, t[1][1] - 1), "overlap"),
    "exchanged": (lambda t: t.__setitem__(slice(0, 2), [t[1], t[0]]), "overlap"),
    "missing": (lambda t: t.__setitem__(1, [ABSENT, ABSENT]), "missing"),
    "half missing": (lambda t: t[1].__setitem__(0, ABSENT), "missing"),
    "beyond the array": (lambda t: t.__setitem__(3, [0, 5]), "beyond the end"),
    "empty": (
        lambda t: (
            t[2].__setitem__(1, 0),
            t[1].__setitem__(1, t[1][1] + t[2][1]),
            t[2].__setitem__(0, t[2][0] + 10**6),
        ),
        "overlap",
    ),
}


@pytest.fixture
def line(tmp_path, samples):
    """One shard of four inner chunks, the last beyond the end; its parts for `samples.pack`, and where the shard is among them."""
    path = write(tmp_path / "a.fhz", samples, numbers((5,)), (2,), (8,))
    parts = samples.unpack(path.read_bytes())
    return path, parts, [name for name, _ in parts].index(f"{NAME}/c/0")


def refused(path, samples, parts, message, kind=DamagedFileError):
    path.write_bytes(samples.pack(parts))
    for act in (
        lambda c: c.arrays[NAME].read(),
        lambda c: c.arrays[NAME].read((slice(2, 3),)),
        lambda c: c.verify(),
    ):
        tracemalloc.start()
        with pytest.raises(kind, match=message) as caught, Container.open(path) as container:
            act(container)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < 4 << 20
        assert str(caught.value).startswith(f"{path}: ")
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("case", INDICES)
def test_hostile_index(line, samples, case):
    change, message = INDICES[case]
    path, parts, at = line
    name, data = parts[at]
    table = [list(entry) for entry in struct.iter_unpack("<2Q", data[-68:-4])]
    change(table)
    index = b"".join(struct.pack("<2Q", *entry) for entry in table)
    parts[at] = name, data[:-68] + index + struct.pack("<I", crc32c(index))
    refused(path, samples, parts, f"member {NAME}/c/0: .*{message}")


ENTRIES = {
    "offset outside": ((BIG, None), "reaches beyond the shard"),
    "size outside": ((None, BIG), "reaches beyond the shard"),
    "size into the index": ((0, -1), "reaches beyond the shard"),
    "sum that overflows": ((2**63, 2**63), "reaches beyond the shard"),
    "missing": ((ABSENT, ABSENT), "missing"),
    "half missing": ((None, ABSENT), "missing"),
    "another place": ((1, None), "inner chunk 9: its CRC-32C"),
    "nothing": ((0, 0), "inner chunk 9: "),
}


@pytest.mark.parametrize("case", ENTRIES)
def test_hostile_entry_that_is_read_alone(tmp_path, samples, case):
    (offset, size), message = ENTRIES[case]
    path = write(tmp_path / "a.fhz", samples, numbers((40,)), (2,), (40,))
    parts = samples.unpack(path.read_bytes())
    at = [name for name, _ in parts].index(f"{NAME}/c/0")
    name, data = parts[at]
    index = 20 * 16 + 4
    table = [list(entry) for entry in struct.iter_unpack("<2Q", data[-index:-4])]
    size = len(data) - index + 1 if size == -1 else size
    table[9] = [table[9][0] if offset is None else offset, table[9][1] if size is None else size]
    coded = b"".join(struct.pack("<2Q", *entry) for entry in table)
    parts[at] = name, data[:-index] + coded + struct.pack("<I", crc32c(coded))
    path.write_bytes(samples.pack(parts))
    with Container.open(path) as container:
        np.testing.assert_array_equal(
            container.arrays[NAME].read((slice(16, 18),)), numbers((40,))[16:18]
        )
        tracemalloc.start()
        with pytest.raises(DamagedFileError, match=f"member {NAME}/c/0: .*{message}"):
            container.arrays[NAME].read((slice(18, 20),))
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < 1 << 20
        with pytest.raises(DamagedFileError, match=f"member {NAME}/c/0: "):
            container.verify()


def test_index_with_a_wrong_checksum(line, samples):
    path, parts, at = line
    name, data = parts[at]
    parts[at] = name, data[:-1] + bytes([data[-1] ^ 1])
    refused(path, samples, parts, f"member {NAME}/c/0: the CRC-32C of the shard's index")


@pytest.mark.parametrize("data", [b"", b"x" * 67])
def test_shard_shorter_than_its_index(line, samples, data):
    path, parts, at = line
    parts[at] = parts[at][0], data
    refused(path, samples, parts, f"member {NAME}/c/0: {len(data)} bytes are too few")


def test_shards_that_declare_much(line, samples):
    """A million inner chunks of a gibibyte each, in a few bytes."""
    path, parts, _ = line
    place = [name for name, _ in parts].index(f"{NAME}/zarr.json")
    text = parts[place][1].decode()
    many = text.replace('"chunk_shape":[8]', f'"chunk_shape":[{2**48}]').replace(
        '"chunk_shape":[2]', f'"chunk_shape":[{2**28}]'
    )
    assert MAX_SHARD_CHUNKS == 2**20
    parts[place] = parts[place][0], many.replace('"shape":[5]', f'"shape":[{2**48}]').encode()
    refused(path, samples, parts, "too few for the index|memory")


SETTINGS = {
    "index at the beginning": ({"index_location": "start"}, UnsupportedFileError),
    "index without checksum": (
        {"index_codecs": [{"name": "bytes", "configuration": {"endian": "little"}}]},
        UnsupportedFileError,
    ),
    "another setting": ({"surprise": 1}, UnsupportedFileError),
    "no codecs": ({"codecs": []}, UnsupportedFileError),
    "codecs no list": ({"codecs": {"a": 1}}, DamagedFileError),
    "inner codecs without checksum": (
        {"codecs": coding.plain_codecs(np.dtype("f4"))[:-1]},
        UnsupportedFileError,
    ),
    "shards in shards": (
        {"codecs": sharding_codecs([1], coding.plain_codecs(np.dtype("f4")))},
        UnsupportedFileError,
    ),
    "chunk no list": ({"chunk_shape": 2}, DamagedFileError),
    "chunk of other rank": ({"chunk_shape": [2, 2]}, DamagedFileError),
    "chunk of a fraction": ({"chunk_shape": [2.0]}, DamagedFileError),
    "chunk of zero": ({"chunk_shape": [0]}, DamagedFileError),
    "no divisor": ({"chunk_shape": [3]}, DamagedFileError),
}


@pytest.mark.parametrize("case", SETTINGS)
def test_settings_that_are_refused(line, samples, case):
    changes, kind = SETTINGS[case]
    path, parts, _ = line
    place = [name for name, _ in parts].index(f"{NAME}/zarr.json")
    document = json.loads(parts[place][1])
    document["codecs"][0]["configuration"].update(changes)
    parts[place] = parts[place][0], json.dumps(document).encode()
    refused(path, samples, parts, f"member {NAME}/zarr.json: ", kind)


@pytest.mark.parametrize(
    "change", [lambda c: c.append({"name": "crc32c"}), lambda c: c[0].pop("configuration")]
)
def test_sharding_stands_alone(line, samples, change):
    path, parts, _ = line
    place = [name for name, _ in parts].index(f"{NAME}/zarr.json")
    document = json.loads(parts[place][1])
    change(document["codecs"])
    parts[place] = parts[place][0], json.dumps(document).encode()
    refused(path, samples, parts, "sharding_indexed", UnsupportedFileError)


def test_every_flip_in_a_shard_is_found(file):
    path, _ = file
    with Container.open(path) as container:
        members = list(container.arrays[NAME].chunks.values())
    sound = path.read_bytes()
    for member in members:
        for at in range(member.offset, member.end):
            damaged = bytearray(sound)
            damaged[at] ^= 4
            path.write_bytes(damaged)
            with (
                pytest.raises(DamagedFileError, match=f"member {NAME}/c/"),
                Container.open(path) as container,
            ):
                container.verify()
            if at >= member.data_offset:
                with (
                    pytest.raises(DamagedFileError, match=f"member {NAME}/c/"),
                    Container.open(path) as container,
                ):
                    container.arrays[NAME].read()


def test_damage_in_one_inner_chunk_leaves_the_others(file):
    path, values = file
    with Container.open(path) as container:
        member = container.arrays[NAME].chunks[0, 0]
    damaged = bytearray(path.read_bytes())
    damaged[member.data_offset + 5] ^= 1
    path.write_bytes(damaged)
    with Container.open(path) as container:
        np.testing.assert_array_equal(
            container.arrays[NAME].read((slice(2, 7), slice(0, 6))), values[2:]
        )
        with pytest.raises(
            DamagedFileError, match=f"member {NAME}/c/0/0: inner chunk 0: its CRC-32C"
        ):
            container.arrays[NAME].read((slice(0, 1), slice(0, 1)))


def test_index_of_a_full_shard():
    index = struct.pack("<4Q", 0, 5, 5, 7)
    found = parse_index(index + struct.pack("<I", crc32c(index)), np.array([True, True]), 12)
    assert found.tolist() == [[0, 5], [5, 7]]


def test_order_of_the_file():
    order = list(shard_order((5, 3), (2, 1), (4, 2)))
    assert order == [(0, 0), (0, 1), (1, 0), (1, 1), (0, 2), (1, 2), (2, 0), (2, 1), (2, 2)]
    assert sorted(order) == list(product(range(3), range(3)))
