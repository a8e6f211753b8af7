"""`NativeFile`: a container that libfhash reads; `StoredArray`: one of its arrays, by regions.

The library (native/functions.h) asks a source for bytes, and keeps what it decoded.
"""

from __future__ import annotations

import os
import threading
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats import native
from fhash_formats.container.array import ArrayMetadata, Index
from fhash_formats.container.zip_file import Source, damage_named
from fhash_formats.errors import DamagedFileError, InputError, RegionError
from fhash_formats.native import ffi, pointer
from fhash_formats.support.threads import (
    ForkLock,
    common_part,
    in_threads,
    region_bounds,
    usable_threads,
)
from fhash_formats.transform.tile import checked, context


@dataclass(frozen=True, kw_only=True)
class Node:
    """A group or an array of the hierarchy.

    Attributes:
        path: in the hierarchy; "" for the root.
        text: its zarr.json.
        document_bytes: bytes of the zarr.json in the file.
        stored_bytes: bytes of the data of its chunks.
        place_bytes: bytes of all of these, with their places in the ZIP.
        number: of the array; 0 for a group.
    """

    path: str
    text: bytes
    document_bytes: int
    stored_bytes: int
    place_bytes: int
    number: int


def _node(found: Any) -> Node:
    return Node(
        path=_text(found.path),
        text=bytes(ffi.buffer(found.text, found.text_size)),
        document_bytes=found.document,
        stored_bytes=found.stored,
        place_bytes=found.place,
        number=found.array,
    )


def _text(found: Any) -> str:
    return str(ffi.string(found).decode("ascii"))


class _Kept:
    """A decoded chunk of libfhash, for as long as an array shows its values."""

    def __init__(
        self, address: int, shape: Sequence[int], dtype: np.dtype[Any], owner: object
    ) -> None:
        self.owner = owner
        self.__array_interface__ = {
            "data": (address, True),
            "shape": tuple(shape),
            "typestr": dtype.str,
            "version": 3,
        }


def _functions(source: Source, failures: threading.local) -> tuple[Any, Any]:
    """Functions by which the library reads a source, and tells it what it will read.

    They know no `NativeFile`, which else would live until garbage is collected. What the source
    raises becomes `failures.error`.
    """

    def read(_: object, offset: int, size: int, room: Any) -> int:
        try:
            ffi.memmove(room, source.read(offset, size), size)
        except BaseException as error:
            failures.error = error
            return 1
        return 0

    def announce(_: object, ranges: Any, count: int) -> None:
        try:
            source.prefetch([(ranges[2 * i], ranges[2 * i + 1]) for i in range(count)])
        except BaseException as error:
            failures.error = error

    told = ffi.callback("fhash_announce_function", announce) if source.gap else ffi.NULL
    return ffi.callback("fhash_read_function", read, error=1), told


def _release(handles: dict[int, Any], process: int) -> None:
    """Close the handles of a file, in the process that opened it."""
    if process == os.getpid():
        for handle in handles.values():
            native.library().fhash_close(handle)
    handles.clear()


