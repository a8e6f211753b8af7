"""One array of an open container, read region by region."""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import product
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.container.array import ArrayMetadata
from fhash_formats.container.cache import ChunkCache
from fhash_formats.container.layout import Member
from fhash_formats.container.sharding import ENTRY_BYTES, Sharding, parse_entry, parse_index
from fhash_formats.container.source import Source
from fhash_formats.container.zip_checked import check_member, read_member
from fhash_formats.errors import DamagedFileError, RegionError
from fhash_formats.support.threads import in_threads

FEW = 4
"""Entries are read alone where fewer than one in so many of a shard's index is wanted."""
MASK = ":mask"
"""Behind the name of an array, for its masks in the cache."""


@contextmanager
def damage_named(path: object) -> Iterator[None]:
    """Put the path before what is wrong with a file, and turn what a hostile or unreadable file provokes into DamagedFileError.

    MemoryError passes: the coders refuse sizes that the bytes of a chunk cannot hold, so what is left is a machine with less memory than a
    sound file takes, and whoever is told that a file is damaged may well delete it.
    """
    try:
        yield
    except DamagedFileError as error:
        raise type(error)(f"{path}: {error}") from error
    except (RecursionError, OverflowError, UnicodeError, struct.error) as error:
        raise DamagedFileError(f"{path}: the file is damaged: {type(error).__name__}") from error
    except OSError as error:
        if error.errno is None:
            raise
        raise DamagedFileError(f"{path}: the file cannot be read: {error.strerror}") from error


