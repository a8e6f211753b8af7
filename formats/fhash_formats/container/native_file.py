"""`NativeFile`: a container that libfhash reads (native/arrays.hpp), from the bytes of a source."""

from __future__ import annotations

import os
import threading
import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats import native
from fhash_formats.container.zip_file import Source
from fhash_formats.errors import InputError
from fhash_formats.native import ffi, pointer
from fhash_formats.support.threads import ForkLock, usable_threads
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
