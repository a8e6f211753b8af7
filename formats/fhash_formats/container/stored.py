"""`StoredArray`: one array of an open container, read region by region.

A cache of decoded chunks, reads ahead along the first axis, and places of inner chunks in shards.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from itertools import islice, product
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.container.array import (
    ENTRY_BYTES,
    ArrayMetadata,
    Index,
    Sharding,
    parse_entry,
    parse_index,
)
from fhash_formats.container.zip_file import (
    Member,
    Range,
    Source,
    check_member,
    damage_named,
    read_member,
)
from fhash_formats.errors import DamagedFileError, FhashError, InputError, RegionError
from fhash_formats.support.threads import (
    ForkLock,
    common_part,
    in_threads,
    region_bounds,
    usable_threads,
)

Key = tuple[str, tuple[int, ...], int]
"""Name of the array, index of the chunk and level of detail."""


class ChunkCache:
    """The most recently used chunks, up to `limit` bytes together; safe for several threads.

    The least recently used chunks are dropped first. A chunk larger than `limit` is not kept.

    Attributes:
        limit: most bytes.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self._bytes = 0
        self._chunks: OrderedDict[Key, npt.NDArray[Any]] = OrderedDict()
        self._lock = ForkLock()

    def get(self, key: Key) -> npt.NDArray[Any] | None:
        """The chunk, or None if it is not kept."""
        with self._lock:
            chunk = self._chunks.get(key)
            if chunk is not None:
                self._chunks.move_to_end(key)
            return chunk

    def put(self, key: Key, chunk: np.ndarray[Any, Any]) -> None:
        """Keep a chunk, and drop others until the limit holds."""
        if chunk.nbytes > self.limit:
            return
        with self._lock:
            if key in self._chunks:
                return
            self._chunks[key] = chunk
            self._bytes += chunk.nbytes
            while self._bytes > self.limit:
                _, dropped = self._chunks.popitem(last=False)
                self._bytes -= dropped.nbytes

    def clear(self) -> None:
        """Drop all chunks."""
        with self._lock:
            self._chunks.clear()
            self._bytes = 0


class Ahead:
    """The reads of an array so far, as far as they tell the next one. Safe for several threads."""

    def __init__(self) -> None:
        self._lock = ForkLock()
        self._last: Sequence[range] | None = None
        self._moves = 0

    def layers(self, spans: Sequence[range]) -> int:
        """Number of layers of chunks after those of a read that are worth decoding with them.

        That is the number of times that reads in a row went on along the first axis, without a gap
        and with the same chunks of the other axes; 0 for a read that does not go on.

        spans: chunks of the read along each axis.
        """
        with self._lock:
            last, self._last = self._last, spans
            if last is None or spans[1:] != last[1:]:
                self._moves = 0
            elif spans[0].start <= last[0].stop < spans[0].stop:
                self._moves += 1
                return self._moves
            elif spans[0] != last[0]:
                self._moves = 0
            return 0


