"""Arrays of an open container, dense and sparse, by region, by us and by the zarr library."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import pytest
import zarr
from table_files import HEAD, PLAIN
from tiled_files import NAME, random_values, tiled, write_tiled

from fhash_formats.container import FORMAT_VERSION, Container, ContainerWriter, validate_header
from fhash_formats.container.array import transform_codecs
from fhash_formats.container.header import COUNTS, SPARSE_FEATURE
from fhash_formats.container.remote import TAIL_BYTES
from fhash_formats.errors import DamagedFileError, InputError, RegionError
from fhash_formats.support.values import DTYPES
from fhash_formats.transform.tile import decode_chunk, decode_tile, encode_tile


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
    store = zarr.storage.ZipStore(path, read_only=True)
    group = zarr.open_group(store, mode="r")
    for name, array in arrays.items():
        read = group[name]
        assert read.dtype == array.dtype
        assert read[...].tobytes() == array.tobytes()
    assert group["extra/five/int8"].attrs.asdict() == {"of": "five"}
    assert group["extra/plane/int8"].metadata.dimension_names == ("axis_0", "axis_1")
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


def test_region_touches_only_its_chunks_and_once(tmp_path, samples) -> None:
    values = random_values((8, 200, 200))
    with ContainerWriter(tmp_path / "a.fhz") as writer:
        for name, array in samples.arrays(samples.header()).items():
            writer.add_whole(name, array)
        writer.add_whole("extra/values", values, chunk_shape=(1, 200, 100))
        writer.commit(samples.header())
    members = samples.members(tmp_path / "a.fhz", "extra/values/c")
    with Container.open(tmp_path / "a.fhz") as container:
        reads, array = reads_of(container), container.arrays["extra/values"]
        region = (slice(1, 3), slice(5, 9), slice(3, 4))
        np.testing.assert_array_equal(array.read(region), values[region])
        chunks = [members[index] for index in [(1, 0, 0), (2, 0, 0)]]
        assert sorted(reads) == [(chunk.offset, chunk.end - chunk.offset) for chunk in chunks]
        array.read(region)
        assert len(reads) == 2


def test_result_is_the_callers_own(sample) -> None:
    with Container.open(sample) as container:
        table = container.arrays["table_2"]
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


def test_disk_error_while_reading(tmp_path, samples, monkeypatch) -> None:
    def fail(offset, size):
        raise OSError(5, "Input/output error")

    path = write_tiled(tmp_path / "a.fhz", samples, random_values((99, 999)), (99, 333), (1, 3))
    with Container.open(path) as container:
        monkeypatch.setattr(container._source, "read", fail)
        with pytest.raises(DamagedFileError, match="cannot be read: Input/output error"):
            container.arrays[NAME].read()


def test_what_does_not_fit_in_memory_is_not_called_damaged(sample, monkeypatch) -> None:
    """Or a sound file might be thrown away."""

    def fail(*_, **__):
        raise MemoryError

    with Container.open(sample) as container:
        array = container.arrays["mlp/weight_1"]
        monkeypatch.setattr(container._file, "read", fail)
        with pytest.raises(MemoryError):
            array.read()


@pytest.mark.parametrize(("threads", "ahead"), [("1", 0), ("2", 1)])
def test_reads_that_go_on_decode_the_next_chunk_in_a_thread_that_is_free(
    tmp_path, samples, monkeypatch, threads, ahead
) -> None:
    values = random_values((5, 40_000))
    path = write_tiled(tmp_path / "a.fhz", samples, values, (1, 40_000), (5, 1))
    damaged = bytearray(path.read_bytes())
    monkeypatch.setenv("FHASH_THREADS", threads)
    with Container.open(path) as container:
        array, whole = container.arrays[NAME], (slice(0, 40_000),)
        places = [array.place((step, 0)) for step in range(5)]
        reads = reads_of(container)
        for step in range(4):
            part = array.read((slice(step, step + 1), *whole))
            np.testing.assert_array_equal(part[0], values[step])
        # Beside the third step, the fourth was decoded; the fifth beside it.
        read = sum(size for _, size in reads if size > 1000)
        # The end of the file was read when it was opened.
        assert read >= sum(size for _, size in places[: 4 + ahead]) - (64 << 10)
        before = len(reads)
        array.read((slice(4, 5), *whole))
        assert len(reads) == before + (0 if ahead else 1)
    damaged[places[4][0] + 5] ^= 1
    path.write_bytes(damaged)
    with Container.open(path) as container:
        array = container.arrays[NAME]
        for step in range(4):
            part = array.read((slice(step, step + 1), *whole))
            np.testing.assert_array_equal(part[0], values[step])
        # What was damaged ahead of the reader is damaged when it is read.
        with pytest.raises(DamagedFileError, match="tile 4: "):
            array.read((slice(4, 5), *whole))


def test_a_small_part_of_a_tile_has_the_bits_of_the_whole(tmp_path, samples) -> None:
    shape = (2, 9, 10, 11)
    settings = replace(PLAIN, head=HEAD)
    values = np.random.default_rng(1).normal(0.5, 0.8, shape).clip(-2, 3).astype("f4")
    stream = encode_tile(values, settings).data
    whole = decode_tile(stream, shape, "f4", settings)
    path = write_tiled(
        tmp_path / "a.fhz",
        samples,
        values,
        shape,
        chunks=[stream],
        codecs=transform_codecs(settings),
    )
    part = (slice(1, 2), slice(0, 2), slice(3, 5), slice(9, 11))
    with Container.open(path) as container:
        array = container.arrays[NAME]
        for _ in range(3):
            assert array.read(part).tobytes() == whole[part].tobytes()
        assert array.decode_chunk((0, 0, 0, 0)).tobytes() == whole.tobytes()
        assert array.read().tobytes() == whole.tobytes()


@pytest.mark.parametrize("cache_bytes", [0, 200, 1 << 20])
def test_a_cache_of_any_size_changes_no_value(sample, samples, cache_bytes) -> None:
    right = samples.arrays(samples.header())["table_1"]
    with Container.open(sample, cache_bytes=cache_bytes) as container:
        table = container.arrays["table_1"]
        for _ in range(2):
            read = table.read(tuple(slice(0, n) for n in table.shape))
            np.testing.assert_array_equal(read, right)


COUNTED = {"table_1": [5, 7], "table_2": [3, 0]}


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
        assert container.arrays["table_1"].shape == (12, 2)
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
    with pytest.raises(InputError, match="table_1 attribute counts is"):
        write(
            tmp_path / "a.fhz",
            header,
            samples.arrays(header),
            COUNTED | {"table_1": counts},
        )


@pytest.mark.parametrize(
    "table",
    [np.zeros((11, 2), np.float16), np.zeros((12, 1), np.float16), np.zeros((12, 2), np.float32)],
    ids=lambda table: f"{table.dtype} {table.shape}",
)
def test_a_table_that_does_not_fit_its_counts_is_refused(tmp_path, samples, header, table) -> None:
    with pytest.raises(InputError, match=r"array table_1 is .* asks for float16 \(12, 2\)"):
        write(tmp_path / "a.fhz", header, samples.arrays(header), **{"table_1": table})


def test_dense_tables_in_a_sparse_file_are_refused(tmp_path, samples, header) -> None:
    with pytest.raises(InputError, match="table_1 attribute counts is missing"):
        samples.write(tmp_path / "a.fhz", header, samples.arrays(header))


def test_a_missing_table_is_named(tmp_path, samples, header) -> None:
    counted = {name: counts for name, counts in COUNTED.items() if name != "table_2"}
    with pytest.raises(InputError, match="array table_2 is missing"):
        write(tmp_path / "a.fhz", header, samples.arrays(header), counted)


def test_the_occupancy_must_be_there(tmp_path, samples, header) -> None:
    arrays = samples.arrays(header)
    del arrays["occupancy"]
    with pytest.raises(InputError, match="array occupancy is missing"):
        write(tmp_path / "b.fhz", header, arrays)


CASES = {
    "one member": ((4, 6), (2, 3), (2, 2)),
    "members that are full": ((8, 6), (2, 3), (2, 1)),
    "parts of tiles": ((7, 5), (2, 3), (2, 2)),
    "tiles beyond the end": ((3, 4), (2, 3), (4, 4)),
    "one tile a member": ((5, 5), (2, 2), (1, 1)),
    "four axes": ((5, 4, 6, 7), (2, 2, 3, 3), (2, 2, 2, 2)),
}


@pytest.mark.parametrize("case", CASES)
def test_every_region_reads_equal(tmp_path, samples, case) -> None:
    shape, tile, together = CASES[case]
    values = random_values(shape)
    path = write_tiled(tmp_path / "a.fhz", samples, values, tile, together, attributes={"a": 1})
    rng = np.random.default_rng(0)
    with Container.open(path) as container:
        array = container.arrays[NAME]
        assert (array.shape, array.chunk_shape, array.together) == CASES[case]
        assert array.grid == tuple(-(-n // c) for n, c in zip(shape, tile, strict=True))
        assert array.attributes == {"a": 1}
        np.testing.assert_array_equal(array.read(), values)
        for _ in range(40):
            region = tuple(slice(*sorted(int(i) for i in rng.integers(0, n + 1, 2))) for n in shape)
            np.testing.assert_array_equal(array.read(region), values[region])
        assert container.verify() == 2


@pytest.mark.parametrize("case", CASES)
def test_any_library_of_zarr_finds_every_tile(tmp_path, samples, case) -> None:
    """It is as FORMAT.md says: the index gives the sizes, the attribute what tiles are."""
    shape, tile, together = CASES[case]
    values = random_values(shape)
    path = write_tiled(tmp_path / "a.fhz", samples, values, tile, together)
    with zarr.storage.ZipStore(path, read_only=True) as store, ZipFile(path) as members:
        index = zarr.open_array(store, path=NAME, mode="r")
        assert (index.chunks, index.dtype) == (together, np.uint32)
        told = index.attrs["tiles"]
        assert (told["codec"], told["shape"]) == ("fhash.transform", list(shape))
        metadata = tiled(np.zeros(told["shape"], told["data_type"]), tuple(told["tile"]), together)
        assert index.shape == metadata.grid
        sizes, read = index[...], np.full(shape, np.nan, np.float32)
        for number, member in enumerate(np.ndindex(metadata.members)):
            data = members.read(f"{NAME}/t/{number}")
            for place in metadata.chunks_of(member):
                size = int(sizes[place]) if metadata.indexed else len(data)
                whole = decode_chunk(data[:size], tile, "f4")
                region, data = metadata.region(place), data[size:]
                read[region] = whole[tuple(slice(0, s.stop - s.start) for s in region)]
            assert not data
        np.testing.assert_array_equal(read, values)


def test_of_a_large_array_only_what_is_needed_is_read(tmp_path, samples) -> None:
    values = random_values((300, 400))
    path = write_tiled(tmp_path / "a.fhz", samples, values, (2, 200), (15, 2))
    index = samples.members(path, f"{NAME}/c")[1, 0]
    with Container.open(path) as container:
        array, reads = container.arrays[NAME], reads_of(container)
        region = slice(43, 45), slice(0, 2)
        np.testing.assert_array_equal(array.read(region), values[region])
        assert reads[0] == (index.offset, index.end - index.offset)
        # Tiles of one row lie between those of the two.
        assert len(reads) == 2
        assert reads[1][1] < 3 * 1700
        region = slice(42, 46), slice(0, 200)
        np.testing.assert_array_equal(array.read(region), values[region])
        assert len(reads) == 2


def test_threads_decode_what_one_decodes(tmp_path, samples, monkeypatch) -> None:
    values = random_values((8,))
    path = write_tiled(tmp_path / "a.fhz", samples, values, (2,), (4,))
    for threads in ("1", "4"):
        monkeypatch.setenv("FHASH_THREADS", threads)
        with Container.open(path) as container:
            np.testing.assert_array_equal(container.arrays[NAME].read((slice(1, 8),)), values[1:])
            np.testing.assert_array_equal(container.arrays[NAME].read((slice(0, 7),)), values[:7])
            with pytest.raises(ValueError, match="read-only"):
                container.arrays[NAME].decode_chunk((1,))[:] = 0


def test_coded_tiles_come_in_any_order_within_a_member(tmp_path, samples) -> None:
    values = random_values((12, 2))
    coder = tiled(values, (4, 2)).coder
    coded = {(i, 0): coder.encode(values[4 * i : 4 * i + 4]) for i in range(3)}
    chunks = [((1, 0), coded[1, 0]), ((0, 0), coded[0, 0]), ((2, 0), coded[2, 0])]
    path, again = (
        write_tiled(tmp_path / name, samples, values, (4, 2), (2, 1), chunks=given)
        for name, given in (("a.fhz", chunks), ("b.fhz", coded.values()))
    )
    assert path.read_bytes() == again.read_bytes()
    with Container.open(path) as container:
        array = container.arrays[NAME]
        np.testing.assert_array_equal(array.decode_chunk((1, 0)), values[4:8])
        before = container.bytes_read
        np.testing.assert_array_equal(array.decode_chunk((1, 0)), values[4:8])
        assert container.bytes_read == before
        with pytest.raises(InputError, match="level of detail -1"):
            array.decode_chunk((0, 0), -1)
        with pytest.raises(InputError, match="no levels of detail"):
            container.arrays["table_1"].decode_chunk((0, 0, 0, 0), 1)


@pytest.mark.parametrize("index", [(4, 0), (0, 2), (-1, 0), (0,)])
def test_chunk_outside_the_grid(tiled_file, index) -> None:
    with (
        Container.open(tiled_file[0]) as container,
        pytest.raises(RegionError, match="outside the grid"),
    ):
        container.arrays[NAME].decode_chunk(index)


def test_damage_in_one_tile_leaves_the_others(tiled_file, samples) -> None:
    path, values = tiled_file
    member = samples.members(path, f"{NAME}/t")[0,]
    damaged = bytearray(path.read_bytes())
    damaged[member.data_offset + 5] ^= 1
    path.write_bytes(damaged)
    with Container.open(path) as container:
        np.testing.assert_array_equal(
            container.arrays[NAME].read((slice(2, 7), slice(0, 6))), values[2:]
        )
        with pytest.raises(DamagedFileError, match=f"member {NAME}/t/0: tile 0: "):
            container.arrays[NAME].read((slice(0, 1), slice(0, 1)))


def remote(range_server, path) -> Container:
    container = Container.open(range_server.put("run.fhz", path.read_bytes()))
    range_server.taken()
    return container


@pytest.mark.parametrize(("steps", "needed"), [(2, 1), (1, 2)])
def test_one_region_of_a_file_elsewhere_is_two_requests(
    tmp_path, samples, range_server, steps, needed
) -> None:
    """One for the sizes of a member's tiles, if they are not in the end that was read; one more."""
    values = random_values((8, 64, 80))
    path = write_tiled(tmp_path / "a.fhz", samples, values, (4, 16, 16), (steps, 4, 5))
    assert path.stat().st_size > 8 * TAIL_BYTES
    with remote(range_server, path) as container:
        array = container.arrays[NAME]
        region = (slice(0, 4), slice(16, 32), slice(3, 9))
        np.testing.assert_array_equal(array.read(region), values[region])
        assert all((method, status) == ("GET", 206) for method, _, status, _ in range_server.log)
        requests, size = range_server.taken()
        assert requests == needed
        assert size < 5000 < samples.members(path, f"{NAME}/t")[0,].size
        array.read(region)
        assert range_server.taken() == (0, 0)
        region = (slice(4, 8), slice(0, 64), slice(0, 32))
        np.testing.assert_array_equal(array.read(region), values[region])
        requests, size = range_server.taken()
        assert requests == 1
        assert size <= 4 * 5 * 4500
        np.testing.assert_array_equal(array.read(), values)
        assert container.verify() == 2