class NativeFile:
    """A container that is open in libfhash; safe for several threads.

    Errors of the source pass through the library: a call raises what the source raised.
    """

    def __init__(self, source: Source, cache_bytes: int) -> None:
        """Open a container; it reads from the source, and closes nothing.

        cache_bytes: most bytes of decoded chunks that are kept.

        Raises DamagedFileError or UnsupportedFileError.
        """
        self._source, self._cache_bytes = source, cache_bytes
        self._lock = ForkLock()
        self._failures = threading.local()
        self._closed, self._users = False, 0
        self._functions = _functions(source, self._failures)
        self._handles: dict[int, Any] = {}
        self._open()
        weakref.finalize(self, _release, self._handles, os.getpid()).atexit = False

    def _open(self) -> None:
        """Open the file in this process: a lock of the library may be held for ever in a fork."""
        threads, made = usable_threads(), ffi.new("fhash_file **")
        given = (context(threads), *self._functions, ffi.NULL, self._source.size, made)
        self._call("fhash_file_open", *given)
        native.library().fhash_file_cache(made[0], self._cache_bytes)
        self._handles.clear()
        self._handles[threads] = made[0]
        self._process, self._users = os.getpid(), 0

    @contextmanager
    def _using(self) -> Iterator[Any]:
        """The handle that reads with as many threads as may be used, for a block."""
        threads = usable_threads()
        with self._lock:
            if self._closed:
                raise InputError("the container is closed")
            if self._process != os.getpid():
                self._open()
            if threads not in self._handles:
                made, first = ffi.new("fhash_file **"), next(iter(self._handles.values()))
                self._call("fhash_file_with", context(threads), first, made)
                self._handles[threads] = made[0]
            handle = self._handles[threads]
            self._users += 1
        try:
            yield handle
        finally:
            with self._lock:
                self._users -= 1
                self._release_if_idle()

    def close(self) -> None:
        """Release what the library holds, once no thread uses it."""
        with self._lock:
            self._closed = True
            self._release_if_idle()

    def _release_if_idle(self) -> None:
        if self._closed and self._users <= 0:
            _release(self._handles, self._process)

    def _asked(self, name: str, *arguments: Any) -> None:
        """Call a function of the file."""
        with self._using() as handle:
            self._call(name, handle, *arguments)

    def nodes(self) -> list[Node]:
        """The groups and arrays, in the order of the file."""
        found = ffi.new("fhash_node *")
        listed: list[Node] = []
        with self._using() as handle:
            while native.library().fhash_file_node(handle, len(listed), found):
                listed.append(_node(found))
        return listed

    def places(self, variable: int) -> dict[str, int]:
        """Numbers of the arrays of a variable by their names. variable: its number, from 0."""
        found: dict[str, int] = {}
        name, array = ffi.new("char const **"), ffi.new("int64_t *")
        with self._using() as handle:
            while native.library().fhash_file_place(handle, variable, len(found), name, array):
                found[_text(name[0])] = array[0]
        return found

    @property
    def digest(self) -> str:
        """SHA-256 of the directory, hexadecimal."""
        text = ffi.new("char[65]")
        with self._using() as handle:
            native.library().fhash_file_digest(handle, text)
        return _text(text)

    def read(
        self,
        number: int,
        bounds: Sequence[tuple[int, int]],
        values: npt.NDArray[Any] | None,
        mask: npt.NDArray[np.bool_] | None,
        *,
        keep: bool = True,
    ) -> None:
        """Read a region of an array, (start, stop) along each axis, none empty.

        Args:
            number: of the array.
            bounds: of the region, within the array.
            values: gets the values, contiguous; None where they are not wanted.
            mask: likewise which of them are occupied.
            keep: whether the cache keeps the chunks.
        """
        ends = [end for along in bounds for end in along]
        self._asked("fhash_array_read", number, ends, keep, pointer(values), pointer(mask))

    def chunk(
        self, number: int, index: Sequence[int], lod: int, dtype: np.dtype[Any], *, keep: bool
    ) -> npt.NDArray[Any]:
        """A full chunk, padding included, read-only. dtype: of the array."""
        found = ffi.new("fhash_chunk *")
        self._asked("fhash_array_chunk", number, list(index), lod, keep, found)
        shape = found.shape[0 : len(index)]
        # The library releases the chunk once no array shows its values.
        owner = ffi.gc(found.owner, native.library().fhash_chunk_free)
        return np.asarray(_Kept(int(ffi.cast("intptr_t", found.values)), shape, dtype, owner))

    def stored(self, number: int, index: Sequence[int]) -> tuple[int, int, str]:
        """Offset and number of the bytes of a chunk, and the member of the file that has them."""
        place, member = ffi.new("uint64_t[2]"), ffi.new("char const **")
        self._asked("fhash_array_stored", number, list(index), place, member)
        return place[0], place[1], _text(member[0])

    def announce(self, number: int, bounds: Sequence[tuple[int, int]]) -> None:
        """Let the source fetch the chunks of a region, with their padding."""
        ends = [end for along in bounds for end in along]
        self._asked("fhash_array_announce", number, ends)

    def check(self, number: int) -> None:
        """Check the members of an array by their checksums."""
        self._asked("fhash_array_check", number)

    def _call(self, name: str, *arguments: Any) -> None:
        """Call a function; raises what the source raised, or else what its status means."""
        self._failures.error = None
        try:
            checked(name, *arguments)
        except Exception:
            if self._failures.error is None:
                raise
        failure, self._failures.error = self._failures.error, None
        if failure is not None:
            raise failure


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
        chunk_shape: shape of a full chunk.
        grid: chunks along each axis.
        together: tiles of a member of the file along each axis; None for other chunks.
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
        self.chunk_shape, self.grid = metadata.chunk_shape, metadata.grid
        self.together = metadata.together
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

        Only the chunks that intersect the region are read, and decoded in several threads. The
        container's cache keeps them, unless the whole array is read.

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
        """Name of the first codec."""
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
        if self._metadata.indexed:
            self._file.check(self.number)
            self._file.stored(self.number, [0] * len(self.shape))  # an index before many futures
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
