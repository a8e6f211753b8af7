"""Arrays of shards, read region by region: each inner chunk is read and decoded alone."""

from __future__ import annotations

import struct
import threading
import tracemalloc

import numpy as np
import pytest
import zarr
from sharded_files import NAME, PATH, random_values, write_sharded

from fhash_formats.container import Container
from fhash_formats.container import array as coding
from fhash_formats.container.array import ABSENT
from fhash_formats.container.remote import TAIL_BYTES
from fhash_formats.errors import DamagedFileError, InputError, RegionError
from fhash_formats.native import crc32c
from fhash_formats.support import threads as parallel

CASES = {
    "one shard": ((4, 6), (2, 3), (4, 6)),
    "shards that are full": ((8, 6), (2, 3), (4, 3)),
    "chunk_of inner chunks": ((7, 5), (2, 3), (4, 6)),
    "inner chunks beyond the end": ((3, 4), (2, 3), (8, 12)),
    "one inner chunk a shard": ((5, 5), (2, 2), (2, 2)),
    "four axes": ((5, 4, 6, 7), (2, 2, 3, 3), (4, 4, 6, 6)),
}


@pytest.mark.parametrize("case", CASES)
def test_every_region_reads_equal(tmp_path, samples, case) -> None:
    shape, chunk_shape, shard_shape = CASES[case]
    values = random_values(shape)
    path = write_sharded(
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
def test_zarr_library_reads_equal(tmp_path, samples, case) -> None:
    shape, chunk_shape, shard_shape = CASES[case]
    values = random_values(shape)
    path = write_sharded(tmp_path / "a.fhz", samples, values, chunk_shape, shard_shape)
    with zarr.storage.ZipStore(path, read_only=True) as store:
        array = zarr.open_array(store, path=PATH, mode="r")
        assert (array.chunks, array.shards) == (chunk_shape, shard_shape)
        np.testing.assert_array_equal(array[...], values)


def test_region_reads_only_the_index_and_its_inner_chunks(sharded_file) -> None:
    path, values = sharded_file
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


def test_of_a_large_index_only_the_entries_that_are_needed_are_read(tmp_path, samples) -> None:
    values = random_values((40, 6))
    path = write_sharded(tmp_path / "a.fhz", samples, values, (2, 3), (40, 6))
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


def test_several_inner_chunks_are_decoded_at_the_same_time(tmp_path, samples, monkeypatch) -> None:
    monkeypatch.setattr(parallel, "usable_threads", lambda: 4)
    together = threading.Barrier(4, timeout=30)

    class Waiting(coding.PlainCoder):
        def decode(self, data, lod=0):
            together.wait()
            return super().decode(data, lod)

    values = random_values((8,))
    path = write_sharded(tmp_path / "a.fhz", samples, values, (2,), (8,))
    monkeypatch.setitem(coding.ARRAY_CODECS, "bytes", Waiting)
    with Container.open(path) as container:
        np.testing.assert_array_equal(container.arrays[NAME].read((slice(1, 8),)), values[1:])
        # From the cache, without decoding and waiting.
        np.testing.assert_array_equal(container.arrays[NAME].read((slice(0, 7),)), values[:7])
        with pytest.raises(ValueError, match="read-only"):
            container.arrays[NAME].decode_chunk((1,))[:] = 0


class Halving:
    """A coder of its own, uncompressed: at level of detail n every 2^n-th value."""

    settings = axes = None
    masked = parted = False

    def __init__(self, codecs, dtype, shape):
        self.dtype, self.shape = dtype, shape
        assert list(codecs) == [{"name": "fhash.transform", "configuration": {"a": 1}}]

    def encode(self, chunk):
        return chunk.tobytes()

    def check(self, data):
        assert len(data) == self.dtype.itemsize * np.prod(self.shape)

    def decode(self, data, lod=0):
        return np.frombuffer(data, self.dtype).reshape(self.shape)[:: 1 << lod].copy()


def test_coded_chunks_and_levels_of_detail(tmp_path, samples, monkeypatch) -> None:
    monkeypatch.setitem(coding.ARRAY_CODECS, "fhash.transform", Halving)
    codecs = [{"name": "fhash.transform", "configuration": {"a": 1}}]
    values = random_values((12, 2))
    coded = {(i, 0): values[4 * i : 4 * i + 4].tobytes() for i in range(3)}
    # In any order within a shard.
    chunks = [((1, 0), coded[1, 0]), ((0, 0), coded[0, 0]), ((2, 0), coded[2, 0])]
    path = write_sharded(
        tmp_path / "a.fhz", samples, values, (4, 2), (8, 2), chunks=chunks, codecs=codecs
    )
    again = write_sharded(
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
def test_chunk_outside_the_grid(sharded_file, index) -> None:
    with (
        Container.open(sharded_file[0]) as container,
        pytest.raises(RegionError, match="outside the grid"),
    ):
        container.arrays[NAME].decode_chunk(index)


def test_damage_in_one_inner_chunk_leaves_the_others(sharded_file) -> None:
    path, values = sharded_file
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
            DamagedFileError, match=f"member {PATH}/c/0/0: inner chunk 0: its CRC-32C"
        ):
            container.arrays[NAME].read((slice(0, 1), slice(0, 1)))


ENTRIES = {
    "offset outside": ((2**60, None), "reaches beyond the shard"),
    "size outside": ((None, 2**60), "reaches beyond the shard"),
    "size into the index": ((0, -1), "reaches beyond the shard"),
    "sum that overflows": ((2**63, 2**63), "reaches beyond the shard"),
    "missing": ((ABSENT, ABSENT), "missing"),
    "half missing": ((None, ABSENT), "missing"),
    "another place": ((1, None), "inner chunk 9: its CRC-32C"),
    "nothing": ((0, 0), "inner chunk 9: "),
}


@pytest.mark.parametrize("case", ENTRIES)
def test_hostile_entry_that_is_read_alone(tmp_path, samples, case) -> None:
    (offset, size), message = ENTRIES[case]
    path = write_sharded(tmp_path / "a.fhz", samples, random_values((40,)), (2,), (40,))
    parts = samples.unpack(path.read_bytes())
    at = [name for name, _ in parts].index(f"{PATH}/c/0")
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
            container.arrays[NAME].read((slice(16, 18),)), random_values((40,))[16:18]
        )
        tracemalloc.start()
        with pytest.raises(DamagedFileError, match=f"member {PATH}/c/0: .*{message}"):
            container.arrays[NAME].read((slice(18, 20),))
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < 1 << 20
        with pytest.raises(DamagedFileError, match=f"member {PATH}/c/0: "):
            container.verify()


