"""Shards: their bytes, their order, and hostile ones."""

from __future__ import annotations

import json
import struct
import tracemalloc
from itertools import product

import numpy as np
import pytest
from sharded_files import NAME, PATH, random_values, write_sharded

from fhash_formats.container import Container, coding, shard_order, shard_shape
from fhash_formats.container.coding import crc32c
from fhash_formats.container.sharding import (
    ABSENT,
    MAX_SHARD_CHUNKS,
    SINGLE_SHARD_CHUNKS,
    Sharding,
    parse_index,
    sharding_codecs,
)
from fhash_formats.container.zip_file import MAX_MEMBER
from fhash_formats.errors import DamagedFileError, InputError, UnsupportedFileError


def test_bytes_of_a_shard(tmp_path, samples) -> None:
    """A shard is its inner chunks without gaps, an index of (offset, bytes), and its CRC-32C."""
    values = np.arange(3, dtype=np.uint8)
    path = write_sharded(tmp_path / "a.fhz", samples, values, (2,), (6,))
    with Container.open(path) as container:
        member = container.arrays[NAME].chunks[0,]
    data = path.read_bytes()[member.data_offset : member.end]
    coder = coding.chunk_coder(coding.plain_codecs(values.dtype), values.dtype, (2,))
    first, second = coder.encode(values[:2]), coder.encode(np.array([2, 0], np.uint8))
    index = struct.pack("<6Q", 0, len(first), len(first), len(second), ABSENT, ABSENT)
    assert data == first + second + index + struct.pack("<I", crc32c(index))


@pytest.mark.parametrize(
    ("chunk_shape", "shard_shape"),
    [((2, 3), (4, 7)), ((2,), (4, 6)), ((2, 0), (4, 6)), ((1, 1), (2048, 2048))],
)
def test_shards_that_do_not_fit(tmp_path, samples, chunk_shape, shard_shape) -> None:
    with pytest.raises(InputError, match="sharding_indexed"):
        write_sharded(
            tmp_path / "a.fhz", samples, random_values((7, 6)), chunk_shape, shard_shape, chunks=[]
        )


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


def test_index_with_a_wrong_checksum(line, samples) -> None:
    path, parts, at = line
    name, data = parts[at]
    parts[at] = name, data[:-1] + bytes([data[-1] ^ 1])
    refused_shard(path, samples, parts, f"member {PATH}/c/0: the CRC-32C of the shard's index")


@pytest.mark.parametrize("data", [b"", b"x" * 67])
def test_shard_shorter_than_its_index(line, samples, data) -> None:
    path, parts, at = line
    parts[at] = parts[at][0], data
    refused_shard(path, samples, parts, f"member {PATH}/c/0: {len(data)} bytes are too few")


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
    refused_shard(path, samples, parts, "too few for the index|memory")


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


def test_every_flip_in_a_shard_is_found(sharded_file) -> None:
    path, _ = sharded_file
    with Container.open(path) as container:
        members = list(container.arrays[NAME].chunks.values())
    sound = path.read_bytes()
    for member in members:
        for at in range(member.offset, member.end):
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


def test_index_of_a_full_shard() -> None:
    index = struct.pack("<4Q", 0, 5, 5, 7)
    entries = parse_index(index + struct.pack("<I", crc32c(index)), np.array([True, True]), 12)
    assert entries.tolist() == [[0, 5], [5, 7]]


def test_order_of_the_file() -> None:
    order = list(shard_order((5, 3), (2, 1), (4, 2)))
    assert order == [(0, 0), (0, 1), (1, 0), (1, 1), (0, 2), (1, 2), (2, 0), (2, 1), (2, 2)]
    assert sorted(order) == list(product(range(3), range(3)))


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


def test_a_large_grid_has_a_shard_for_each_layer_in_time() -> None:
    tile = (2, 3, 4, 5)
    assert shard_shape(tile, (4, 16, 8, 8)) == (8, 48, 32, 40)
    assert shard_shape(tile, (5, 16, 8, 8)) == (2, 48, 32, 40)


def test_the_parts_of_shards_hold_each_chunk_once() -> None:
    sharding = Sharding(shard_shape=(4, 6), chunk_shape=(2, 2), codecs=())
    spans = [range(1, 5), range(2, 4)]
    chunks = []
    for shard, in_shard in sharding.parts(spans):
        for index in product(*in_shard):
            assert sharding.place(index)[0] == shard
            chunks.append(index)
    assert sorted(chunks) == list(product(*spans))


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
