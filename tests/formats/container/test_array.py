"""Metadata of an array: what a container may hold, and nothing else."""

from __future__ import annotations

import json
import struct
import tracemalloc
from dataclasses import replace
from itertools import product
from typing import Any

import numcodecs.zstd
import numpy as np
import pytest
from hostile_files import (
    CHUNK,
    DOCUMENT,
    edited,
    frame,
    put_at,
    read_everything,
    refused,
    replaced,
)
from rarely import rarely
from tiled_files import NAME, chunk_of, random_values, tiled, tiles_of, write_tiled

from fhash_formats import native
from fhash_formats.container import Container, tiles_together
from fhash_formats.container.array import (
    MAX_TOGETHER,
    PACKAGE,
    SINGLE_MEMBER_TILES,
    TRANSFORM,
    ArrayMetadata,
    PlainCoder,
    chunk_coder,
    plain_codecs,
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
    ("data_type", "float64", "zstd declares|asks for float32"),
    ("codecs", {"a": 1}, "codecs"),
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
    ("codecs", ["bytes", 5], "codecs"),
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
    tiles = replace(tiled(np.zeros((5, 7), np.float32), (2, 3), (2, 2)), attributes={"a": 1})
    codec = {"name": TRANSFORM, "configuration": {"axes": ["y", "x"]}}
    for one in (tiles, replace(tiles, codecs=[codec])):
        assert ArrayMetadata.from_dict(one.to_dict()) == one


def test_every_chunk_has_its_name_and_its_region() -> None:
    array = metadata()
    tiles = tiled(np.zeros((5, 7), np.float32), (2, 3), (2, 2))
    assert (array.grid, array.members, array.indexed) == ((3, 3), (3, 3), False)
    assert (tiles.grid, tiles.members, tiles.indexed) == ((3, 3), (2, 2), True)
    for one in (array, tiles):
        values = np.zeros((5, 7), int)
        for number, member in enumerate(product(*map(range, one.members))):
            named = f"t/{number}" if one is tiles else f"c/{member[0]}/{member[1]}"
            assert one.member_name(member) == named
            for index in one.chunks_of(member):
                values[one.region(index)] += 1
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
        "zstd declares 67108864 bytes; the chunk has 20",
    ),
    "bomb of unknown size": (lambda right: frame(bytes(1 << 16)), "zstd declares"),
    "bomb that lies": (lambda right: frame(bytes(1 << 16), size=20), "zstd data are damaged"),
    "two frames": (lambda right: numcodecs.zstd.compress(right, 1) * 2, "zstd data are damaged"),
    "fewer bytes": (lambda right: frame(right[:16], size=20), "zstd data are damaged"),
    "declares 2^63": (lambda right: frame(right, size=2**63), "zstd declares"),
    "other content": (lambda right: right, "not a zstd frame"),
    "empty": (lambda right: b"", "not a zstd frame"),
    "header only": (
        lambda right: frame(right, size=20)[:8],
        "not a zstd frame",
    ),
}


@pytest.mark.parametrize("case", CHUNKS)
def test_chunk_data(sample, samples, case) -> None:
    make, message = CHUNKS[case]
    coded = make(np.arange(5, dtype="<f4").tobytes())
    coded += struct.pack("<I", crc32c(coded))
    data = replaced(sample, samples, CHUNK, coded)
    refused(sample, data, f"member {CHUNK}: {message}")


@pytest.mark.parametrize(
    "coded", [b"", b"abc", b"abcd", numcodecs.zstd.compress(bytes(20), 1) + b"abcd"]
)
def test_chunk_without_its_crc(sample, samples, coded) -> None:
    data = replaced(sample, samples, CHUNK, coded)
    refused(sample, data, f"member {CHUNK}: .*CRC-32C")


def test_frame_made_by_hand_is_read(sample, samples) -> None:
    """The hostile frames above differ from this one only in what they are refused for."""
    right = np.arange(5, dtype="<f4")
    coded = frame(right.tobytes(), size=20)
    coded += struct.pack("<I", crc32c(coded))
    sample.write_bytes(replaced(sample, samples, CHUNK, coded))
    with Container.open(sample) as container:
        np.testing.assert_array_equal(container.arrays["mlp/bias_1"].read(), right)


