"""Arrays: metadata, values of a chunk as bytes, many chunks in one member."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from math import prod
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fhash_formats.container.zip_file import MAX_MEMBER
from fhash_formats.errors import DamagedFileError, InputError, UnsupportedFileError
from fhash_formats.native import crc32c
from fhash_formats.support.threads import chunk_region
from fhash_formats.support.values import DTYPES
from fhash_formats.transform.values import ZSTD_LEVEL, from_zstd

if TYPE_CHECKING:
    from fhash_formats.transform.stream import TransformCoder
    from fhash_formats.transform.tile_format import TileSettings

Codec = Mapping[str, Any]
"""A codec as Zarr v3 names it: {"name": str, "configuration": {...}}."""

CRC32C: Codec = {"name": "crc32c"}

_CRC = struct.Struct("<I")
_LITTLE: Codec = {"name": "bytes", "configuration": {"endian": "little"}}


class PlainCoder:
    """The coder of ordinary arrays: `bytes` (little-endian, C order), `zstd`, then `crc32c`."""

    def __init__(
        self, codecs: Sequence[Codec], dtype: np.dtype[Any], shape: tuple[int, ...]
    ) -> None:
        """Raises UnsupportedFileError for codecs other than these three."""
        level = (
            codecs[1].get("configuration", {}).get("level")
            if len(codecs) == 3 and codecs[1]["name"] == "zstd" and codecs[2] == CRC32C
            else None
        )
        if isinstance(level, bool) or not isinstance(level, int):
            raise UnsupportedFileError(
                f"codecs {_names(codecs)}; a container has bytes, zstd, crc32c"
            )
        expected = plain_codecs(dtype, level)
        # Zarr lets one-byte types state an endianness, which then means nothing.
        allowed = [expected[0], _LITTLE] if dtype.itemsize == 1 else [expected[0]]
        if codecs[0] not in allowed or codecs[1] != expected[1]:
            raise UnsupportedFileError(
                f"codecs {_names(codecs)} with settings that a container does not allow; "
                f"{expected} is allowed"
            )
        self._level, self._shape = level, shape
        self._stored, self._native = dtype.newbyteorder("<"), dtype.newbyteorder("=")
        self._size = prod(shape) * dtype.itemsize

    def encode(self, chunk: npt.NDArray[Any]) -> bytes:
        """The bytes of a full chunk, and their CRC-32C."""
        from numcodecs.zstd import compress

        try:
            packed = compress(np.ascontiguousarray(chunk, dtype=self._stored), self._level)
        except RuntimeError as error:
            if "not enough memory" in str(error):
                raise MemoryError(str(error)) from error
            raise
        return with_crc32c(packed)

    def check(self, data: memoryview) -> None:
        """Raises DamagedFileError where the CRC-32C differs."""
        without_crc32c(data)

    def decode(self, data: memoryview, lod: int = 0) -> npt.NDArray[Any]:
        """The full chunk; raises DamagedFileError for data that are not a full chunk.

        Raises InputError for a level of detail other than 0.
        """
        if lod:
            raise InputError(f"level of detail {lod}; the array has none but 0")
        values = from_zstd(without_crc32c(data), self._size, self._size)
        return values.view(self._stored).reshape(self._shape).astype(self._native, copy=False)


def _transform_coder(
    codecs: Sequence[Codec], dtype: np.dtype[Any], shape: tuple[int, ...]
) -> TransformCoder:
    """The coder of `fhash.transform`, loaded only for containers that have this codec."""
    from fhash_formats.transform.stream import TransformCoder

    return TransformCoder(codecs, dtype, shape)


TRANSFORM = "fhash.transform"
ARRAY_CODECS: dict[str, Callable[..., PlainCoder | TransformCoder]] = {
    "bytes": PlainCoder,
    TRANSFORM: _transform_coder,
}
"""Coder by the name of the first codec; the coder is given all codecs."""


def transform_codecs(settings: TileSettings) -> list[Codec]:
    """The codecs of an array whose tiles share some settings."""
    return [{"name": TRANSFORM, "configuration": {"settings": settings.to_text()}}]


def chunk_coder(
    codecs: Sequence[Any], dtype: np.dtype[Any], shape: tuple[int, ...]
) -> PlainCoder | TransformCoder:
    """The coder for chunks of this number type and full shape.

    Raises DamagedFileError for a list that is none of codecs, UnsupportedFileError for codecs that
    a container does not allow.
    """
    for codec in codecs:
        has_name = isinstance(codec, Mapping) and isinstance(codec.get("name"), str)
        if not has_name or not isinstance(codec.get("configuration", {}), Mapping):
            raise DamagedFileError("an array's codecs are not a list of {name, configuration}")
    if not codecs or codecs[0]["name"] not in ARRAY_CODECS:
        raise UnsupportedFileError(
            f"codecs {_names(codecs)}; known are {', '.join(ARRAY_CODECS)} at the beginning"
        )
    return ARRAY_CODECS[codecs[0]["name"]](codecs, dtype, shape)


def plain_codecs(dtype: np.dtype[Any], level: int = ZSTD_LEVEL) -> list[Codec]:
    """The codecs of ordinary arrays, in the form in which the zarr library writes them."""
    first = {"name": "bytes"} if dtype.itemsize == 1 else _LITTLE
    return [first, {"name": "zstd", "configuration": {"level": level, "checksum": False}}, CRC32C]


def with_crc32c(data: bytes) -> bytes:
    """`data` followed by its CRC-32C: the codec `crc32c`."""
    return data + _CRC.pack(crc32c(data))


def without_crc32c(data: memoryview) -> memoryview:
    """`data` without the CRC-32C at their end; raises DamagedFileError where it differs."""
    if len(data) < _CRC.size:
        raise DamagedFileError(f"{len(data)} bytes are too few for a CRC-32C")
    coded = data[: -_CRC.size]
    if crc32c(coded) != _CRC.unpack(data[-_CRC.size :])[0]:
        raise DamagedFileError("its CRC-32C differs, the data are damaged")
    return coded


def _names(codecs: Sequence[Codec]) -> str:
    return ascii(", ".join(codec["name"] for codec in codecs)[:200])


SHARDING = "sharding_indexed"
"""Name of the codec that makes the chunks of an array shards."""
MAX_SHARD_CHUNKS = 1 << 20
"""Inner chunks of a shard that a reader accepts."""
SINGLE_SHARD_CHUNKS = 4096
"""Inner chunks up to which `shard_shape` puts a whole array into one shard."""
ABSENT = 2**64 - 1
"""Number that stands for both the offset and the bytes of an absent inner chunk."""

INDEX_CODECS: list[Codec] = [{"name": "bytes", "configuration": {"endian": "little"}}, CRC32C]
"""Codecs of the index; no others are allowed."""

_ENTRY = struct.Struct("<2Q")
ENTRY_BYTES = _ENTRY.size
"""Bytes that the index has for each inner chunk."""

Index = tuple[int, ...]


@dataclass(frozen=True, kw_only=True)
class Sharding:
    """Division of an array into shards, and of a shard into inner chunks.

    Attributes:
        shard_shape: vertices of a shard along each axis, a multiple of `chunk_shape`.
        chunk_shape: vertices of an inner chunk along each axis.
        codecs: codecs of the inner chunks.
    """

    shard_shape: tuple[int, ...]
    chunk_shape: tuple[int, ...]
    codecs: Sequence[Codec]

    @property
    def counts(self) -> tuple[int, ...]:
        """Inner chunks of a shard along each axis."""
        return tuple(
            n // chunk for n, chunk in zip(self.shard_shape, self.chunk_shape, strict=True)
        )

    @property
    def index_bytes(self) -> int:
        """Bytes of the index of a shard with its CRC-32C."""
        return prod(self.counts) * ENTRY_BYTES + _CRC.size

    def locate(self, index: Index) -> tuple[Index, int]:
        """The shard in which the inner chunk `index` of an array lies, and its number there."""
        places = [divmod(i, count) for i, count in zip(index, self.counts, strict=True)]
        number = 0
        for (_, local), count in zip(places, self.counts, strict=True):
            number = number * count + local
        return tuple(shard for shard, _ in places), number

    def by_shard(self, spans: Sequence[range]) -> Iterator[tuple[Index, list[range]]]:
        """The shards of some inner chunks of an array, and the inner chunks in each, by axis.

        spans: of inner chunks along each axis.
        """
        shards = (
            range(span.start // count, (span.stop - 1) // count + 1)
            for span, count in zip(spans, self.counts, strict=True)
        )
        for shard in product(*shards):
            in_shard = (
                range(max(span.start, s * n), min(span.stop, (s + 1) * n))
                for span, s, n in zip(spans, shard, self.counts, strict=True)
            )
            yield shard, list(in_shard)

    def chunks_of(self, shard: Index, shape: Sequence[int]) -> Iterator[Index]:
        """The inner chunks present in a shard of an array of `shape`, in C order.

        Indices are those of the array's grid of inner chunks.
        """
        spans = []
        for s, count, chunk, n in zip(shard, self.counts, self.chunk_shape, shape, strict=True):
            spans.append(range(s * count, min((s + 1) * count, -(-n // chunk))))
        return product(*spans)

    def present(self, shard: Index, shape: Sequence[int]) -> npt.NDArray[np.bool_]:
        """A mask (chunks of the shard,) of those that are present: they hold a vertex of the array.

        `shape` is that of the array; the numbers of the inner chunks are those of `locate`.
        """
        present = np.ones(1, dtype=bool)
        for s, count, chunk, n in zip(shard, self.counts, self.chunk_shape, shape, strict=True):
            present_along_axis = np.arange(count) < -(-n // chunk) - s * count
            present = (present[:, None] & present_along_axis).ravel()
        return present


def shard_order(
    shape: Sequence[int], chunk_shape: Sequence[int], shard_shape: Sequence[int]
) -> Iterator[Index]:
    """Yield the index of every inner chunk of an array in the order of the file.

    Shards come in C order, and within each shard its inner chunks in C order.
    """
    sharding = Sharding(shard_shape=tuple(shard_shape), chunk_shape=tuple(chunk_shape), codecs=())
    for shard in product(
        *(range(-(-n // size)) for n, size in zip(shape, shard_shape, strict=True))
    ):
        yield from sharding.chunks_of(shard, shape)


def shard_shape(
    chunk_shape: Sequence[int], grid: Sequence[int], sizes: npt.NDArray[np.int64] | None = None
) -> Index:
    """The shape of the shards that a writer chooses for an array of `grid` inner chunks.

    One shard holds the whole array up to SINGLE_SHARD_CHUNKS inner chunks. A larger array gets a
    shard for each layer of inner chunks along the first axis. Shards beyond the limits of the
    format are halved, along the first axis first, so that C order stays the order of the file.

    sizes: coded bytes of each inner chunk in C order; None for an array that is not that large.
    """
    counts = [grid[0] if prod(grid) <= SINGLE_SHARD_CHUNKS else 1, *grid[1:]]
    for axis in range(len(counts)):
        while counts[axis] > 1 and _beyond_limits(counts, grid, sizes):
            counts[axis] = -(-counts[axis] // 2)
    return tuple(n * count for n, count in zip(chunk_shape, counts, strict=True))


def _beyond_limits(
    counts: Sequence[int], grid: Sequence[int], sizes: npt.NDArray[np.int64] | None
) -> bool:
    """Whether shards of so many inner chunks along each axis have too many, or too many bytes."""
    if prod(counts) > MAX_SHARD_CHUNKS:
        return True
    if sizes is None:
        return False
    total = np.reshape(sizes + _CRC.size, grid)
    for axis, count in enumerate(counts):
        total = np.add.reduceat(total, range(0, grid[axis], count), axis=axis)
    return int(total.max()) + prod(counts) * ENTRY_BYTES + _CRC.size > MAX_MEMBER


def sharding_codecs(chunk_shape: Sequence[int], codecs: Sequence[Codec]) -> list[Codec]:
    """The codecs of an array of shards whose inner chunks of `chunk_shape` have `codecs`."""
    configuration = {
        "chunk_shape": list(chunk_shape),
        "codecs": list(codecs),
        "index_codecs": INDEX_CODECS,
        "index_location": "end",
    }
    return [{"name": SHARDING, "configuration": configuration}]


def parse_sharding(codecs: Sequence[Any], shard_shape: tuple[int, ...]) -> Sharding | None:
    """The sharding that an array's codecs ask for; None where they ask for none.

    Raises DamagedFileError for a configuration that contradicts itself or the shards, and
    UnsupportedFileError for one that a container does not allow.
    """
    if not codecs or not isinstance(codecs[0], Mapping) or codecs[0].get("name") != SHARDING:
        return None
    settings = codecs[0].get("configuration")
    if len(codecs) != 1 or not isinstance(settings, Mapping):
        raise UnsupportedFileError(
            f"codecs with {SHARDING} that is not the only one, or without configuration"
        )
    unknown = settings.keys() - {"chunk_shape", "codecs", "index_codecs", "index_location"}
    if (
        unknown
        or settings.get("index_codecs") != INDEX_CODECS
        or settings.get("index_location", "end") != "end"
    ):
        raise UnsupportedFileError(
            f"{SHARDING} with settings that are not allowed; "
            "the index is little-endian, crc32c, at the end"
        )
    if not isinstance(settings.get("codecs"), list):
        raise DamagedFileError(f"{SHARDING}: codecs is not a list")
    sharding = Sharding(
        shard_shape=shard_shape,
        chunk_shape=_inner_shape(settings.get("chunk_shape"), shard_shape),
        codecs=settings["codecs"],
    )
    if prod(sharding.counts) > MAX_SHARD_CHUNKS:
        raise DamagedFileError(
            f"{SHARDING}: {prod(sharding.counts)} inner chunks in a shard; "
            f"the limit is {MAX_SHARD_CHUNKS}"
        )
    return sharding


def _inner_shape(shape: object, shard_shape: tuple[int, ...]) -> Index:
    """The shape of an inner chunk, checked against that of the shard; raises DamagedFileError."""
    if (
        not isinstance(shape, list)
        or len(shape) != len(shard_shape)
        or not all(type(n) is int and n >= 1 for n in shape)
    ):
        raise DamagedFileError(
            f"{SHARDING}: chunk_shape is {ascii(shape)[:80]}; "
            f"{len(shard_shape)} whole numbers from 1 are needed"
        )
    if any(n % chunk for n, chunk in zip(shard_shape, shape, strict=True)):
        raise DamagedFileError(
            f"{SHARDING}: shards of {shard_shape} are no multiple of inner chunks of {tuple(shape)}"
        )
    return tuple(shape)


def pack_index(sizes: Sequence[int], present: npt.NDArray[np.bool_]) -> bytes:
    """The index of a shard with its CRC-32C.

    Args:
        sizes: bytes of each inner chunk that is present, in C order.
        present: mask of the inner chunks of the shard (`Sharding.present`).
    """
    table = np.full((present.size, 2), ABSENT, dtype="<u8")
    ends = np.cumsum(np.array(sizes, dtype=np.uint64), dtype=np.uint64)
    table[present, 0] = np.concatenate([np.zeros(1, np.uint64), ends[:-1]])
    table[present, 1] = sizes
    return with_crc32c(table.tobytes())


def parse_entry(data: bytes, data_bytes: int) -> tuple[int, int]:
    """(offset, bytes) of one inner chunk that should be present, from its entry of the index alone.

    `data_bytes` is the number of bytes in the shard before its index. Raises DamagedFileError
    unless the inner chunk lies within these bytes. An entry alone does not show whether its inner
    chunk overlaps others, is in order or is the right one.
    """
    offset, size = _ENTRY.unpack(data)
    if ABSENT in (offset, size):
        raise DamagedFileError("an inner chunk is missing from the shard's index")
    if size > data_bytes or offset > data_bytes - size:
        raise DamagedFileError(
            f"an inner chunk reaches beyond the shard, whose inner chunks have {data_bytes} bytes"
        )
    return offset, size


def parse_index(
    data: bytes, present: npt.NDArray[np.bool_], data_bytes: int
) -> npt.NDArray[np.int64]:
    """The index of a shard: (offset, bytes) of each inner chunk, (0, 0) for an absent one.

    Args:
        data: bytes of the index and its CRC-32C.
        present: mask of the inner chunks that should be present (`Sharding.present`).
        data_bytes: number of bytes in the shard before its index.

    Returns:
        int64 (inner chunks of the shard, 2).

    Raises:
        DamagedFileError: unless the chunks that should be present, and no others, fill the bytes
            before the index in order.
    """
    coded = data[: -_CRC.size]
    if crc32c(coded) != _CRC.unpack(data[-_CRC.size :])[0]:
        raise DamagedFileError("the CRC-32C of the shard's index differs, the data are damaged")
    table = np.frombuffer(coded, dtype="<u8").reshape(-1, 2)
    entries = table[present]
    if np.any(entries == ABSENT):
        raise DamagedFileError("an inner chunk is missing from the shard's index")
    if np.any(table[~present] != ABSENT):
        raise DamagedFileError("the shard's index has an inner chunk beyond the end of the array")
    # Single sizes are checked first, because the sum of hostile ones could overflow.
    if np.any(entries[:, 1] > data_bytes):
        raise DamagedFileError(
            f"an inner chunk is larger than the shard, whose inner chunks have {data_bytes} bytes"
        )
    ends = np.cumsum(entries[:, 1], dtype=np.uint64)
    if int(ends[-1]) != data_bytes or np.any(entries[:, 0] != ends - entries[:, 1]):
        raise DamagedFileError(
            "the inner chunks of the shard overlap, leave gaps or are not in order"
        )
    index = np.zeros(table.shape, dtype=np.int64)
    index[present] = entries
    return index


MAX_CHUNK_BYTES = 1 << 30
"""Bytes of a decoded inner chunk."""
MAX_DIMENSIONS = 8
"""Axes of an array."""
MAX_AXIS = 1 << 62
"""Length of an array or a chunk along one axis."""

_INDEX = re.compile(r"0|[1-9][0-9]{0,18}")
_KEYS = {
    "zarr_format",
    "node_type",
    "shape",
    "data_type",
    "chunk_grid",
    "chunk_key_encoding",
    "fill_value",
    "codecs",
}
_OPTIONAL_KEYS = {"attributes", "dimension_names", "storage_transformers"}


@dataclass(frozen=True, kw_only=True)
class ArrayMetadata:
    """Shape, number type, chunking and codecs of an array.

    A member of the file holds one chunk of `chunk_shape`. Where the codecs ask for shards
    (`sharding`), that chunk is a shard of many inner chunks, each decoded alone. Elsewhere the
    chunk is its own and only inner chunk.

    Every length is at least 1. The last inner chunks along an axis are stored in full, padded
    with 0. Raises DamagedFileError or UnsupportedFileError for what a container cannot hold.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    chunk_shape: tuple[int, ...]
    codecs: Sequence[Mapping[str, Any]]
    dimension_names: tuple[str | None, ...] | None = None
    attributes: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not 1 <= len(self.shape) <= MAX_DIMENSIONS or len(self.chunk_shape) != len(self.shape):
            raise DamagedFileError(
                f"shape {self.shape} with chunks {self.chunk_shape}; "
                f"1 to {MAX_DIMENSIONS} axes are allowed"
            )
        if self.dimension_names is not None and len(self.dimension_names) != len(self.shape):
            raise DamagedFileError(
                f"{len(self.dimension_names)} dimension names for {len(self.shape)} axes"
            )
        if self.chunk_bytes > MAX_CHUNK_BYTES:
            raise DamagedFileError(
                f"chunks of {self.chunk_bytes} bytes; the limit is {MAX_CHUNK_BYTES}"
            )
        _ = self.coder  # which refuses unsuitable codecs

    @cached_property
    def sharding(self) -> Sharding | None:
        """Division of a member into inner chunks; None where the member is one chunk."""
        return parse_sharding(self.codecs, self.chunk_shape)

    @cached_property
    def coder(self) -> PlainCoder | TransformCoder:
        """The coder of full inner chunks."""
        codecs = self.codecs if self.sharding is None else self.sharding.codecs
        return chunk_coder(codecs, self.dtype, self.inner_shape)

    @property
    def tiles(self) -> TransformCoder | None:
        """The coder of an array whose chunks are tiles; None for another one."""
        return None if isinstance(self.coder, PlainCoder) else self.coder

    @property
    def coding(self) -> str:
        """Name of the first codec of inner chunks."""
        codecs = self.codecs if self.sharding is None else self.sharding.codecs
        return str(codecs[0]["name"])

    @property
    def inner_shape(self) -> tuple[int, ...]:
        """Shape of an inner chunk, the least that is decoded."""
        return self.chunk_shape if self.sharding is None else self.sharding.chunk_shape

    @property
    def chunk_bytes(self) -> int:
        """Bytes of a decoded inner chunk."""
        return prod(self.inner_shape) * self.dtype.itemsize

    @property
    def grid(self) -> tuple[int, ...]:
        """Number of members along each axis."""
        return tuple(-(-n // chunk) for n, chunk in zip(self.shape, self.chunk_shape, strict=True))

    @property
    def inner_grid(self) -> tuple[int, ...]:
        """Number of inner chunks along each axis."""
        return tuple(-(-n // chunk) for n, chunk in zip(self.shape, self.inner_shape, strict=True))

    def chunk_key(self, index: Sequence[int]) -> str:
        """Name of the member of a chunk, below that of its array: "c/0/0"."""
        return "c/" + "/".join(str(i) for i in index)

    def parse_key(self, key: str) -> tuple[int, ...]:
        """The index of a chunk from its name; raises DamagedFileError if the array lacks it."""
        prefix, *numbers = key.split("/")
        if (
            prefix == "c"
            and len(numbers) == len(self.shape)
            and all(_INDEX.fullmatch(number) for number in numbers)
        ):
            index = tuple(int(number) for number in numbers)
            if all(i < n for i, n in zip(index, self.grid, strict=True)):
                return index
        raise DamagedFileError(f"no chunk of the array's grid {self.grid}")

    def inner_region(self, index: Sequence[int]) -> tuple[slice, ...]:
        """The region of the array that an inner chunk holds, cut at the array's end."""
        return chunk_region(index, self.inner_shape, self.shape)

    def to_dict(self) -> dict[str, Any]:
        """The array's zarr.json as JSON values."""
        values: dict[str, Any] = {
            "zarr_format": 3,
            "node_type": "array",
            "shape": list(self.shape),
            "data_type": self.dtype.name,
            "chunk_grid": {
                "name": "regular",
                "configuration": {"chunk_shape": list(self.chunk_shape)},
            },
            # The separator of the default encoding is "/" where none is named.
            "chunk_key_encoding": {"name": "default"},
            "fill_value": 0.0 if self.dtype.kind == "f" else 0,
            "codecs": list(self.codecs),
        }
        if self.dimension_names is not None:
            values["dimension_names"] = list(self.dimension_names)
        if self.attributes:
            values["attributes"] = dict(self.attributes)
        return values

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> ArrayMetadata:
        """The metadata in a zarr.json.

        Raises DamagedFileError or UnsupportedFileError that names the key.
        """
        missing = sorted(_KEYS - values.keys())
        if missing:
            raise DamagedFileError(f"key {missing[0]} is missing")
        check_keys(values, _KEYS | _OPTIONAL_KEYS)
        if values["data_type"] not in list(DTYPES):
            raise UnsupportedFileError(
                f"data_type is {_shown(values['data_type'])}; allowed: {', '.join(DTYPES)}"
            )
        shape = _lengths(values["shape"], "shape")
        chunk_shape = _chunk_shape(values["chunk_grid"])
        encoding = values["chunk_key_encoding"]
        if encoding not in (
            {"name": "default", "configuration": {"separator": "/"}},
            {"name": "default"},
        ):
            raise UnsupportedFileError(
                f"chunk_key_encoding is {_shown(encoding)}; only the default with '/' is allowed"
            )
        if isinstance(values["fill_value"], bool) or values["fill_value"] != 0:
            raise UnsupportedFileError(
                f"fill_value is {_shown(values['fill_value'])}; only 0 is allowed"
            )
        if values.get("storage_transformers", []) != []:
            raise UnsupportedFileError("storage_transformers are not allowed")
        if not isinstance(values["codecs"], list):
            raise DamagedFileError("codecs is not a list")
        return cls(
            shape=shape,
            dtype=DTYPES[values["data_type"]],
            chunk_shape=chunk_shape,
            codecs=values["codecs"],
            dimension_names=_dimension_names(values.get("dimension_names")),
            attributes=attributes_of(values),
        )


def check_keys(values: Mapping[str, Any], allowed: set[str]) -> None:
    """Raise UnsupportedFileError for a key of a zarr.json that is not allowed.

    A key whose object says that it need not be understood is ignored (Zarr v3, extension points).
    """
    for key in values.keys() - allowed:
        extension = values[key]
        if not isinstance(extension, Mapping) or extension.get("must_understand") is not False:
            raise UnsupportedFileError(f"key {_shown(key)} is not known")


def attributes_of(values: Mapping[str, Any]) -> Mapping[str, Any]:
    """The attributes in a zarr.json; raises DamagedFileError if they are no object."""
    attributes = values.get("attributes", {})
    if not isinstance(attributes, dict):
        raise DamagedFileError("attributes is not an object")
    return attributes


def _chunk_shape(grid: object) -> tuple[int, ...]:
    if (
        not isinstance(grid, Mapping)
        or grid.get("name") != "regular"
        or not isinstance(grid.get("configuration"), Mapping)
    ):
        raise UnsupportedFileError(f"chunk_grid is {_shown(grid)}; only regular grids are allowed")
    return _lengths(grid["configuration"].get("chunk_shape"), "chunk_shape")


def _lengths(value: object, key: str) -> tuple[int, ...]:
    if not isinstance(value, list) or not all(type(n) is int and 1 <= n <= MAX_AXIS for n in value):
        raise DamagedFileError(
            f"{key} is {_shown(value)}; a list of whole numbers from 1 to {MAX_AXIS} is needed"
        )
    return tuple(value)


def _dimension_names(value: object) -> tuple[str | None, ...] | None:
    if value is None:
        return None
    if not isinstance(value, list) or not all(
        name is None or isinstance(name, str) for name in value
    ):
        raise DamagedFileError(f"dimension_names is {_shown(value)}; a list of names is needed")
    return tuple(value)


def _shown(value: object) -> str:
    return ascii(value)[:80]
