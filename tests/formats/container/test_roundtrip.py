"""What is written is read, by us and by the zarr library; one content has one file."""

from __future__ import annotations

import json
import zipfile
from concurrent.futures import ThreadPoolExecutor
from itertools import product

import numpy as np
import pytest
import zarr

from fhash_formats.container import Container, ContainerWriter, is_container
from fhash_formats.container.array import DTYPES
from fhash_formats.errors import RegionError


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


def test_every_type_and_chunking_reads_equal(everything):
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


def test_zarr_library_reads_every_array_equal(everything):
    path, arrays = everything
    store = zarr.storage.ZipStore(path, read_only=True)
    group = zarr.open_group(store, mode="r")
    for name, array in arrays.items():
        read = group[name]
        assert read.dtype == array.dtype
        assert read[...].tobytes() == array.tobytes()
    assert group["extra/five/int8"].attrs.asdict() == {"of": "five"}
    assert group["extra/plane/int8"].metadata.dimension_names == ("axis_0", "axis_1")
    assert group.attrs["fhash"]["format_version"] == [1, 1]
    assert {name for name, _ in group["extra"].groups()} == set(SHAPES)
    store.close()


def test_zipfile_finds_a_sound_zip_of_stored_chunks(sample):
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


def test_header_comes_back(sample, samples):
    with Container.open(sample) as container:
        assert container.header == {
            **samples.header(),
            "format": "fhash",
            "format_version": [1, 1],
            "required_features": [],
        }
        assert container.size == sample.stat().st_size
        assert container.path == sample


def test_overhead_and_chunk_data_are_the_file(sample):
    with Container.open(sample) as container:
        assert (
            container.overhead() + sum(array.nbytes_stored for array in container.arrays.values())
            == sample.stat().st_size
        )
        assert 0 < container.overhead() < container.size


def test_same_content_gives_same_bytes(tmp_path, samples):
    header = samples.header()
    for name in ("a.fhz", "b.fhz"):
        samples.write(tmp_path / name, header, samples.arrays(header))
        header = dict(reversed(header.items()))
    assert (tmp_path / "a.fhz").read_bytes() == (tmp_path / "b.fhz").read_bytes()


def test_chunks_of_one_array_may_come_from_a_generator(tmp_path, samples):
    header = samples.header()
    arrays = samples.arrays(header)
    table = arrays.pop("tables/level_1")
    with ContainerWriter(tmp_path / "a.fhz") as writer:
        for name, array in arrays.items():
            writer.add_whole(name, array)
        chunks = (table[t : t + 1, z : z + 2] for t in range(2) for z in (0, 2))
        writer.add_array(
            "tables/level_1",
            shape=table.shape,
            dtype=">f2",
            chunk_shape=(1, 2, 4, 6, 2),
            chunks=chunks,
        )
        writer.commit(header)
    with Container.open(tmp_path / "a.fhz") as container:
        np.testing.assert_array_equal(container.arrays["tables/level_1"].read(), table)
        assert container.arrays["tables/level_1"].dtype == np.dtype("float16")


def regions(shape, count):
    rng = np.random.default_rng(2)
    for _ in range(count):
        ends = [sorted(rng.integers(0, n + 1, 2)) for n in shape]
        yield tuple(slice(int(a), int(b)) for a, b in ends)


def test_region_is_the_same_part_of_the_whole(everything):
    path, arrays = everything
    with Container.open(path) as container:
        for name in (
            "extra/five/float64",
            "extra/larger/uint16",
            "extra/line/int8",
            "tables/level_1",
        ):
            for region in regions(arrays[name].shape, 60):
                np.testing.assert_array_equal(
                    container.arrays[name].read(region), arrays[name][region]
                )


@pytest.mark.parametrize(
    "part", [slice(-1, 2), slice(0, 8), slice(3, 2), slice(0, 7, 2), slice(0, 7, -1), slice(8, 8)]
)
def test_region_outside_is_refused(everything, part):
    path, _ = everything
    with Container.open(path) as container, pytest.raises(RegionError, match="axis 0"):
        container.arrays["extra/line/int8"].read((part,))


def test_region_of_other_axes_is_refused(sample):
    with Container.open(sample) as container, pytest.raises(RegionError, match="2 axes"):
        container.arrays["key_frames"].read((slice(0, 1), slice(0, 1)))


def test_open_ends_of_slices_are_the_array_ends(sample, samples):
    with Container.open(sample) as container:
        np.testing.assert_array_equal(
            container.arrays["coords/x"].read((slice(2, None),)),
            samples.arrays(samples.header())["coords/x"][2:],
        )


def test_region_touches_only_its_chunks_and_once(sample, monkeypatch):
    with Container.open(sample) as container:
        reads = []
        read = container._source.read
        monkeypatch.setattr(
            container._source,
            "read",
            lambda offset, size: reads.append(offset) or read(offset, size),
        )
        table = container.arrays["tables/level_1"]
        region = (slice(0, 1), slice(1, 3), slice(0, 3), slice(0, 6), slice(0, 2))
        table.read(region)
        assert sorted(reads) == sorted(
            table.chunks[index].offset for index in [(0, 0, 0, 0, 0), (0, 1, 0, 0, 0)]
        )
        table.read(region)
        assert len(reads) == 2


def test_result_is_the_callers_own(sample):
    with Container.open(sample) as container:
        table = container.arrays["tables/level_2"]
        everything = tuple(slice(0, n) for n in table.shape)
        table.read(everything)[:] = 0
        assert np.all(table.read(everything) != 0)


def test_cache_holds_no_more_than_its_limit(sample):
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


def test_threads_read_what_one_reads(everything):
    path, arrays = everything
    table = arrays["extra/five/float64"]
    with Container.open(path, cache_bytes=1000) as container, ThreadPoolExecutor(8) as pool:
        asked = list(regions(table.shape, 300))
        for region, read in zip(
            asked, pool.map(container.arrays["extra/five/float64"].read, asked), strict=True
        ):
            np.testing.assert_array_equal(read, table[region])


def test_verify_reports_every_member(sample, samples):
    seen = []
    with Container.open(sample) as container:
        container.verify(lambda done, total: seen.append((done, total)))
    assert seen[-1][0] == seen[-1][1] == len(samples.unpack(sample.read_bytes()))
    assert [done for done, _ in seen] == list(range(seen[0][0], seen[-1][0] + 1))


def test_is_container(sample, tmp_path):
    assert is_container(sample)
    assert is_container(str(sample))
    data = sample.read_bytes()
    for name, other in {
        "cut": data[:-1],
        "longer": data + b"\n",
        "empty": b"",
        "text": b"fhash 1",
    }.items():
        (tmp_path / name).write_bytes(other)
        assert not is_container(tmp_path / name)
    assert not is_container(tmp_path)
    assert not is_container(tmp_path / "missing")
