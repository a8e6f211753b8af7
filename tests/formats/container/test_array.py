"""Metadata of an array: what a container may hold, and nothing else."""

from __future__ import annotations

import json
import struct
import tracemalloc
from itertools import product
from typing import Any

import numcodecs.zstd
import numpy as np
import pytest
from hostile_files import DOCUMENT, edited, frame, put_at, read_everything, refused, replaced
from rarely import rarely
from sharded_files import NAME, PATH, random_values, write_sharded

from fhash_formats import native
from fhash_formats.container import Container, shard_order, shard_shape
from fhash_formats.container import array as coding
from fhash_formats.container.array import (
    ABSENT,
    MAX_SHARD_CHUNKS,
    SINGLE_SHARD_CHUNKS,
    ArrayMetadata,
    chunk_coder,
    plain_codecs,
    sharding_codecs,
)
from fhash_formats.container.zip_file import MAX_MEMBER
from fhash_formats.errors import DamagedFileError, UnsupportedFileError
from fhash_formats.native import crc32c

DAMAGED = [
    ("shape", [2**60], "chunks; another number is declared"),
    ("chunk_grid.configuration.chunk_shape", [2**60], "more than 2.30 bytes"),
    ("chunk_grid.configuration.chunk_shape", [2**20], "zstd declares"),
    ("shape", [2**80], "shape"),
    ("shape", [-4], "shape"),
    ("shape", [True], "shape"),
    ("shape", [4.0], "shape"),
    ("shape", [1] * 99, "shape"),
    ("shape", [4, 1], "axes"),
    ("data_type", "float32", "zstd declares|asks for float64"),
    ("codecs", {"a": 1}, "codecs"),
    ("codecs", ["bytes", 5], "codecs"),
    ("attributes", [1], "attributes"),
    ("codecs", ..., "codecs is not a list"),
    ("dimension_names", [1], "dimension_names"),
]
UNSUPPORTED = [
    ("data_type", "complex128", "data_type"),
    ("data_type", {"name": "object"}, "data_type"),
    ("codecs.1", {"name": "pickle"}, "codecs"),
    ("codecs.0", {"name": "vlen-utf8"}, "codecs"),
    ("codecs.0.configuration.endian", "big", "codecs"),
    ("codecs.2", ..., "codecs"),
    ("codecs", [], "codecs"),
    ("fill_value", 1.0, "fill_value"),
    ("chunk_key_encoding.name", "v2", "chunk_key_encoding"),
    ("chunk_grid.name", "rectangular", "chunk_grid"),
    ("storage_transformers", [{"name": "x"}], "storage_transformers"),
    ("surprise", {"must_understand": True}, "surprise"),
    ("zarr_format", 2, "Zarr v3"),
    ("node_type", "table", "Zarr v3"),
]


@pytest.mark.parametrize(
    ("place", "value", "message", "kind"),
    [
        *((*case, DamagedFileError) for case in DAMAGED),
        *((*case, UnsupportedFileError) for case in UNSUPPORTED),
    ],
)
def test_array_metadata(sample, samples, place, value, message, kind) -> None:
    data = edited(sample, samples, DOCUMENT, lambda v: put_at(v, place, value))
    refused(sample, data, message, kind)


def test_key_that_need_not_be_understood(sample, samples) -> None:
    sample.write_bytes(
        edited(sample, samples, DOCUMENT, lambda v: v.update(surprise={"must_understand": False}))
    )
    read_everything(sample)


def metadata(**changes: Any) -> ArrayMetadata:
    fields = {
        "shape": (5, 7),
        "dtype": np.dtype("int16"),
        "chunk_shape": (2, 3),
        "codecs": plain_codecs(np.dtype("int16")),
    }
    return ArrayMetadata(**{**fields, **changes})


def test_metadata_come_back_from_their_document() -> None:
    array = metadata(dimension_names=("y", None), attributes={"units": "m"})
    assert ArrayMetadata.from_dict(array.to_dict()) == array


def test_every_chunk_has_its_name_and_its_region() -> None:
    array, values = metadata(), np.zeros((5, 7), int)
    assert array.grid == array.inner_grid == (3, 3)
    for index in product(*map(range, array.grid)):
        assert array.chunk_key(index) == f"c/{index[0]}/{index[1]}"
        values[array.inner_region(index)] += 1
    assert np.all(values == 1)


