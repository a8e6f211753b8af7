"""Arrays of an open container, dense and sparse, by region, by us and by the zarr library."""

from __future__ import annotations

import struct
import threading
import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from sharded_files import NAME, PATH, random_values, write_sharded
from table_files import HEAD, PLAIN

from fhash_formats.container import FORMAT_VERSION, Container, ContainerWriter, validate_header
from fhash_formats.container import array as coding
from fhash_formats.container.array import ABSENT, transform_codecs
from fhash_formats.container.header import COUNTS, SPARSE_FEATURE
from fhash_formats.container.remote import TAIL_BYTES
from fhash_formats.container.stored import (
    MOST_APART,
    Ahead,
    ChunkCache,
    StoredArray,
    chunks_after,
)
from fhash_formats.errors import DamagedFileError, InputError, RegionError
from fhash_formats.native import crc32c
from fhash_formats.support import threads as parallel
from fhash_formats.support.values import DTYPES
from fhash_formats.transform import tile as decoding
from fhash_formats.transform.tile import Coding, decode_tile, encode_tile


def values_of(dtype, shape):
    rng = np.random.default_rng(1)
    if np.dtype(dtype).kind == "f":
        values = rng.standard_normal(shape).astype(dtype)
        values.reshape(-1)[-3:] = [np.nan, np.inf, -0.0][-values.size :]
        return values
    limits = np.iinfo(dtype)
    return rng.integers(limits.min, limits.max, shape, dtype=dtype, endpoint=True)


SHAPES = {
    "line": ((7,), (3,)),
    "one": ((1,), (1,)),
    "plane": ((5, 4), (2, 4)),
    "larger": ((2, 3), (4, 5)),
    "five": ((2, 3, 4, 5, 2), (1, 2, 3, 4, 2)),
}


@pytest.fixture
def everything(tmp_path, samples):
    """A container with an extra array for each type and chunking, and the values of all arrays."""
    header = samples.header()
    arrays = samples.arrays(header)
    path = tmp_path / "all.fhz"
    with ContainerWriter(path) as writer:
        for name, array in arrays.items():
            writer.add_whole(name, array)
        for dtype, (name, (shape, chunk)) in product(DTYPES, SHAPES.items()):
            arrays[f"extra/{name}/{dtype}"] = array = values_of(dtype, shape)
            names = [f"axis_{n}" for n in range(len(shape))]
            writer.add_whole(
                f"extra/{name}/{dtype}",
                array,
                chunk_shape=chunk,
                dimension_names=names,
                attributes={"of": name},
            )
        writer.commit(header)
    return path, arrays


def test_every_type_and_chunking_reads_equal(everything) -> None:
    path, arrays = everything
    with Container.open(path) as container:
        assert list(container.arrays) == list(arrays)
        assert container.verify() == len(arrays)
        for name, array in arrays.items():
            stored = container.arrays[name]
            assert stored.read().tobytes() == array.tobytes()
            assert (stored.shape, stored.dtype) == (array.shape, array.dtype)
        assert container.arrays["extra/five/int8"].attributes == {"of": "five"}
        assert container.arrays["extra/line/int8"].dimension_names == ("axis_0",)
        assert container.arrays["key_frames"].dimension_names is None


def test_zarr_library_reads_every_array_equal(everything) -> None:
    path, arrays = everything
    with Container.open(path) as container:
        paths = {name: array.name for name, array in container.arrays.items()}
    store = zarr.storage.ZipStore(path, read_only=True)
    group = zarr.open_group(store, mode="r")
    for name, array in arrays.items():
        read = group[paths[name]]
        assert read.dtype == array.dtype
        assert read[...].tobytes() == array.tobytes()
    assert group["parts/0.extra.five.int8"].attrs.asdict() == {"of": "five"}
    assert group["parts/0.extra.plane.int8"].metadata.dimension_names == ("axis_0", "axis_1")
    assert group.attrs["fhash"]["format_version"] == list(FORMAT_VERSION)
    store.close()


def regions(shape, count):
    rng = np.random.default_rng(2)
    for _ in range(count):
        ends = [sorted(rng.integers(0, n + 1, 2)) for n in shape]
        yield tuple(slice(int(a), int(b)) for a, b in ends)


def reads_of(container: Container) -> list[tuple[int, int]]:
    """Offsets and sizes of what is read from now on."""
    reads, read = [], container._source.read
    container._source.read = lambda offset, size: reads.append((offset, size)) or read(offset, size)
    return reads