def test_bytes_of_members_of_tiles(tmp_path, samples) -> None:
    """Tiles without gaps, in C order; chunks of an ordinary array of uint32 have their sizes."""
    values = random_values((7, 6))
    path = write_tiled(tmp_path / "a.fhz", samples, values, (2, 3), (2, 2))
    parts = dict(samples.unpack(path.read_bytes()))
    metadata = tiled(values, (2, 3), (2, 2))
    padded = np.pad(values, ((0, 1), (0, 0)))
    coded = {i: metadata.coder.encode(chunk_of(padded, i, (2, 3))) for i in tiles_of(metadata)}
    for number in (0, 1):
        streams = [coded[index] for index in metadata.chunks_of((number, 0))]
        assert parts[f"{NAME}/t/{number}"] == b"".join(streams)
        sizes = np.reshape([len(each) for each in streams], (2, 2)).astype(np.uint32)
        coder = PlainCoder(plain_codecs(sizes.dtype), sizes.dtype, (2, 2))
        assert parts[f"{NAME}/c/{number}/0"] == coder.encode(sizes)
    document = json.loads(parts[f"{NAME}/zarr.json"])
    assert (document["shape"], document["data_type"]) == ([4, 2], "uint32")
    assert document["attributes"]["tiles"] == {
        "codec": TRANSFORM,
        "package": PACKAGE,
        "shape": [7, 6],
        "data_type": "float32",
        "tile": [2, 3],
    }


@pytest.fixture
def line(tmp_path, samples):
    """One member of four tiles, of which the last is beyond the end of the array; file, parts."""
    path = write_tiled(tmp_path / "a.fhz", samples, random_values((5,)), (2,), (4,))
    read_everything(path)  # modules are loaded before memory is measured
    return path, dict(samples.unpack(path.read_bytes()))


def refused_tiles(path, samples, parts, message, kind=DamagedFileError) -> None:
    path.write_bytes(samples.pack(parts.items()))
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


INDEX = f"{NAME}/c/0"
SIZES = {
    "more": lambda sizes: sizes.__setitem__(1, sizes[1] + 1),
    "less": lambda sizes: sizes.__setitem__(2, sizes[2] - 1),
    "much more": lambda sizes: sizes.__setitem__(0, 2**32 - 1),
    "sum beyond 2^32": lambda sizes: sizes.__setitem__(slice(0, 3), 2**31),
    "a tile beyond the array": lambda sizes: sizes.__setitem__(slice(2, 4), sizes[3:1:-1]),
    "nothing": lambda sizes: sizes.fill(0),
}


@pytest.mark.parametrize("case", SIZES)
def test_sizes_that_do_not_fill_their_member(line, samples, case) -> None:
    path, parts = line
    sizes = np.frombuffer(numcodecs.zstd.decompress(parts[INDEX][:-4]), np.uint32).copy()
    SIZES[case](sizes)
    parts[INDEX] = PlainCoder(plain_codecs(sizes.dtype), sizes.dtype, (4,)).encode(sizes)
    refused_tiles(path, samples, parts, f"member {NAME}/t/0: the index of its tiles")


@pytest.mark.parametrize("moved", [4, ...])
def test_sizes_that_are_exchanged(line, samples, moved) -> None:
    """They fill the member, but tiles begin within another one, or have no bytes."""
    path, parts = line
    sizes = np.frombuffer(numcodecs.zstd.decompress(parts[INDEX][:-4]), np.uint32).copy()
    moved = sizes[1] if moved is ... else moved
    sizes[0] += moved
    sizes[1] -= moved
    parts[INDEX] = PlainCoder(plain_codecs(sizes.dtype), sizes.dtype, (4,)).encode(sizes)
    refused_tiles(path, samples, parts, f"member {NAME}/t/0: ")


@pytest.mark.parametrize("data", [b"", b"abcd", b"x" * 67])
def test_an_index_that_cannot_be_decoded(line, samples, data) -> None:
    path, parts = line
    parts[INDEX] = data
    refused_tiles(path, samples, parts, f"member {INDEX}: .*CRC-32C")


