"""Shards: many chunks in one member, found by an index at its end (Zarr v3, codec `sharding_indexed` 1.0).

A shard is the bytes of its inner chunks in C order without gaps, then an index of two uint64 (offset, bytes) for each, then the CRC-32C
of the index. Inner chunks that lie wholly beyond the end of the array are absent, all others present. So nothing can overlap or hide.

A reader that wants few inner chunks may read their entries alone: each inner chunk has a CRC-32C of its own, so that a wrong entry is
found without that of the index, as long as it lies within the shard (`parse_entry`).
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

from fhash_formats.container.coding import CRC32C, Codec, crc32c, with_crc32c
from fhash_formats.errors import DamagedFileError, UnsupportedFileError

SHARDING = "sharding_indexed"
MAX_SHARD_CHUNKS = 1 << 20
ABSENT = 2**64 - 1
"""Offset and bytes of an inner chunk that is not there."""

INDEX_CODECS: list[Codec] = [{"name": "bytes", "configuration": {"endian": "little"}}, CRC32C]

_ENTRY, _CRC = struct.Struct("<2Q"), struct.Struct("<I")
ENTRY_BYTES = _ENTRY.size
"""Of the index, for each inner chunk."""

Index = tuple[int, ...]


@dataclass(frozen=True, kw_only=True)
class Sharding:
    """`shard_shape`: vertices of a shard; `chunk_shape`: of an inner chunk, of which it is a multiple; `codecs`: of inner chunks."""

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
        parts = [divmod(i, count) for i, count in zip(index, self.counts, strict=True)]
        number = 0
        for (_, local), count in zip(parts, self.counts, strict=True):
            number = number * count + local
        return tuple(shard for shard, _ in parts), number

    def chunks_of(self, shard: Index, shape: Sequence[int]) -> Iterator[Index]:
        """The inner chunks of a shard of an array of `shape` that are present, in C order."""
        spans = []
        for s, count, chunk, n in zip(shard, self.counts, self.chunk_shape, shape, strict=True):
            spans.append(range(s * count, min((s + 1) * count, -(-n // chunk))))
        return product(*spans)

    def present(self, shard: Index, shape: Sequence[int]) -> npt.NDArray[np.bool_]:
        """Which inner chunks (numbers in the shard) are present: those that hold a vertex of the array of `shape`."""
        result = np.ones(1, dtype=bool)
        for s, count, chunk, n in zip(shard, self.counts, self.chunk_shape, shape, strict=True):
            axis = np.arange(count) < -(-n // chunk) - s * count
            result = (result[:, None] & axis).ravel()
        return result


def shard_order(
    shape: Sequence[int], chunk_shape: Sequence[int], shard_shape: Sequence[int]
) -> Iterator[Index]:
    """Indices of all inner chunks of an array in the order of the file: shards in C order, in each its inner chunks in C order."""
    sharding = Sharding(shard_shape=tuple(shard_shape), chunk_shape=tuple(chunk_shape), codecs=())
    for shard in product(
        *(range(-(-n // size)) for n, size in zip(shape, shard_shape, strict=True))
    ):
        yield from sharding.chunks_of(shard, shape)


def sharding_codecs(chunk_shape: Sequence[int], codecs: Sequence[Codec]) -> list[Codec]:
    """The codecs of an array of shards whose inner chunks of `chunk_shape` have `codecs`."""
    inner = {
        "chunk_shape": list(chunk_shape),
        "codecs": list(codecs),
        "index_codecs": INDEX_CODECS,
        "index_location": "end",
    }
    return [{"name": SHARDING, "configuration": inner}]


def parse_sharding(codecs: Sequence[Any], shard_shape: tuple[int, ...]) -> Sharding | None:
    """The sharding that an array's codecs ask for, None where they ask for none; raises DamagedFileError or UnsupportedFileError."""
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
            f"{SHARDING} with settings that are not allowed; the index is little-endian, crc32c, at the end"
        )
    shape, inner = settings.get("chunk_shape"), settings.get("codecs")
    if (
        not isinstance(shape, list)
        or len(shape) != len(shard_shape)
        or not all(type(n) is int and n >= 1 for n in shape)
    ):
        raise DamagedFileError(
            f"{SHARDING}: chunk_shape is {ascii(shape)[:80]}; {len(shard_shape)} whole numbers from 1 are needed"
        )
    if any(n % chunk for n, chunk in zip(shard_shape, shape, strict=True)):
        raise DamagedFileError(
            f"{SHARDING}: shards of {shard_shape} are no multiple of inner chunks of {tuple(shape)}"
        )
    if not isinstance(inner, list):
        raise DamagedFileError(f"{SHARDING}: codecs is not a list")
    sharding = Sharding(shard_shape=shard_shape, chunk_shape=tuple(shape), codecs=inner)
    if prod(sharding.counts) > MAX_SHARD_CHUNKS:
        raise DamagedFileError(
            f"{SHARDING}: {prod(sharding.counts)} inner chunks in a shard; the limit is {MAX_SHARD_CHUNKS}"
        )
    return sharding