@pytest.mark.parametrize("size", [0, 7, 255, 767, 768, 769, 12287, 12288, 12289, 100_003])
def test_crc32c_is_that_of_the_definition(size: int) -> None:
    """Long data go in three parts side by side; tables are those of single bits."""
    data = np.random.default_rng(size).bytes(size)
    table = []
    for byte in range(256):
        for _ in range(8):
            byte = byte >> 1 ^ (0x82F63B78 if byte & 1 else 0)
        table.append(byte)
    rest = 0xFFFFFFFF
    for byte in data:
        rest = rest >> 8 ^ table[(rest ^ byte) & 255]
    crc = native.library().fhash_crc32c
    assert crc(data, size, 0, 0) == crc(data, size, 0, 1) == rest ^ 0xFFFFFFFF
    assert crc32c(memoryview(data)) == crc32c(data) == rest ^ 0xFFFFFFFF


@pytest.mark.parametrize("dtype", ["int8", "uint16", "float16", "float64"])
def test_chunks_of_any_order_of_bytes_are_coded_alike(dtype) -> None:
    chunk = np.arange(24).reshape(2, 3, 4).astype(dtype)
    coder = chunk_coder(plain_codecs(chunk.dtype), chunk.dtype, chunk.shape)
    other = chunk.astype(chunk.dtype.newbyteorder())
    assert coder.encode(np.asfortranarray(chunk)) == coder.encode(chunk) == coder.encode(other)


def test_a_tile_that_would_take_gigabytes_is_refused() -> None:
    codecs = [{"name": "fhash.transform", "configuration": {}}]
    with pytest.raises(
        DamagedFileError, match=r"tiles of 134,217,729 vertices; the limit is 134,217,728"
    ):
        chunk_coder(codecs, np.dtype(np.uint8), (1, 1, 1, (1 << 27) + 1))


CHUNKS = {
    "bomb": (
        lambda right: numcodecs.zstd.compress(bytes(1 << 26), 1),
        "zstd declares 67108864 bytes; the chunk has 32",
    ),
    "bomb of unknown size": (lambda right: frame(bytes(1 << 16)), "zstd declares"),
    "bomb that lies": (lambda right: frame(bytes(1 << 16), size=32), "zstd data are damaged"),
    "two frames": (lambda right: numcodecs.zstd.compress(right, 1) * 2, "zstd data are damaged"),
    "fewer bytes": (lambda right: frame(right[:16], size=32), "zstd data are damaged"),
    "declares 2^63": (lambda right: frame(right, size=2**63), "zstd declares"),
    "other content": (lambda right: right, "not a zstd frame"),
    "empty": (lambda right: b"", "not a zstd frame"),
    "header only": (
        lambda right: frame(right, size=32)[:8],
        "not a zstd frame",
    ),
}


@pytest.mark.parametrize("case", CHUNKS)
def test_chunk_data(sample, samples, case) -> None:
    make, message = CHUNKS[case]
    coded = make(np.arange(4, dtype="<f8").tobytes())
    coded += struct.pack("<I", crc32c(coded))
    data = replaced(sample, samples, "time/c/0", coded)
    refused(sample, data, f"member time/c/0: {message}")


@pytest.mark.parametrize(
    "coded", [b"", b"abc", b"abcd", numcodecs.zstd.compress(bytes(32), 1) + b"abcd"]
)
def test_chunk_without_its_crc(sample, samples, coded) -> None:
    data = replaced(sample, samples, "time/c/0", coded)
    refused(sample, data, "member time/c/0: .*CRC-32C")


def test_frame_made_by_hand_is_read(sample, samples) -> None:
    """The hostile frames above differ from this one only in what they are refused for."""
    right = np.arange(4, dtype="<f8")
    coded = frame(right.tobytes(), size=32)
    coded += struct.pack("<I", crc32c(coded))
    sample.write_bytes(replaced(sample, samples, "time/c/0", coded))
    with Container.open(sample) as container:
        np.testing.assert_array_equal(container.arrays["coords/time"].read(), right)


def test_bytes_of_a_shard(tmp_path, samples) -> None:
    """A shard is its inner chunks without gaps, an index of (offset, bytes), and its CRC-32C."""
    values = np.arange(3, dtype=np.uint8)
    path = write_sharded(tmp_path / "a.fhz", samples, values, (2,), (6,))
    member = samples.members(path, PATH)[0,]
    data = path.read_bytes()[member.data_offset : member.end]
    coder = coding.chunk_coder(coding.plain_codecs(values.dtype), values.dtype, (2,))
    first, second = coder.encode(values[:2]), coder.encode(np.array([2, 0], np.uint8))
    index = struct.pack("<6Q", 0, len(first), len(first), len(second), ABSENT, ABSENT)
    assert data == first + second + index + struct.pack("<I", crc32c(index))


