"""`ShardPlaces`: where inner chunks of an array of shards lie, read from the shards' indices."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import product
from math import prod

import numpy as np
import numpy.typing as npt

from fhash_formats.container.layout import Member
from fhash_formats.container.ranges import Range
from fhash_formats.container.sharding import (
    ENTRY_BYTES,
    Index,
    Sharding,
    parse_entry,
    parse_index,
)
from fhash_formats.container.source import Source
from fhash_formats.errors import DamagedFileError
from fhash_formats.support.fork_lock import ForkLock

__all__ = ["SPARSE_SHARE", "ShardPlaces"]

SPARSE_SHARE = 4
"""Index entries are read one by one for fewer than one in SPARSE_SHARE inner chunks of a shard."""


class ShardPlaces:
    """Indices of an array's shards, each read once; safe for several threads."""

    def __init__(
        self,
        sharding: Sharding,
        shape: Sequence[int],
        members: Mapping[Index, Member],
        source: Source,
    ) -> None:
        """Read nothing yet.

        shape: of the array. members: of the file, by index of the shard.
        """
        self._sharding, self._shape, self._members, self._source = sharding, shape, members, source
        self._indices: dict[Index, npt.NDArray[np.int64]] = {}
        self._entries: dict[tuple[Index, int], tuple[int, int]] = {}
        self._lock = ForkLock()

    def read(self, spans: Sequence[range]) -> None:
        """Read what the inner chunks of `spans` need of each shard's index: all of it, or entries.

        Raises DamagedFileError that names the member.
        """
        parts = list(self._sharding.parts(spans))
        if self._source.gap:
            self._source.prefetch(self._unread(parts))
        for shard, in_shard in parts:
            if self._wholly(in_shard):
                self._index(shard)
            else:
                for index in product(*in_shard):
                    self._entry(*self._sharding.place(index))

    def place(self, index: Index) -> tuple[Index, int, int, int]:
        """The shard of an inner chunk, its number there, and its offset in the member and bytes.

        Raises DamagedFileError that names the member.
        """
        shard, number = self._sharding.place(index)
        return shard, number, *self._entry(shard, number)

    def _wholly(self, in_shard: Sequence[range]) -> bool:
        """Whether the whole index is read for some inner chunks of a shard."""
        if self._sharding.index_bytes <= self._source.gap:
            return True
        return SPARSE_SHARE * prod(map(len, in_shard)) >= prod(self._sharding.counts)

    def _unread(self, parts: Sequence[tuple[Index, list[range]]]) -> Iterator[Range]:
        """The ranges of the file that `read` will read."""
        for shard, in_shard in parts:
            with self._lock:
                if shard in self._indices:
                    continue
            member = self._members[shard]
            start = member.data_offset + member.size - self._sharding.index_bytes
            if start < member.data_offset:
                continue  # damage, which `_index_place` tells
            if self._wholly(in_shard):
                yield start, self._sharding.index_bytes
            else:
                for index in product(*in_shard):
                    number = self._sharding.place(index)[1]
                    yield start + number * ENTRY_BYTES, ENTRY_BYTES

    def _entry(self, shard: Index, number: int) -> tuple[int, int]:
        """(offset in the member, bytes) of one inner chunk of a shard.

        They come from the shard's index if that was read, else from the entry alone, read once.
        """
        with self._lock:
            index = self._indices.get(shard)
            if index is not None:
                return int(index[number, 0]), int(index[number, 1])
            entry = self._entries.get((shard, number))
            if entry is None:
                with self._index_place(shard) as (start, data_bytes):
                    entry = parse_entry(
                        self._source.read(start + number * ENTRY_BYTES, ENTRY_BYTES), data_bytes
                    )
                self._entries[shard, number] = entry
        return entry

    def _index(self, shard: Index) -> None:
        """Read (offset in the member, bytes) of each inner chunk of a shard, (chunks, 2), once."""
        with self._lock:
            if shard in self._indices:
                return
            with self._index_place(shard) as (start, data_bytes):
                self._indices[shard] = parse_index(
                    self._source.read(start, self._sharding.index_bytes),
                    self._sharding.present(shard, self._shape),
                    data_bytes,
                )

    @contextmanager
    def _index_place(self, shard: Index) -> Iterator[tuple[int, int]]:
        """A block that reads a shard's index; its errors name the member.

        Yields the offset of the index in the file, and the number of bytes in the shard before it.
        """
        member = self._members[shard]
        data_bytes = member.size - self._sharding.index_bytes
        try:
            if data_bytes < 0:
                raise DamagedFileError(
                    f"{member.size} bytes are too few for the index of a shard, "
                    f"{self._sharding.index_bytes}"
                )
            yield member.data_offset + data_bytes, data_bytes
        except DamagedFileError as error:
            raise type(error)(f"member {member.name}: {error}") from error