MEMBERS = {
    "index missing": (lambda p: p.pop(INDEX), f"{NAME} has 0 chunks"),
    "tiles missing": (lambda p: p.pop(f"{NAME}/t/0"), f"{NAME} has 0 chunks"),
    "index twice": (lambda p: p.update({f"{NAME}/c/1": b"x"}), f"{NAME} has 2 chunks"),
    "tiles twice": (lambda p: p.update({f"{NAME}/t/1": b"x"}), f"{NAME} has 2 chunks"),
    "tiles of other axes": (lambda p: p.update({f"{NAME}/t/0/0": b"x"}), "belongs to no array"),
    "tiles of another name": (lambda p: p.update({f"{NAME}/t/00": b"x"}), "belongs to no array"),
    "tiles of numbers": (
        lambda p: p.update({"table_1/t/0": b"x"}),
        "member table_1/t/0 belongs to no array",
    ),
    # As a number of 64 bits without a sign this is 0 beyond 2^63.
    "tiles of a giant number": (
        lambda p: p.update({f"{NAME}/t/{1 << 63}": p.pop(f"{NAME}/t/0")}),
        "has 0 chunks",
    ),
    "tiles outside": (
        lambda p: p.update({f"{NAME}/t/1": p.pop(f"{NAME}/t/0")}),
        f"member {NAME}/t/1 belongs to no array",
    ),
}


@pytest.mark.parametrize("case", MEMBERS)
def test_members_of_tiles_are_all_there(line, samples, case) -> None:
    path, parts = line
    change, message = MEMBERS[case]
    change(parts)
    parts["zarr.json"] = parts.pop("zarr.json")
    refused_tiles(path, samples, parts, message)


def test_a_tile_alone_in_its_member_has_no_index(tmp_path, samples) -> None:
    path = write_tiled(tmp_path / "a.fhz", samples, random_values((5,)), (2,))
    parts = dict(samples.unpack(path.read_bytes()))
    assert [name for name in parts if name.startswith(f"{NAME}/")] == [
        *(f"{NAME}/t/{number}" for number in range(3)),
        f"{NAME}/zarr.json",
    ]
    refused_tiles(path, samples, {INDEX: b"x", **parts}, f"member {INDEX} belongs to no array")


def changed_document(line, changes: dict[str, Any]) -> dict[str, bytes]:
    """The parts with values at places of the document of the tiles."""
    _, parts = line
    document = json.loads(parts[f"{NAME}/zarr.json"])
    for place, value in changes.items():
        put_at(document, place, value)
    return {**parts, f"{NAME}/zarr.json": json.dumps(document).encode()}


CHUNK_SHAPE = "chunk_grid.configuration.chunk_shape"
DOCUMENTS = {
    "no object": ({"attributes.tiles": 5}, UnsupportedFileError),
    "no codec": ({"attributes.tiles.codec": ...}, UnsupportedFileError),
    "another codec": ({"attributes.tiles.codec": "fhash.teleport"}, UnsupportedFileError),
    "another key": ({"attributes.tiles.surprise": 1}, UnsupportedFileError),
    "an index of int32": ({"data_type": "int32"}, DamagedFileError),
    "no type": ({"attributes.tiles.data_type": ...}, UnsupportedFileError),
    "another type": ({"attributes.tiles.data_type": "complex64"}, UnsupportedFileError),
    "no shape": ({"attributes.tiles.shape": ...}, DamagedFileError),
    "another shape": ({"attributes.tiles.shape": [7]}, DamagedFileError),
    "shape of two axes": ({"attributes.tiles.shape": [5, 1]}, DamagedFileError),
    "no tile": ({"attributes.tiles.tile": ...}, DamagedFileError),
    "tile no list": ({"attributes.tiles.tile": 2}, DamagedFileError),
    "tile of two axes": ({"attributes.tiles.tile": [2, 2]}, DamagedFileError),
    "tile of a fraction": ({"attributes.tiles.tile": [2.0]}, DamagedFileError),
    "tile of zero": ({"attributes.tiles.tile": [0]}, DamagedFileError),
    "tile of another grid": ({"attributes.tiles.tile": [3]}, DamagedFileError),
    "tile that overflows": (
        {"attributes.tiles.tile": [2**61], "attributes.tiles.shape": [2**62], "shape": [2]},
        DamagedFileError,
    ),
    "large tile": (
        {"attributes.tiles.tile": [2**28], "attributes.tiles.shape": [2**28], "shape": [1]},
        DamagedFileError,
    ),
    "many tiles": (
        {
            "attributes.tiles.shape": [2**48],
            "shape": [2**47],
            CHUNK_SHAPE: [2 * MAX_TOGETHER],
        },
        DamagedFileError,
    ),
    "settings of no base64": ({"attributes.tiles.settings": "?"}, DamagedFileError),
    "settings of no text": ({"attributes.tiles.settings": 5}, DamagedFileError),
    "empty settings": ({"attributes.tiles.settings": ""}, DamagedFileError),
    "axes no list": ({"attributes.tiles.axes": "x"}, DamagedFileError),
    "axes too many": ({"attributes.tiles.axes": ["y", "x"]}, DamagedFileError),
    "an axis of no name": ({"attributes.tiles.axes": ["w"]}, DamagedFileError),
    "an axis that tiles lack": ({"attributes.tiles.axes": [""]}, DamagedFileError),
}