@pytest.mark.parametrize(
    ("chunk_shape", "shard_shape"),
    [((2, 3), (4, 7)), ((1, 1), (2048, 2048))],
)
def test_shards_that_do_not_fit(tmp_path, samples, chunk_shape, shard_shape) -> None:
    path = write_sharded(tmp_path / "a.fhz", samples, random_values((7, 6)), (1, 6), (7, 6))
    parts = samples.unpack(path.read_bytes())
    place = [name for name, _ in parts].index(f"{PATH}/zarr.json")
    document = json.loads(parts[place][1])
    document["chunk_grid"]["configuration"]["chunk_shape"] = shard_shape
    document["codecs"][0]["configuration"]["chunk_shape"] = chunk_shape
    parts[place] = parts[place][0], json.dumps(document).encode()
    path.write_bytes(samples.pack(parts))
    with pytest.raises(DamagedFileError, match="sharding_indexed"):
        Container.open(path)


BIG = 2**60


ORDER = "the index of the shard has inner chunks that are missing, overlap"
INDICES = {
    "offset outside": (lambda t: t[1].__setitem__(0, BIG), ORDER),
    "size outside": (lambda t: t[1].__setitem__(1, BIG), ORDER),
    "sizes that overflow": (
        lambda t: (t[0].__setitem__(1, 2**63), t[1].__setitem__(1, 2**63)),
        ORDER,
    ),
    "overlap": (lambda t: t[1].__setitem__(0, 0), ORDER),
    "two at one place": (lambda t: t.__setitem__(1, list(t[0])), ORDER),
    "gap": (lambda t: t[1].__setitem__(1, t[1][1] - 1), ORDER),
    "exchanged": (lambda t: t.__setitem__(slice(0, 2), [t[1], t[0]]), ORDER),
    "missing": (lambda t: t.__setitem__(1, [ABSENT, ABSENT]), ORDER),
    "half missing": (lambda t: t[1].__setitem__(0, ABSENT), ORDER),
    "beyond the array": (lambda t: t.__setitem__(3, [0, 5]), ORDER),
    "empty": (
        lambda t: (
            t[2].__setitem__(1, 0),
            t[1].__setitem__(1, t[1][1] + t[2][1]),
            t[2].__setitem__(0, t[2][0] + 10**6),
        ),
        ORDER,
    ),
}


@pytest.fixture
def line(tmp_path, samples):
    """One shard of four inner chunks, of which the last is beyond the end of the array.

    Returns the file, its parts for `samples.pack`, and the number of the shard among the parts.
    """
    path = write_sharded(tmp_path / "a.fhz", samples, random_values((5,)), (2,), (8,))
    parts = samples.unpack(path.read_bytes())
    return path, parts, [name for name, _ in parts].index(f"{PATH}/c/0")


def refused_shard(path, samples, parts, message, kind=DamagedFileError):
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


def test_hostile_indices(line, samples) -> None:
    path, parts, at = line
    name, data = parts[at]
    for change, message in INDICES.values():
        table = [list(entry) for entry in struct.iter_unpack("<2Q", data[-68:-4])]
        change(table)
        index = b"".join(struct.pack("<2Q", *entry) for entry in table)
        changed = data[:-68] + index + struct.pack("<I", crc32c(index))
        hostile = [*parts[:at], (name, changed), *parts[at + 1 :]]
        refused_shard(path, samples, hostile, f"member {PATH}/c/0: .*{message}")


@pytest.mark.parametrize("data", [b"", b"x" * 67])
def test_shard_shorter_than_its_index(line, samples, data) -> None:
    path, parts, at = line
    parts[at] = parts[at][0], data
    refused_shard(path, samples, parts, f"member {PATH}/c/0: too few bytes")


def test_shards_that_declare_much(line, samples) -> None:
    """A million inner chunks of a gibibyte each, in a few bytes."""
    path, parts, _ = line
    place = [name for name, _ in parts].index(f"{PATH}/zarr.json")
    text = parts[place][1].decode()
    many = text.replace('"chunk_shape":[8]', f'"chunk_shape":[{2**48}]').replace(
        '"chunk_shape":[2]', f'"chunk_shape":[{2**28}]'
    )
    assert MAX_SHARD_CHUNKS == 2**20
    parts[place] = parts[place][0], many.replace('"shape":[5]', f'"shape":[{2**48}]').encode()
    refused_shard(path, samples, parts, "too few bytes for the index|memory")


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
def test_settings_that_are_refused(line, samples, case) -> None:
    changes, kind = SETTINGS[case]
    path, parts, _ = line
    place = [name for name, _ in parts].index(f"{PATH}/zarr.json")
    document = json.loads(parts[place][1])
    document["codecs"][0]["configuration"].update(changes)
    parts[place] = parts[place][0], json.dumps(document).encode()
    refused_shard(path, samples, parts, f"member {PATH}/zarr.json: ", kind)