def pack_index(sizes: Sequence[int], present: npt.NDArray[np.bool_]) -> bytes:
    """The index of a shard with its CRC-32C; `sizes`: bytes of the inner chunks that are present, in order."""
    table = np.full((present.size, 2), ABSENT, dtype="<u8")
    ends = np.cumsum(np.array(sizes, dtype=np.uint64), dtype=np.uint64)
    table[present, 0] = np.concatenate([np.zeros(1, np.uint64), ends[:-1]])
    table[present, 1] = sizes
    return with_crc32c(table.tobytes())


def parse_entry(data: bytes, data_bytes: int) -> tuple[int, int]:
    """(offset, bytes) of one inner chunk that should be present, from its entry alone; `data_bytes`: of the shard before its index.

    Raises DamagedFileError unless it lies in these bytes. Whether it overlaps others, is in order and is the right one, is not seen here.
    """
    offset, size = _ENTRY.unpack(data)
    if ABSENT in (offset, size):
        raise DamagedFileError("an inner chunk is missing from the shard's index")
    if size > data_bytes or offset > data_bytes - size:
        raise DamagedFileError(
            f"an inner chunk reaches beyond the shard, which has {data_bytes} bytes of them"
        )
    return offset, size


def parse_index(
    data: bytes, present: npt.NDArray[np.bool_], data_bytes: int
) -> npt.NDArray[np.int64]:
    """(offset, bytes) of each inner chunk of a shard, int64 (chunks, 2), (0, 0) where it is absent; `data_bytes`: before the index.

    Raises DamagedFileError unless the chunks that should be present, and no others, fill the bytes before the index in order.
    """
    coded = data[: -_CRC.size]
    if crc32c(coded) != _CRC.unpack(data[-_CRC.size :])[0]:
        raise DamagedFileError("the CRC-32C of the shard's index differs, the data are damaged")
    table = np.frombuffer(coded, dtype="<u8").reshape(-1, 2)
    there = table[present]
    if np.any(there == ABSENT):
        raise DamagedFileError("an inner chunk is missing from the shard's index")
    if np.any(table[~present] != ABSENT):
        raise DamagedFileError("the shard's index has an inner chunk beyond the end of the array")
    # Before the sum, which could overflow.
    if np.any(there[:, 1] > data_bytes):
        raise DamagedFileError(
            f"an inner chunk is larger than the shard, which has {data_bytes} bytes of them"
        )
    ends = np.cumsum(there[:, 1], dtype=np.uint64)
    if int(ends[-1]) != data_bytes or np.any(there[:, 0] != ends - there[:, 1]):
        raise DamagedFileError(
            "the inner chunks of the shard overlap, leave gaps or are not in order"
        )
    result = np.zeros(table.shape, dtype=np.int64)
    result[present] = there
    return result
