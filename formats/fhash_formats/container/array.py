"""Arrays: metadata, values of a chunk as bytes, many chunks in one member."""

from __future__ import annotations

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
from fhash_formats.native import crc32c
from fhash_formats.support.threads import chunk_region
from fhash_formats.support.values import DTYPES
from fhash_formats.transform.values import ZSTD_LEVEL

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
        """A coder of full chunks. codecs: what `plain_codecs` gave; shape: any."""
        self._level, self._stored = codecs[1]["configuration"]["level"], dtype.newbyteorder("<")

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
    codecs: Sequence[Codec], dtype: np.dtype[Any], shape: tuple[int, ...]
) -> PlainCoder | TransformCoder:
    """The coder for chunks of this number type and full shape."""
    return ARRAY_CODECS[codecs[0]["name"]](codecs, dtype, shape)


def plain_codecs(dtype: np.dtype[Any], level: int = ZSTD_LEVEL) -> list[Codec]:
    """The codecs of ordinary arrays, in the form in which the zarr library writes them."""
    first = {"name": "bytes"} if dtype.itemsize == 1 else _LITTLE
    return [first, {"name": "zstd", "configuration": {"level": level, "checksum": False}}, CRC32C]


def with_crc32c(data: bytes) -> bytes:
    """`data` followed by its CRC-32C: the codec `crc32c`."""
    return data + _CRC.pack(crc32c(data))


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

ENTRY_BYTES = 16
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


def sharding_of(codecs: Sequence[Codec], shard_shape: tuple[int, ...]) -> Sharding | None:
    """The sharding that an array's codecs ask for; None where they ask for none."""
    if codecs[0]["name"] != SHARDING:
        return None
    settings = codecs[0]["configuration"]
    inner = tuple(settings["chunk_shape"])
    return Sharding(shard_shape=shard_shape, chunk_shape=inner, codecs=settings["codecs"])


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


MAX_DIMENSIONS = 8
"""Axes of an array."""


@dataclass(frozen=True, kw_only=True)
class ArrayMetadata:
    """Shape, number type, chunking and codecs of an array.

    A member of the file holds one chunk of `chunk_shape`. Where the codecs ask for shards
    (`sharding`), that chunk is a shard of many inner chunks, each decoded alone. Elsewhere the
    chunk is its own and only inner chunk.

    Every length is at least 1. The last inner chunks along an axis are stored in full, padded
    with 0.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    chunk_shape: tuple[int, ...]
    codecs: Sequence[Mapping[str, Any]]
    dimension_names: tuple[str | None, ...] | None = None
    attributes: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def sharding(self) -> Sharding | None:
        """Division of a member into inner chunks; None where the member is one chunk."""
        return sharding_of(self.codecs, self.chunk_shape)

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
        """The metadata in a zarr.json that libfhash has checked."""
        names = values.get("dimension_names")
        return cls(
            shape=tuple(values["shape"]),
            dtype=DTYPES[values["data_type"]],
            chunk_shape=tuple(values["chunk_grid"]["configuration"]["chunk_shape"]),
            codecs=values["codecs"],
            dimension_names=None if names is None else tuple(names),
            attributes=values.get("attributes", {}),
        )
