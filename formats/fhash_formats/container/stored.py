"""`StoredArray`: one array of an open container, read region by region by libfhash."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from itertools import product
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.container.array import ArrayMetadata, Index
from fhash_formats.container.native_file import NativeFile, Node
from fhash_formats.container.zip_file import Source, damage_named
from fhash_formats.errors import DamagedFileError, InputError, RegionError
from fhash_formats.support.threads import (
    common_part,
    in_threads,
    region_bounds,
    usable_threads,
)

TOGETHER = 8
"""Chunks for each thread that one call of the library decodes at most: a signal waits for them."""
MUCH_BYTES = 1 << 20
"""Bytes of a region for which room is made only once the place of its first chunk is known."""
KEPT_TABLES = 8
"""Chunks before their corrections that an array keeps."""

Bounds = Sequence[tuple[int, int]]


class StoredArray:
    """An array of an open container, read region by region. Safe for several threads.

    Attributes:
        name: path in the hierarchy.
        number: of the array in the file.
        shape: length of each axis.
        dtype: number type.
        chunk_shape: shape of a full chunk; of an inner chunk where there are shards.
        grid: chunks along each axis.
        shard_shape: shape of a shard; None where there are none.
        dimension_names: names of the axes, or None.
        attributes: JSON values.
        nbytes_stored: bytes of the chunks in the file.
        place_bytes: bytes of chunks and metadata with their places in the ZIP.
        document_bytes: bytes of the metadata document in the file.
    """

    def __init__(
        self,
        path: object,
        file: NativeFile,
        node: Node,
        metadata: ArrayMetadata,
        source: Source,
    ) -> None:
        """Take an array of an open file. path: of the file, for messages."""
        self._path, self._source, self._file = path, source, file
        self._metadata = metadata
        self.name, self.number = node.path, node.number
        self.nbytes_stored, self.place_bytes = node.stored_bytes, node.place_bytes
        self.document_bytes = node.document_bytes
        self.shape = metadata.shape
        self.dtype = metadata.dtype
        self.chunk_shape = metadata.inner_shape
        self.grid = metadata.inner_grid
        self.shard_shape = None if metadata.sharding is None else metadata.chunk_shape
        self.dimension_names = metadata.dimension_names
        self.attributes = metadata.attributes
        self._given: Mapping[Any, npt.NDArray[Any]] = {}
        self._table = lru_cache(KEPT_TABLES)(self._decode_table)

    @cached_property
    def _tiles(self) -> Any:
        """The coder of tiles; None for ordinary chunks."""
        return self._metadata.tiles

    @cached_property
    def masked(self) -> bool:
        """Whether chunks say which of their values are occupied."""
        return self._tiles is not None and bool(self._tiles.masked)

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
        bounds, keep = self._bounds(region), region is not None
        with damage_named(self._path, self._source):
            values = self._room(bounds)
            if self._given and values.size:
                self._gather(values, bounds)
            elif values.size:
                for part, at in self._parts(bounds):
                    self._file.read(self.number, part, values[at], None, keep=keep)
        return values

    def read_mask(self, region: tuple[slice, ...] | None = None) -> npt.NDArray[np.bool_]:
        """A mask of the occupied values in `region`, which is that of `read`.

        Mask and values come from the same chunks, which are decoded once for both. The mask is
        True everywhere, without reading the file, where the array is not `masked`. Raises what
        `read` raises.
        """
        bounds, keep = self._bounds(region), region is not None
        mask = np.ones([stop - start for start, stop in bounds], dtype=bool)
        if self.masked and mask.size:
            with damage_named(self._path, self._source):
                for part, at in self._parts(bounds):
                    self._file.read(self.number, part, None, mask[at], keep=keep)
        return mask

    def _room(self, bounds: Bounds) -> npt.NDArray[Any]:
        """An array for a region. A damaged file must not ask for much memory first."""
        lengths = [stop - start for start, stop in bounds]
        if prod(lengths) * self.dtype.itemsize > MUCH_BYTES:
            first = [start // n for (start, _), n in zip(bounds, self.chunk_shape, strict=True)]
            self._file.stored(self.number, first)
        return np.empty(lengths, dtype=self.dtype)

    def _parts(self, bounds: Bounds) -> Iterator[tuple[Bounds, slice]]:
        """Yield parts of a region along the first axis, and their places in it.

        They end between chunks. Each has about as many as the threads can do in a moment.
        """
        (start, stop), *others = bounds
        length = self.chunk_shape[0]
        across = prod(
            -(-high // n) - low // n
            for (low, high), n in zip(others, self.chunk_shape[1:], strict=True)
        )
        layers = max(1, TOGETHER * usable_threads() // across)
        low = start
        while low < stop:
            high = min(stop, (low // length + layers) * length)
            yield [(low, high), *others], slice(low - start, high - start)
            low = high

    def _gather(self, values: npt.NDArray[Any], bounds: Bounds) -> None:
        """Fill in a region, chunk by chunk, of those that were given and those of the file."""
        spans = zip(bounds, self.chunk_shape, strict=True)
        for index in product(*(range(a // n, -(-b // n)) for (a, b), n in spans)):
            in_region, in_chunk = common_part(index, self.chunk_shape, bounds)
            values[in_region] = self._chunk(index, 0, keep=True)[in_chunk]

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

    def _chunk(self, index: Index, lod: int, *, keep: bool) -> npt.NDArray[Any]:
        if not lod and index in self._given:
            return self._given[index]
        return self._file.chunk(self.number, index, lod, self.dtype, keep=keep)

    def decode_table(self, index: tuple[int, ...], lod: int = 0) -> npt.NDArray[Any]:
        """A full chunk before the corrections that its coder makes; else as `decode_chunk`."""
        self._check_index(index)
        with damage_named(self._path, self._source):
            return self._table(tuple(index), lod)

    def _decode_table(self, index: Index, lod: int) -> npt.NDArray[Any]:
        table: npt.NDArray[Any] = self._tiles.decode_table(self.coded(index), lod)
        table.flags.writeable = False
        return table

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

    def take_decoded(self, chunks: Mapping[Any, npt.NDArray[Any]]) -> None:
        """Take full chunks, as whoever coded them knows that they decode; they become read-only.

        The array is checked by the checksums of its members. Raises DamagedFileError for a member
        that is not what was written.
        """
        with damage_named(self._path, self._source):
            self._file.check(self.number)
        for values in chunks.values():
            values.flags.writeable = False
        self._given = chunks

    def verify(self, done: Callable[[], None]) -> None:
        """Read and decode the whole array straight from the file; call `done` after each chunk.

        Raises DamagedFileError that names the member.
        """
        if self.shard_shape is not None:
            self._file.check(self.number)
            self._file.stored(self.number, [0] * len(self.shape))
        for _ in in_threads(self._decode_and_drop, product(*map(range, self.grid))):
            done()

    def _decode_and_drop(self, index: Index) -> None:
        self._file.chunk(self.number, index, 0, self.dtype, keep=False)

    def prefetch(self, spans: Sequence[range]) -> None:
        """Let a source elsewhere fetch chunks that `decode_chunk` or `decode_table` is asked for.

        spans: of chunks along each axis. Raises DamagedFileError for a damaged index.
        """
        if self._source.gap:
            bounds = [
                (span.start * n, span.stop * n)
                for span, n in zip(spans, self.chunk_shape, strict=True)
            ]
            with damage_named(self._path, self._source):
                self._file.announce(self.number, bounds)

    def coded(self, index: Index) -> memoryview:
        """The bytes of a tile, checked. Raises DamagedFileError that names the member."""
        offset, size, member = self._file.stored(self.number, index)
        data = memoryview(self._source.read(offset, size))
        try:
            self._tiles.check(data)
        except DamagedFileError as error:
            raise type(error)(f"member {member}: {error}") from error
        return data

    def place(self, index: Index) -> tuple[int, int]:
        """Offset in the file and number of the bytes of a chunk."""
        return self._file.stored(self.number, index)[:2]

    def _bounds(self, region: tuple[slice, ...] | None) -> list[tuple[int, int]]:
        """(start, stop) of a region along each axis; raises RegionError."""
        if region is None:
            return [(0, n) for n in self.shape]
        return region_bounds(region, self.shape, f"{self._path}: {self.name}")

    def __repr__(self) -> str:
        return f"<StoredArray {self.name} {self.shape} {self.dtype}>"