def remote(range_server, path) -> Container:
    container = Container.open(range_server.put("run.fhz", path.read_bytes()))
    range_server.taken()
    return container


def test_one_region_of_a_file_elsewhere_is_one_request(tmp_path, samples, range_server) -> None:
    values = random_values((8, 64, 80))
    path = write_sharded(tmp_path / "a.fhz", samples, values, (4, 16, 16), (8, 64, 80))
    assert path.stat().st_size > 8 * TAIL_BYTES
    with remote(range_server, path) as container:
        array = container.arrays[NAME]
        region = (slice(0, 4), slice(16, 32), slice(3, 9))
        np.testing.assert_array_equal(array.read(region), values[region])
        member = next(iter(array.chunks.values()))
        ((method, asked, status, size),) = range_server.log
        assert (method, status) == ("GET", 206)
        assert size < 5000 < member.size
        assert asked.startswith("bytes=")
        range_server.taken()
        array.read(region)
        assert range_server.taken() == (0, 0)
        region = (slice(4, 8), slice(0, 64), slice(0, 32))
        np.testing.assert_array_equal(array.read(region), values[region])
        requests, size = range_server.taken()
        assert requests == 1
        assert size <= 8 * 16 * 1028
        np.testing.assert_array_equal(array.read(), values)
        assert container.verify() == 2


def test_a_large_index_is_read_by_entries(tmp_path, samples, range_server) -> None:
    values = random_values((2, 2400, 4))
    path = write_sharded(tmp_path / "a.fhz", samples, values, (2, 1, 4), (2, 2400, 4))
    assert TAIL_BYTES < 2400 * 16
    with remote(range_server, path) as container:
        array = container.arrays[NAME]
        for rows in (slice(5, 6), slice(700, 720)):
            region = (slice(0, 2), rows, slice(0, 4))
            np.testing.assert_array_equal(array.read(region), values[region])
            requests, size = range_server.taken()
            assert requests == 2
            assert size <= 20 * 16 + 20 * 60


@pytest.mark.parametrize("gap", [0, 1 << 20])
def test_a_large_gap_reads_whole_indices(tmp_path, samples, gap, monkeypatch) -> None:
    values = random_values((2, 2400, 4))
    path = write_sharded(tmp_path / "a.fhz", samples, values, (2, 1, 4), (2, 2400, 4))
    with Container.open(path) as container:
        array = container.arrays[NAME]
        monkeypatch.setattr(container._source, "gap", gap)
        before = container.bytes_read
        region = (slice(0, 2), slice(5, 6), slice(0, 4))
        np.testing.assert_array_equal(array.read(region), values[region])
        read = container.bytes_read - before
        assert 30 <= read - (2400 * 16 + 4 if gap else 16) <= 60