@pytest.mark.parametrize(
    "change", [lambda c: c.append({"name": "crc32c"}), lambda c: c[0].pop("configuration")]
)
def test_sharding_stands_alone(line, samples, change) -> None:
    path, parts, _ = line
    place = [name for name, _ in parts].index(f"{PATH}/zarr.json")
    document = json.loads(parts[place][1])
    change(document["codecs"])
    parts[place] = parts[place][0], json.dumps(document).encode()
    refused_shard(path, samples, parts, "sharding_indexed", UnsupportedFileError)


@pytest.mark.parametrize("part", [0, *rarely(1, 2, 3)])
def test_every_flip_in_a_shard_is_found(sharded_file, samples, part) -> None:
    path, _ = sharded_file
    members = samples.members(path, PATH).values()
    sound = path.read_bytes()
    for member in members:
        for at in range(member.offset + part, member.end, 4):
            damaged = bytearray(sound)
            damaged[at] ^= 4
            path.write_bytes(damaged)
            with (
                pytest.raises(DamagedFileError, match=f"member {PATH}/c/"),
                Container.open(path) as container,
            ):
                container.verify()
            if at >= member.data_offset:
                with (
                    pytest.raises(DamagedFileError, match=f"member {PATH}/c/"),
                    Container.open(path) as container,
                ):
                    container.arrays[NAME].read()


@pytest.mark.parametrize(
    ("grid", "shards"),
    [
        ((1, 1, 1, 1), (1, 1, 1, 1)),
        ((4, 32, 32, 1), (1, 1, 1, 1)),
        ((SINGLE_SHARD_CHUNKS + 1, 1, 1, 1), (SINGLE_SHARD_CHUNKS + 1, 1, 1, 1)),
        ((3, 32, 32, 2), (3, 1, 1, 1)),
    ],
)
def test_a_large_array_has_a_shard_for_each_layer(grid, shards) -> None:
    chunk_shape = (2, 3, 5, 7)
    shape = shard_shape(chunk_shape, grid)
    assert all(n % chunk == 0 for n, chunk in zip(shape, chunk_shape, strict=True))
    lengths = [n * chunk for n, chunk in zip(grid, chunk_shape, strict=True)]
    assert tuple(-(-n // shard) for n, shard in zip(lengths, shape, strict=True)) == shards


@pytest.mark.parametrize(
    ("grid", "largest", "counts"),
    [
        ((4, 3, 5, 2), 1 << 20, (4, 3, 5, 2)),  # 120 MiB fit
        ((4, 3, 5, 2), 1 << 25, (2, 3, 5, 2)),  # 3.8 GiB: half of the steps
        ((4, 3, 5, 2), 1 << 27, (1, 1, 5, 2)),  # 15 GiB: a third of a layer, 1.3 GiB
        ((4, 3, 5, 2), 1 << 29, (1, 1, 2, 2)),
        ((4, 3, 5, 2), MAX_MEMBER // 2, (1, 1, 1, 2)),
        ((4, 3, 5, 2), MAX_MEMBER, (1, 1, 1, 1)),  # no shard can hold such a tile
        ((2, 1 << 7, 1 << 7, 1 << 7), 1, (1, 1 << 6, 1 << 7, 1 << 7)),  # 2^20 tiles
    ],
)
def test_shards_stay_within_the_limits(grid, largest, counts) -> None:
    sizes = np.ones(np.prod(grid), np.int64)
    sizes[:] = largest - 64 if grid[0] == 4 else largest
    assert shard_shape((1, 2, 3, 4), grid, sizes) == tuple(np.multiply((1, 2, 3, 4), counts))
    order = shard_order(grid, (1, 1, 1, 1), counts)
    if grid[0] == 4:
        assert list(order) == list(product(*map(range, grid)))


def test_the_largest_shard_decides() -> None:
    sizes = np.ones((4, 2, 1, 1), np.int64)
    sizes[2] = MAX_MEMBER // 2 - 100
    assert shard_shape((1, 1, 1, 1), sizes.shape, sizes.ravel()) == (4, 2, 1, 1)
    sizes[3, 0] = 1000
    assert shard_shape((1, 1, 1, 1), sizes.shape, sizes.ravel()) == (1, 2, 1, 1)