def chunks_after(
    spans: Sequence[range],
    grid: Sequence[int],
    layers: int,
    missing: int,
    room: int,
    cached: Callable[[Index], bool],
) -> list[Index]:
    """Chunks to decode beside those of a read, one for each thread that it leaves without work.

    Args:
        spans: chunks of the read along each axis.
        grid: chunks of the array along each axis.
        layers: how many layers after the read they may lie in.
        missing: chunks of the read that are not in the cache. Nothing is decoded beside none.
        room: chunks that the cache holds. Those of the read and these take half of it at most.
        cached: whether a chunk is in the cache.
    """
    if not missing:
        return []
    first = spans[0].stop
    after = product(range(first, min(first + layers, grid[0])), *spans[1:])
    idle = min(usable_threads(), room // 2) - missing
    return list(islice((index for index in after if not cached(index)), max(0, idle)))


SPARSE_SHARE = 4
"""Index entries are read one by one for fewer than one in SPARSE_SHARE inner chunks of a shard."""


class ShardIndices:
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
        parts = list(self._sharding.by_shard(spans))
        if self._source.gap:
            self._source.prefetch(self._unread(parts))
        for shard, in_shard in parts:
            if self._wholly(in_shard):
                self._index(shard)
            else:
                for index in product(*in_shard):
                    self._entry(*self._sharding.locate(index))

    def locate(self, index: Index) -> tuple[Index, int, int, int]:
        """The shard of an inner chunk, its number there, and its offset in the member and bytes.

        Raises DamagedFileError that names the member.
        """
        shard, number = self._sharding.locate(index)
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
                continue  # damage, which `_index_span` tells
            if self._wholly(in_shard):
                yield start, self._sharding.index_bytes
            else:
                for index in product(*in_shard):
                    number = self._sharding.locate(index)[1]
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
                with self._index_span(shard) as (start, data_bytes):
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
            with self._index_span(shard) as (start, data_bytes):
                self._indices[shard] = parse_index(
                    self._source.read(start, self._sharding.index_bytes),
                    self._sharding.present(shard, self._shape),
                    data_bytes,
                )

    @contextmanager
    def _index_span(self, shard: Index) -> Iterator[tuple[int, int]]:
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


MASK = ":mask"
"""Suffix of an array's name for its masks in the cache."""
TABLE = ":table"
"""Suffix of an array's name for its chunks before their corrections in the cache."""
UNCORRECTED = ":uncorrected"
"""Suffix of an array's name for its chunks of which only a part was corrected so far."""

MOST_APART = 3
"""Parts of a chunk that are decoded from some of its blocks, each at most half of the work, before
all of it is decoded."""

Part = tuple[slice, ...]


class StoredArray:
    """An array (Zarr v3) in a container. Reading is safe for several threads.

    Attributes:
        name: path in the hierarchy, for example "tables/level_1".
        shape: length of each axis, at least 1.
        dtype: number type, native byte order.
        chunk_shape: shape of a chunk, the least that is decoded.
        grid: number of chunks along each axis.
        shard_shape: shape of a shard of many chunks; None where each chunk is a member of its own.
        dimension_names: names of the axes, as stored.
        attributes: as stored.
        masked: whether each chunk says which of its values are occupied, for `read_mask`.
        chunks: members of the file, in its order, by index of the chunk or, where there are
            shards, of the shard.
        nbytes_stored: bytes of the members' data in the file.
        document_bytes: bytes of its metadata in the file.
    """

    def __init__(
        self,
        path: object,
        name: str,
        metadata: ArrayMetadata,
        chunks: Mapping[Index, Member],
        source: Source,
        cache: ChunkCache,
        document_bytes: int,
    ) -> None:
        self._path, self._source, self._cache = path, source, cache
        self.document_bytes = document_bytes
        self._metadata = metadata
        self.name = name
        self.chunks = chunks
        self.shape = metadata.shape
        self.dtype = metadata.dtype
        self.chunk_shape = metadata.inner_shape
        self.grid = metadata.inner_grid
        self.shard_shape = None if metadata.sharding is None else metadata.chunk_shape
        self._tiles = metadata.tiles
        self.masked = self._tiles is not None and self._tiles.masked
        self.dimension_names = metadata.dimension_names
        self.attributes = metadata.attributes
        self.nbytes_stored = sum(member.size for member in chunks.values())
        sharding = metadata.sharding
        self._shards = (
            None if sharding is None else ShardIndices(sharding, self.shape, chunks, source)
        )
        self._ahead = Ahead()
        self._apart: dict[Index, int] = {}  # by chunk, how many parts of it were decoded

    def read(self, region: tuple[slice, ...] | None = None) -> npt.NDArray[Any]:
        """The values in `region`, in a new array.

        Only the chunks that intersect the region are read; chunks of shards are decoded in several
        threads. The container's cache keeps them, unless the whole array is read.

        Where few chunks of a shard are needed, only their entries of its index are read. The
        CRC-32C of the index then stays unread; but each chunk has one of its own, and `verify`
        reads all.

        Args:
            region: one slice without step per axis; None for the whole array.

        Raises:
            RegionError: for a region outside the array.
            DamagedFileError: for a damaged chunk.
        """
        return self._gathered(region, self._region, self.dtype)

    def read_mask(self, region: tuple[slice, ...] | None = None) -> npt.NDArray[np.bool_]:
        """A mask of the occupied values in `region`, which is that of `read`.

        Mask and values come from the same chunks, which are decoded once for both. The mask is
        True everywhere, without reading the file, where the array is not `masked`. Raises what
        `read` raises.
        """
        if not self.masked:
            return np.ones([stop - start for start, stop in self._bounds(region)], dtype=bool)
        return self._gathered(region, self._mask_region, np.dtype(bool))

    def _gathered(
        self,
        region: tuple[slice, ...] | None,
        read: Callable[..., npt.NDArray[Any]],
        dtype: np.dtype[Any],
    ) -> npt.NDArray[Any]:
        """A region, gathered from the parts that `read` returns of each of its chunks."""
        bounds = self._bounds(region)
        with damage_named(self._path, self._source):
            lengths = [stop - start for start, stop in bounds]
            if 0 in lengths:
                return np.empty(lengths, dtype=dtype)

            def fill(index: Index) -> None:
                in_region, in_chunk = common_part(index, self.chunk_shape, bounds)
                values[in_region] = read(index, in_chunk, keep=region is not None)

            spans = [
                range(start // chunk, -(-stop // chunk))
                for (start, stop), chunk in zip(bounds, self.chunk_shape, strict=True)
            ]
            # `_for_chunks` reads the indices of shards at once, so that hostile shards are refused
            # before the result is allocated. The chunks are decoded as its iterator is consumed.
            filling = self._for_chunks(fill, spans, ahead=region is not None)
            values = np.empty(lengths, dtype=dtype)
            for _ in filling:
                pass
        return values

    def decode_chunk(self, index: tuple[int, ...], lod: int = 0) -> npt.NDArray[Any]:
        """A full chunk, padding included, from the container's cache or else from the file.

        The array is read-only.

        Args:
            index: of the chunk in `grid`.
            lod: level of detail. 0 is the full chunk; the coder of the array defines others.

        Raises:
            RegionError: for an index outside `grid`.
            InputError: for a level of detail that the coder does not have.
            DamagedFileError: for a damaged chunk; the message names the member of the file.
        """
        self._check_index(index)
        if lod < 0:
            raise InputError(f"level of detail {lod}; 0 is all of it, and others are coarser")
        with damage_named(self._path, self._source):
            return self._chunk(tuple(index), lod, keep=True)

    def decode_table(self, index: tuple[int, ...], lod: int = 0) -> npt.NDArray[Any]:
        """A full chunk before the corrections that its coder makes; else as `decode_chunk`."""
        self._check_index(index)
        place = (self.name + TABLE, tuple(index), lod)
        with damage_named(self._path, self._source):
            values = self._cache.get(place)
            if values is None:
                values = self._decode(tuple(index), lod, table=True)[0]
                values.flags.writeable = False
                self._cache.put(place, values)
        return values

    @property
    def settings(self) -> Any:
        """Settings that all chunks share, of arrays coded by `fhash.transform`; else None."""
        return None if self._tiles is None else self._tiles.settings

    @property
    def axes(self) -> Any:
        """Axes of tiles along which the array is coded; None for the usual ones."""
        return None if self._tiles is None else self._tiles.axes

    @property
    def coding(self) -> str:
        """Name of the first codec, that of inner chunks where there are shards."""
        return self._metadata.coding

    def _check_index(self, index: tuple[int, ...]) -> None:
        if len(index) != len(self.grid) or not all(
            0 <= i < n for i, n in zip(index, self.grid, strict=True)
        ):
            raise RegionError(
                f"{self._path}: {self.name}: chunk {index} is outside the grid {self.grid}"
            )

    def verify(self, done: Callable[[], None]) -> None:
        """Read and decode the whole array straight from the file; call `done` after each chunk.

        Raises DamagedFileError that names the member.
        """
        if self._metadata.sharding is not None:
            for member in self.chunks.values():
                check_member(self._source, member)
        for _ in self._for_chunks(self._decode_and_drop, [range(n) for n in self.grid]):
            done()

    def _decode_and_drop(self, index: Index) -> None:
        self._decode(index)

    def _for_chunks(
        self, work: Callable[[Index], None], spans: Sequence[range], ahead: bool = False
    ) -> Iterator[None]:
        """Do `work` for each chunk whose index lies in `spans`, as the result is iterated.

        The indices of shards are read before this returns. Where there are shards and several
        chunks to decode, the work is done in threads.

        ahead: whether threads without work may decode the chunks that a reader who goes along the
            first axis will want next.
        """

        def cached(index: Index) -> bool:
            return self._cache.get((self.name, index, 0)) is not None

        if self._shards is None:
            self._announce(product(*spans))
            return map(work, product(*spans))
        # The indices are read once for all chunks of a shard, before threads that all need them.
        self._read_indices(spans)
        indices = list(product(*spans))
        missing = sum(not cached(index) for index in indices)
        after: list[Index] = []
        if ahead and (layers := self._ahead.layers(spans)):
            room = self._cache.limit // self._metadata.chunk_bytes
            after = chunks_after(spans, self.grid, layers, missing, room, cached)
        self._announce([*indices, *after])
        if missing + len(after) < 2:
            return map(work, indices)

        def decode(index: Index) -> None:
            # What fails now fails again once it is wanted.
            with suppress(FhashError, MemoryError):
                self._decoded(index, 0, keep=True)

        wanted = [partial(work, index) for index in indices]
        return in_threads(lambda do: do(), wanted + [partial(decode, index) for index in after])

    def prefetch(self, spans: Sequence[range], lod: int = 0) -> None:
        """Let a source elsewhere fetch chunks that `decode_chunk` or `decode_table` is asked for.

        spans: of chunks along each axis. Raises DamagedFileError for a damaged index.
        """
        if self._source.gap:
            with damage_named(self._path, self._source):
                self._read_indices(spans)
                self._announce(product(*spans), (self.name, self.name + TABLE), lod)

    def _read_indices(self, spans: Sequence[range]) -> None:
        """Read where chunks lie in their shards."""
        if self._shards is not None:
            self._shards.read(spans)

    def _announce(self, indices: Iterable[Index], names: Sequence[str] = (), lod: int = 0) -> None:
        """Let a source elsewhere fetch chunks that are not in the cache.

        names: of the cache, under which they may be there.
        """
        if self._source.gap:
            names = names or (self.name, self.name + UNCORRECTED)
            self._source.prefetch(
                self._span(index)
                for index in indices
                if all(self._cache.get((name, index, lod)) is None for name in names)
            )

    def _span(self, index: Index) -> tuple[int, int]:
        """Offset in the file and bytes of what `_stored_chunk` reads of an inner chunk."""
        if self._shards is None:
            member = self.chunks[index]
            return member.offset, member.header_size + member.size
        shard, _, offset, size = self._shards.locate(index)
        return self.chunks[shard].data_offset + offset, size

    def _chunk(self, index: Index, lod: int = 0, *, keep: bool) -> npt.NDArray[Any]:
        """The values of a chunk, from the cache or decoded; `keep` puts them into the cache."""
        cached = self._cache.get((self.name, index, lod))
        return self._decoded(index, lod, keep)[0] if cached is None else cached

    def _region(self, index: Index, part: Part, *, keep: bool) -> npt.NDArray[Any]:
        """A part of a chunk; of one that was not read before, where it can, without the rest."""
        tiles, places = self._tiles, ((self.name, index, 0), (self.name + UNCORRECTED, index, 0))
        known = any(self._cache.get(place) is not None for place in places)
        if known or not keep or tiles is None or not tiles.boxed:
            return self._chunk(index, keep=keep)[part]
        with self._stored_chunk(index) as data:
            apart = self._apart.get(index, 0)
            some = tiles.region(data, part) if apart < MOST_APART else None
            if some is not None:
                self._apart[index] = apart + 1
                return some
            table = tiles.uncorrected(data, part) if tiles.parted else None
            values = tiles.decode(data) if table is None else tiles.corrected(table, part)
        kept = values if table is None else table
        kept.flags.writeable = False
        self._cache.put(places[table is not None], kept)
        return values[part] if table is None else values

    def _mask_region(self, index: Index, part: Part, *, keep: bool) -> npt.NDArray[Any]:
        """A part of the mask of a chunk."""
        return self._mask(index, keep=keep)[part]

    def _mask(self, index: Index, *, keep: bool) -> npt.NDArray[Any]:
        """The mask of a chunk's occupied values, from the cache or decoded."""
        cached = self._cache.get((self.name + MASK, index, 0))
        mask = self._decoded(index, 0, keep)[1] if cached is None else cached
        assert mask is not None
        return mask

    def _decoded(
        self, index: Index, lod: int, keep: bool
    ) -> tuple[npt.NDArray[Any], npt.NDArray[Any] | None]:
        """A full chunk and its mask, decoded and read-only; `keep` puts both into the cache."""
        table = self._cache.get((self.name + UNCORRECTED, index, lod))
        if table is None or self._tiles is None:
            values, mask = self._decode(index, lod)
        else:
            whole = tuple(slice(0, n) for n in table.shape)
            values, mask = self._tiles.corrected(table, whole), None
        for name, array in ((self.name, values), (self.name + MASK, mask)):
            if array is not None:
                array.flags.writeable = False
                if keep:
                    self._cache.put((name, index, lod), array)
        return values, mask

    def _decode(
        self, index: Index, lod: int = 0, *, table: bool = False
    ) -> tuple[npt.NDArray[Any], npt.NDArray[Any] | None]:
        """A full chunk straight from the file, and its mask where chunks have one.

        table: the chunk before its corrections, without its mask.
        """
        with self._stored_chunk(index) as data:
            tiles = self._tiles
            if tiles is not None and table:
                return tiles.decode_table(data, lod), None
            if tiles is not None and tiles.masked and not lod:
                return tiles.decode_masked(data)
            return self._metadata.coder.decode(data, lod), None

    def coded(self, index: Index) -> memoryview:
        """The bytes of a chunk, checked. Raises DamagedFileError that names the member."""
        with self._stored_chunk(index) as data:
            self._metadata.coder.check(data)
            return data

    def coded_bytes(self, index: Index) -> int:
        """The number of bytes that `coded` returns, without reading them."""
        return self.chunks[index].size if self._shards is None else self._span(index)[1]

    @contextmanager
    def _stored_chunk(self, index: Index) -> Iterator[memoryview]:
        """The bytes of an inner chunk, for a block whose errors name where it lies."""
        shards = self._shards
        if shards is None:
            member, place = self.chunks[index], ""
            data = read_member(self._source, member)
        else:
            shard, number, offset, size = shards.locate(index)
            member, place = self.chunks[shard], f"inner chunk {number}: "
            data = memoryview(self._source.read(member.data_offset + offset, size))
        try:
            yield data
        except DamagedFileError as error:
            raise type(error)(f"member {member.name}: {place}{error}") from error

    def _bounds(self, region: tuple[slice, ...] | None) -> list[tuple[int, int]]:
        """(start, stop) of a region along each axis; raises RegionError."""
        if region is None:
            return [(0, n) for n in self.shape]
        return region_bounds(region, self.shape, f"{self._path}: {self.name}")

    def __repr__(self) -> str:
        return f"<StoredArray {self.name} {self.shape} {self.dtype}>"
