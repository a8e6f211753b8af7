"""Shards: many inner chunks in one member of the ZIP, with an index at the end of the member.

The layout is that of the Zarr v3 codec `sharding_indexed` 1.0. A shard has three parts:

1. the bytes of its inner chunks, in C order and without gaps;
2. an index of two uint64 (offset, bytes) for each inner chunk;
3. the CRC-32C of the index.

Inner chunks that lie wholly beyond the end of the array are absent, all others are present. So
nothing can overlap or hide.

A reader that wants few inner chunks may read their index entries alone. Each inner chunk has a
CRC-32C of its own, which tells a wrong entry as long as the entry lies within the shard
(`parse_entry`).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.container.coding import CRC32C, Codec, with_crc32c
from fhash_formats.container.zip_file import MAX_MEMBER
from fhash_formats.errors import DamagedFileError, UnsupportedFileError
from fhash_formats.native import crc32c

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
_CRC = struct.Struct("<I")
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

    def place(self, index: Index) -> tuple[Index, int]:
        """The shard in which the inner chunk `index` of an array lies, and its number there."""
        places = [divmod(i, count) for i, count in zip(index, self.counts, strict=True)]
        number = 0
        for (_, local), count in zip(places, self.counts, strict=True):
            number = number * count + local
        return tuple(shard for shard, _ in places), number

    def parts(self, spans: Sequence[range]) -> Iterator[tuple[Index, list[range]]]:
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

        `shape` is that of the array; the numbers of the inner chunks are those of `place`.
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