@pytest.mark.parametrize("case", DOCUMENTS)
def test_tiles_that_are_described_wrongly(line, samples, case) -> None:
    changes, kind = DOCUMENTS[case]
    parts = changed_document(line, changes)
    refused_tiles(line[0], samples, parts, f"member {NAME}/zarr.json: ", kind)


def test_many_tiles_in_a_few_bytes(line, samples) -> None:
    """A million tiles of 2^27 vertices; the index lacks their sizes."""
    parts = changed_document(
        line,
        {
            "attributes.tiles.tile": [2**27],
            "attributes.tiles.shape": [2**47],
            "shape": [MAX_TOGETHER],
            CHUNK_SHAPE: [MAX_TOGETHER],
        },
    )
    refused_tiles(line[0], samples, parts, f"member {INDEX}: zstd declares|memory")


@pytest.mark.parametrize("part", [0, *rarely(1, 2, 3)])
def test_every_flip_in_tiles_is_found(tiled_file, samples, part) -> None:
    path, _ = tiled_file
    sound = path.read_bytes()
    members = [*samples.members(path, f"{NAME}/t").values()]
    for member in [*members, *samples.members(path, f"{NAME}/c").values()]:
        for at in range(member.offset + part, member.end, 4):
            damaged = bytearray(sound)
            damaged[at] ^= 4
            path.write_bytes(damaged)
            with (
                pytest.raises(DamagedFileError, match=f"member {NAME}/[ct]/"),
                Container.open(path) as container,
            ):
                container.verify()
            if at >= member.data_offset or member not in members:
                with (
                    pytest.raises(DamagedFileError, match=f"member {NAME}/[ct]/"),
                    Container.open(path) as container,
                ):
                    container.arrays[NAME].read()


@pytest.mark.parametrize(
    ("grid", "together"),
    [
        ((1, 1, 1, 1), (1, 1, 1, 1)),
        ((4, 32, 32, 1), (4, 32, 32, 1)),
        ((SINGLE_MEMBER_TILES + 1, 1, 1, 1), (1, 1, 1, 1)),
        ((3, 32, 32, 2), (1, 32, 32, 2)),
    ],
)
def test_a_large_array_has_a_member_for_each_layer(grid, together) -> None:
    assert tiles_together(grid) == together


@pytest.mark.parametrize(
    ("grid", "largest", "together"),
    [
        ((4, 3, 5, 2), 1 << 20, (4, 3, 5, 2)),  # 120 MiB fit
        ((4, 3, 5, 2), 1 << 25, (2, 3, 5, 2)),  # 3.8 GiB: half of the steps
        ((4, 3, 5, 2), 1 << 27, (1, 1, 5, 2)),  # 15 GiB: a third of a layer, 1.3 GiB
        ((4, 3, 5, 2), 1 << 29, (1, 1, 2, 2)),
        ((4, 3, 5, 2), MAX_MEMBER // 2, (1, 1, 1, 2)),
        ((4, 3, 5, 2), MAX_MEMBER, (1, 1, 1, 1)),  # no member can hold such a tile
        ((2, 1 << 7, 1 << 7, 1 << 7), 1, (1, 1 << 6, 1 << 7, 1 << 7)),  # 2^20 tiles
    ],
)
def test_members_stay_within_the_limits(grid, largest, together) -> None:
    sizes = np.full(np.prod(grid), largest, np.int64)
    assert tiles_together(grid, sizes) == together
    if grid[0] == 4:
        order = tiles_of(tiled(np.zeros(grid, np.float32), (1, 1, 1, 1), together))
        assert order == list(product(*map(range, grid)))


def test_the_largest_member_decides() -> None:
    sizes = np.ones((4, 2, 1, 1), np.int64)
    sizes[2] = MAX_MEMBER // 2 - 100
    assert tiles_together(sizes.shape, sizes.ravel()) == (4, 2, 1, 1)
    sizes[3, 0] = 1000
    assert tiles_together(sizes.shape, sizes.ravel()) == (1, 2, 1, 1)