class StoredArray:
    """An array (Zarr v3) in a container. Reading is safe for several threads.

    Attributes:
        name: path in the hierarchy, "tables/level_1".
        shape: lengths per axis, at least 1; dtype: native byte order.
        chunk_shape: of a chunk, the least that is decoded; grid: chunks along each axis.
        shard_shape: of a shard of many chunks; None where each chunk is a member of its own.
        dimension_names, attributes: as stored.
        masked: whether each chunk says which of its values are occupied; then `read_mask` reads it.
        chunks: member of the file by index of the chunk, or of the shard where there are shards, in the order of the file.
        nbytes_stored: bytes of its members in the file.
    """

    def __init__(
        self,
        path: object,
        name: str,
        metadata: ArrayMetadata,
        chunks: Mapping[tuple[int, ...], Member],
        source: Source,
        cache: ChunkCache,
    ) -> None:
        self._path, self._source, self._cache = path, source, cache
        self._metadata = metadata
        self.name = name
        self.chunks = chunks
        self.shape = metadata.shape
        self.dtype = metadata.dtype
        self.chunk_shape = metadata.inner_shape
        self.grid = metadata.inner_grid
        self.shard_shape = None if metadata.sharding is None else metadata.chunk_shape
        self.masked = metadata.coder.masked
        self.dimension_names = metadata.dimension_names
        self.attributes = metadata.attributes
        self.nbytes_stored = sum(member.size for member in chunks.values())
        self._indices: dict[tuple[int, ...], npt.NDArray[np.int64]] = {}
        self._entries: dict[tuple[tuple[int, ...], int], tuple[int, int]] = {}
        self._lock = threading.Lock()

    def read(self, region: tuple[slice, ...] | None = None) -> npt.NDArray[Any]:
        """The values in `region`, one slice per axis without step, everything if None; a fresh array.

        Touches only the chunks that intersect the region, those of shards in several threads. They are kept in the container's cache,
        except when everything is read. Of a shard of which few chunks are wanted just their entries of the index are read: the index's own
        CRC-32C stays unread then, but each chunk has one of its own, and `verify` reads all.
        Raises RegionError for a region outside the array, DamagedFileError for a damaged chunk.
        """
        return self._gathered(region, self._chunk, self.dtype)

    def read_mask(self, region: tuple[slice, ...] | None = None) -> npt.NDArray[np.bool_]:
        """Which values in `region` are occupied, as `read` takes it and from the same chunks, which are decoded once for both.

        True everywhere, without a look at the file, where the array is not `masked`. Raises what `read` raises.
        """
        if not self.masked:
            return np.ones(
                [
                    stop - start
                    for start, stop in map(self._bounds, range(len(self.shape)), self._full(region))
                ],
                dtype=bool,
            )
        return self._gathered(region, self._mask, np.dtype(bool))

    def _gathered(
        self,
        region: tuple[slice, ...] | None,
        read: Callable[..., npt.NDArray[Any]],
        dtype: np.dtype[Any],
    ) -> npt.NDArray[Any]:
        """A region of what `read` gives of each chunk."""
        bounds = [self._bounds(axis, part) for axis, part in enumerate(self._full(region))]
        with damage_named(self._path):
            lengths = [stop - start for start, stop in bounds]
            if 0 in lengths:
                return np.empty(lengths, dtype=dtype)

            def fill(index: tuple[int, ...]) -> None:
                chunk = read(index, keep=region is not None)
                target, origin = [], []
                for i, (start, stop), size in zip(index, bounds, self.chunk_shape, strict=True):
                    low, high = max(start, i * size), min(stop, (i + 1) * size)
                    target.append(slice(low - start, high - start))
                    origin.append(slice(low - i * size, high - i * size))
                values[tuple(target)] = chunk[tuple(origin)]

            spans = [
                range(start // chunk, -(-stop // chunk))
                for (start, stop), chunk in zip(bounds, self.chunk_shape, strict=True)
            ]
            # What finds hostile shards comes before the array that they ask for; the work itself is done as it is asked for.
            work = self._each(fill, spans)
            values = np.empty(lengths, dtype=dtype)
            for _ in work:
                pass
        return values

    def decode_chunk(self, index: tuple[int, ...], lod: int = 0) -> npt.NDArray[Any]:
        """A full chunk, padding included, from the container's cache or else from the file; read-only.

        lod: level of detail, 0 for everything; what others give is for the coder of the array to say.
        Raises RegionError for an index outside `grid`, InputError for a level of detail that there is none of, DamagedFileError naming
        the member of the file.
        """
        if len(index) != len(self.grid) or not all(
            0 <= i < n for i, n in zip(index, self.grid, strict=True)
        ):
            raise RegionError(
                f"{self._path}: {self.name}: chunk {index} is outside the grid {self.grid}"
            )
        with damage_named(self._path):
            return self._chunk(tuple(index), lod, keep=True)

    def verify(self, done: Callable[[], None]) -> None:
        """Read and decode all of it straight from the file; `done()` after each chunk. Raises DamagedFileError naming the member."""
        if self._metadata.sharding is not None:
            for member in self.chunks.values():
                check_member(self._source, member)
        for _ in self._each(self._decode_and_drop, [range(n) for n in self.grid]):
            done()

    def _decode_and_drop(self, index: tuple[int, ...]) -> None:
        self._decode(index)

    def _each(
        self, work: Callable[[tuple[int, ...]], None], spans: Sequence[range]
    ) -> Iterator[None]:
        """Do the work for each chunk of `spans`, as the result is iterated; in threads if there are shards and several to decode."""
        sharding = self._metadata.sharding
        if sharding is None:
            return map(work, product(*spans))
        # Once for all chunks of a shard, before the threads that all need it.
        shards = (
            range(span.start // count, (span.stop - 1) // count + 1)
            for span, count in zip(spans, sharding.counts, strict=True)
        )
        for shard in product(*shards):
            ends = (
                (max(span.start, s * n), min(span.stop, (s + 1) * n))
                for span, s, n in zip(spans, shard, sharding.counts, strict=True)
            )
            inside = [range(*end) for end in ends]
            if FEW * prod(map(len, inside)) >= prod(sharding.counts):
                self._shard_index(sharding, shard)
            else:
                for index in product(*inside):
                    self._entry(sharding, *sharding.place(index))
        chosen = list(product(*spans))
        missing = sum(self._cache.get((self.name, index, 0)) is None for index in chosen)
        return in_threads(work, chosen) if missing > 1 else map(work, chosen)

    def _chunk(self, index: tuple[int, ...], lod: int = 0, *, keep: bool) -> npt.NDArray[Any]:
        found = self._cache.get((self.name, index, lod))
        return self._decoded(index, lod, keep)[0] if found is None else found

    def _mask(self, index: tuple[int, ...], *, keep: bool) -> npt.NDArray[Any]:
        """Which values of a chunk are occupied."""
        found = self._cache.get((self.name + MASK, index, 0))
        mask = self._decoded(index, 0, keep)[1] if found is None else found
        assert mask is not None
        return mask

    def _decoded(
        self, index: tuple[int, ...], lod: int, keep: bool
    ) -> tuple[npt.NDArray[Any], npt.NDArray[Any] | None]:
        """A full chunk and its mask, of which the cache then has both."""
        values, mask = self._decode(index, lod)
        for name, part in ((self.name, values), (self.name + MASK, mask)):
            if part is not None:
                part.flags.writeable = False
                if keep:
                    self._cache.put((name, index, lod), part)
        return values, mask

    def _decode(
        self, index: tuple[int, ...], lod: int = 0
    ) -> tuple[npt.NDArray[Any], npt.NDArray[Any] | None]:
        """A full chunk, straight from the file, and where chunks have one its mask."""
        sharding = self._metadata.sharding
        if sharding is None:
            member, part = self.chunks[index], ""
            data = read_member(self._source, member)
        else:
            shard, number = sharding.place(index)
            member, part = self.chunks[shard], f"inner chunk {number}: "
            offset, size = self._entry(sharding, shard, number)
            data = memoryview(self._source.read(member.data_offset + offset, size))
        try:
            coder = self._metadata.coder
            return (
                coder.decode_masked(data)
                if self.masked and not lod
                else (coder.decode(data, lod), None)
            )
        except DamagedFileError as error:
            raise type(error)(f"member {member.name}: {part}{error}") from error

    def _entry(self, sharding: Sharding, shard: tuple[int, ...], number: int) -> tuple[int, int]:
        """(offset in the member, bytes) of one inner chunk of a shard; read once, alone unless the whole index is known."""
        with self._lock:
            found = self._indices.get(shard)
            if found is not None:
                return int(found[number, 0]), int(found[number, 1])
            known = self._entries.get((shard, number))
            if known is None:
                with self._index_of(sharding, shard) as (start, data_bytes):
                    known = parse_entry(
                        self._source.read(start + number * ENTRY_BYTES, ENTRY_BYTES), data_bytes
                    )
                self._entries[shard, number] = known
        return known

    def _shard_index(self, sharding: Sharding, shard: tuple[int, ...]) -> npt.NDArray[np.int64]:
        """(offset in the member, bytes) of each inner chunk of a shard; read once."""
        with self._lock:
            found = self._indices.get(shard)
            if found is None:
                with self._index_of(sharding, shard) as (start, data_bytes):
                    found = parse_index(
                        self._source.read(start, sharding.index_bytes),
                        sharding.present(shard, self.shape),
                        data_bytes,
                    )
                self._indices[shard] = found
        return found

    @contextmanager
    def _index_of(self, sharding: Sharding, shard: tuple[int, ...]) -> Iterator[tuple[int, int]]:
        """Where the index of a shard begins in the file, and the bytes before it in the shard; names the member in what goes wrong."""
        member = self.chunks[shard]
        data_bytes = member.size - sharding.index_bytes
        try:
            if data_bytes < 0:
                raise DamagedFileError(
                    f"{member.size} bytes are too few for the index of a shard, {sharding.index_bytes}"
                )
            yield member.data_offset + data_bytes, data_bytes
        except DamagedFileError as error:
            raise type(error)(f"member {member.name}: {error}") from error

    def _full(self, region: tuple[slice, ...] | None) -> tuple[slice, ...]:
        if region is None:
            return tuple(slice(0, n) for n in self.shape)
        if len(region) != len(self.shape):
            raise RegionError(
                f"{self._path}: {self.name}: a region of {len(region)} axes; the array has {len(self.shape)}"
            )
        return region

    def _bounds(self, axis: int, part: slice) -> tuple[int, int]:
        length = self.shape[axis]
        start = 0 if part.start is None else int(part.start)
        stop = length if part.stop is None else int(part.stop)
        if part.step not in (None, 1) or not 0 <= start <= stop <= length:
            raise RegionError(
                f"{self._path}: {self.name}: {part} on axis {axis}; slices without step within 0..{length} are allowed"
            )
        return start, stop

    def __repr__(self) -> str:
        return f"<StoredArray {self.name} {self.shape} {self.dtype}>"