def test_region_touches_only_its_chunks_and_once(sample) -> None:
    with Container.open(sample) as container:
        reads = reads_of(container)
        table = container.arrays["tables/level_1"]
        region = (slice(0, 1), slice(1, 3), slice(0, 3), slice(0, 6), slice(0, 2))
        table.read(region)
        assert sorted(offset for offset, _ in reads) == sorted(
            table.chunks[index].offset for index in [(0, 0, 0, 0, 0), (0, 1, 0, 0, 0)]
        )
        table.read(region)
        assert len(reads) == 2


def test_result_is_the_callers_own(sample) -> None:
    with Container.open(sample) as container:
        table = container.arrays["tables/level_2"]
        everything = tuple(slice(0, n) for n in table.shape)
        table.read(everything)[:] = 0
        assert np.all(table.read(everything) != 0)


def test_threads_read_what_one_reads(everything) -> None:
    path, arrays = everything
    table = arrays["extra/five/float64"]
    with Container.open(path, cache_bytes=1000) as container, ThreadPoolExecutor(8) as pool:
        asked = list(regions(table.shape, 300))
        for region, read in zip(
            asked, pool.map(container.arrays["extra/five/float64"].read, asked), strict=True
        ):
            np.testing.assert_array_equal(read, table[region])


def test_disk_error_while_reading(sample, monkeypatch) -> None:
    def fail(offset, size):
        raise OSError(5, "Input/output error")

    with Container.open(sample) as container:
        monkeypatch.setattr(container._source, "read", fail)
        with pytest.raises(DamagedFileError, match="cannot be read: Input/output error"):
            container.arrays["mlp/weight_1"].read()


def test_what_does_not_fit_in_memory_is_not_called_damaged(sample, monkeypatch) -> None:
    """Or a sound file might be thrown away."""
    with Container.open(sample) as container:
        array = container.arrays["mlp/weight_1"]
        monkeypatch.setattr(
            array, "_decode", lambda index, lod: (_ for _ in ()).throw(MemoryError())
        )
        with pytest.raises(MemoryError):
            array.read()


def test_reads_that_go_on_decode_the_next_chunk_in_a_thread_that_is_free(
    tmp_path, samples, monkeypatch
) -> None:
    values = random_values((5, 4))
    path = write_sharded(tmp_path / "a.fhz", samples, values, (1, 4), (5, 4))
    decoded: list[tuple[int, ...]] = []
    real = StoredArray._decode

    def decode(self, index, lod=0, *, table=False):
        decoded.append(tuple(index))
        if tuple(index) == (4, 0):
            raise DamagedFileError("a damaged chunk")
        return real(self, index, lod, table=table)

    monkeypatch.setattr(StoredArray, "_decode", decode)
    expected = {"1": [0, 1, 2, 3], "2": [0, 1, 2, 3, 4]}
    for threads, chunks in expected.items():
        monkeypatch.setenv("FHASH_THREADS", threads)
        with Container.open(path) as container:
            array = container.arrays[NAME]
            decoded.clear()
            for step in range(4):
                part = array.read((slice(step, step + 1), slice(0, 4)))
                np.testing.assert_array_equal(part[0], values[step])
            assert sorted(decoded) == [(step, 0) for step in chunks]
            # What was damaged ahead of the reader is damaged when it is read.
            with pytest.raises(DamagedFileError, match="a damaged chunk"):
                array.read((slice(4, 5), slice(0, 4)))


def test_a_small_part_of_a_tile_comes_without_the_rest_and_the_rest_later(
    tmp_path, samples, monkeypatch
) -> None:
    shape = (2, 9, 10, 11)
    settings = replace(PLAIN, head=HEAD)
    values = np.random.default_rng(1).normal(0.5, 0.8, shape).clip(-2, 3).astype("f4")
    stream = encode_tile(values, settings).data
    whole = decode_tile(stream, shape, "f4", settings)
    path = write_sharded(
        tmp_path / "a.fhz",
        samples,
        values,
        shape,
        shape,
        [stream],
        codecs=transform_codecs(settings),
    )
    asked: list[str] = []
    real = decoding._call

    def call(name, *arguments):
        asked.append(name)
        return real(name, *arguments)

    monkeypatch.setattr(decoding, "_call", call)
    part = (slice(1, 2), slice(0, 2), slice(3, 5), slice(9, 11))
    with Container.open(path) as container:
        array = container.arrays[NAME]
        for _ in range(3):
            assert array.read(part).tobytes() == whole[part].tobytes()
        # First the part, then all of the tile by its table, then from the cache.
        parts = ["fhash_tile_uncorrected", "fhash_tile_part", "fhash_tile_part"]
        assert asked == parts
        assert array.decode_chunk((0, 0, 0, 0)).tobytes() == whole.tobytes()
        assert array.read().tobytes() == whole.tobytes()


def test_small_parts_of_a_tile_in_blocks_come_from_some_of_them_and_then_from_all(
    tmp_path, samples, monkeypatch
) -> None:
    shape = (2, 16, 16, 32)
    values = np.random.default_rng(1).normal(0.5, 0.8, shape).clip(-2, 3).astype("f4")
    stream = encode_tile(values, PLAIN, Coding(cut=3 << 4 | 3 << 8 | 4 << 12)).data
    whole = decode_tile(stream, shape, "f4", PLAIN)
    path = write_sharded(
        tmp_path / "a.fhz", samples, values, shape, shape, [stream], codecs=transform_codecs(PLAIN)
    )
    asked: list[str] = []
    real = decoding._call

    def call(name, *arguments):
        asked.append(name)
        return real(name, *arguments)

    monkeypatch.setattr(decoding, "_call", call)
    parts = [(slice(t, t + 1), slice(0, 2), slice(2, 4), slice(20, 22)) for t in (0, 1)]
    with Container.open(path) as container:
        array = container.arrays[NAME]
        for _ in range(4):
            for part in parts:
                assert array.read(part).tobytes() == whole[part].tobytes()
        assert asked == ["fhash_tile_region"] * MOST_APART + ["fhash_tile_decode"]
        assert array.read().tobytes() == whole.tobytes()


def chunk(size: int = 100) -> np.ndarray:
    return np.zeros(size, dtype=np.uint8)


def test_the_least_recently_used_chunk_is_dropped_first() -> None:
    cache, kept = ChunkCache(300), chunk()
    cache.put(("a", (0,), 0), kept)
    cache.put(("a", (1,), 0), chunk())
    cache.put(("a", (0,), 1), chunk())
    assert cache.get(("a", (0,), 0)) is kept
    cache.put(("b", (0,), 0), chunk())
    assert cache.get(("a", (1,), 0)) is None
    assert cache.get(("a", (0,), 0)) is kept
    cache.clear()
    assert cache.get(("a", (0,), 0)) is None


def test_cache_holds_no_more_than_its_limit(sample) -> None:
    with Container.open(sample, cache_bytes=200) as container:
        table = container.arrays["tables/level_1"]
        for _ in range(2):
            table.read(tuple(slice(0, n) for n in table.shape))
        assert 0 < container._cache._bytes <= 200
        assert container._cache._bytes == sum(
            chunk.nbytes for chunk in container._cache._chunks.values()
        )
    with Container.open(sample, cache_bytes=0) as container:
        table = container.arrays["tables/level_1"]
        table.read(tuple(slice(0, n) for n in table.shape))
        assert container._cache._bytes == 0


def read(ahead: Ahead, *spans: tuple[int, int]) -> int:
    return ahead.layers([range(*span) for span in spans])


def test_reads_that_go_on_along_the_first_axis_look_farther_each_time() -> None:
    ahead = Ahead()
    assert read(ahead, (0, 1), (0, 2)) == 0
    assert read(ahead, (0, 1), (0, 2)) == 0
    assert read(ahead, (1, 2), (0, 2)) == 1
    assert read(ahead, (1, 2), (0, 2)) == 0
    assert read(ahead, (1, 3), (0, 2)) == 2
    assert read(ahead, (3, 4), (0, 2)) == 3


@pytest.mark.parametrize("other", [((4, 5), (0, 2)), ((2, 3), (1, 2)), ((0, 1), (0, 2))], ids=str)
def test_other_reads_begin_anew(other: tuple[tuple[int, int], tuple[int, int]]) -> None:
    ahead = Ahead()
    read(ahead, (0, 1), (0, 2))
    assert read(ahead, (1, 2), (0, 2)) == 1
    assert read(ahead, *other) == 0
    (_, stop), space = other
    assert read(ahead, (stop, stop + 1), space) == 1


@pytest.mark.parametrize(
    ("threads", "missing", "room", "expected"),
    [
        (1, 1, 99, []),
        (2, 1, 99, [(1, 0)]),
        (2, 2, 99, []),
        (3, 1, 99, [(1, 0), (2, 0)]),
        (9, 1, 99, [(1, 0), (2, 0), (2, 1)]),
        (9, 1, 4, [(1, 0)]),
        (9, 1, 1, []),
        (9, 0, 99, []),
    ],
)
def test_each_thread_without_work_gets_a_chunk_that_is_not_cached(
    threads: int,
    missing: int,
    room: int,
    expected: list[tuple[int, int]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("FHASH_THREADS", str(threads))
    spans, cached = [range(0, 1), range(0, 2)], {(1, 1)}.__contains__
    assert chunks_after(spans, (3, 2), 2, missing, room, cached) == expected


def test_nothing_lies_after_the_last_layer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FHASH_THREADS", "4")
    assert chunks_after([range(2, 3)], (3,), 5, 1, 99, lambda _: False) == []


COUNTED = {"tables/level_1": [5, 7], "tables/level_2": [3, 0]}


@pytest.fixture
def header(samples) -> dict[str, Any]:
    """A header of sparse tables."""
    header: dict[str, Any] = samples.header()
    header["model"]["sparse"] = "fringe"
    header["required_features"] = [SPARSE_FEATURE]
    return header


def write(
    path: Path,
    header: dict[str, Any],
    arrays: dict[str, np.ndarray],
    counted: dict[str, Any] = COUNTED,
    **others: np.ndarray,
) -> None:
    """Write the arrays of a header, its tables with so many vertices at each time node."""
    with ContainerWriter(path) as writer:
        for name, array in {**arrays, **others}.items():
            if name not in COUNTED:
                writer.add_whole(name, array)
        for name, counts in counted.items():
            size = header["model"]["embedding_size"]
            rows = others.get(name, np.zeros((sum(COUNTED[name]), size), np.float16))
            writer.add_whole(name, rows, attributes={} if counts is None else {COUNTS: counts})
        writer.commit(header)


def test_a_file_of_sparse_tables_is_read(tmp_path, samples, header) -> None:
    write(tmp_path / "a.fhz", header, samples.arrays(header))
    with Container.open(tmp_path / "a.fhz") as container:
        assert container.arrays["tables/level_1"].shape == (12, 2)
        container.verify()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sparse": "all"}, "model.sparse is 'all'; needed: coreset or fringe"),
        ({"sparse": True}, "model.sparse is True; needed: coreset or fringe"),
        ({"tables": "transform"}, "sparse is 'fringe'; needed: tables of plain numbers"),
    ],
    ids=str,
)
def test_a_header_that_does_not_fit_is_refused(samples, header, changes, message) -> None:
    header["model"].update(changes)
    header["required_features"].append("transform")
    header |= {"format": "fhash", "format_version": [2, 0]}
    with pytest.raises(DamagedFileError, match=message):
        validate_header(header)


def test_the_feature_must_be_required(tmp_path, samples, header) -> None:
    """An older reader would otherwise take the tables for damaged ones."""
    header["required_features"] = []
    with pytest.raises(InputError, match="sparse is 'fringe'; needed: the feature sparse-tables"):
        write(tmp_path / "a.fhz", header, samples.arrays(header))


@pytest.mark.parametrize(
    "counts",
    [None, 12, [12], [5, 7, 0], [5.0, 7], [-1, 13], [5, True], [0, 73], ["5", "7"]],
    ids=str,
)
def test_counts_that_do_not_fit_the_level_are_refused(tmp_path, samples, header, counts) -> None:
    with pytest.raises(InputError, match="array tables/level_1 attribute counts is"):
        write(
            tmp_path / "a.fhz",
            header,
            samples.arrays(header),
            COUNTED | {"tables/level_1": counts},
        )


@pytest.mark.parametrize(
    "table",
    [np.zeros((11, 2), np.float16), np.zeros((12, 1), np.float16), np.zeros((12, 2), np.float32)],
    ids=lambda table: f"{table.dtype} {table.shape}",
)
def test_a_table_that_does_not_fit_its_counts_is_refused(tmp_path, samples, header, table) -> None:
    with pytest.raises(InputError, match=r"array tables/level_1 is .* asks for float16 \(12, 2\)"):
        write(tmp_path / "a.fhz", header, samples.arrays(header), **{"tables/level_1": table})


def test_dense_tables_in_a_sparse_file_are_refused(tmp_path, samples, header) -> None:
    with pytest.raises(InputError, match="array tables/level_1 attribute counts is missing"):
        samples.write(tmp_path / "a.fhz", header, samples.arrays(header))


def test_a_missing_table_is_named(tmp_path, samples, header) -> None:
    counted = {name: counts for name, counts in COUNTED.items() if name != "tables/level_2"}
    with pytest.raises(InputError, match="array tables/level_2 is missing"):
        write(tmp_path / "a.fhz", header, samples.arrays(header), counted)


def test_the_occupancy_must_be_bits(tmp_path, samples, header) -> None:
    arrays = samples.arrays(header)
    mask = np.ones(header["model"]["levels"][0], np.uint8)
    with pytest.raises(InputError, match="occupancy/mask is there in a file of sparse tables"):
        write(tmp_path / "a.fhz", header, arrays | {"occupancy/mask": mask})
    del arrays["occupancy/bits"]
    with pytest.raises(InputError, match="array occupancy/bits is missing"):
        write(tmp_path / "b.fhz", header, arrays)


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
        reads = reads_of(container)
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
        start, reads = member.end - 4 - 40 * 16, reads_of(container)
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
