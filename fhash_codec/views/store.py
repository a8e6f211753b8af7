"""Store of zarr-python on a Zarr view."""

from __future__ import annotations

import asyncio
import os
import weakref
from collections import OrderedDict
from collections.abc import AsyncIterator, Iterable, Mapping
from pathlib import Path
from typing import Any

from zarr.abc.buffer import Buffer, BufferPrototype
from zarr.abc.store import (
    ByteRequest,
    OffsetByteRequest,
    RangeByteRequest,
    Store,
    SuffixByteRequest,
)
from zarr.buffer import default_buffer_prototype

from fhash_codec.views.view import ZarrView, opened_view
from fhash_formats.errors import InputError
from fhash_formats.support.threads import ForkLock

SHARED_FILES = 8
"""Files that stay open in a process for stores that were pickled."""


def zarr_store(path: str | Path, **options: Any) -> DecodedStore:
    """A read-only Zarr v3 store of the decoded values of a `.fhz` file; nothing is decoded yet.

    `xarray.open_zarr(zarr_store("run.fhz"))` shows the variable over the whole domain with its
    coordinates, `xarray.open_zarr(store, group="lod/2")` every 4th vertex. Values have the bits of
    `volume[...]`. The store can be pickled; `close` releases the file.

    options: those of `fhash_codec.open`.

    Raises MissingInputError, DamagedFileError or UnsupportedFileError.
    """
    return DecodedStore(path, options)


class _File:
    """An open file and its view; it closes at the latest when nothing refers to it.

    Attributes:
        view: of the file.
        close: closes the file.
    """

    def __init__(self, path: str | Path, options: Mapping[str, Any]) -> None:
        opened, self.view = opened_view(path, **options)
        self.close = weakref.finalize(self, opened.close)


_shared: OrderedDict[tuple[str, str], _File] = OrderedDict()
_shared_lock = ForkLock()


def _shared_file(path: str, options: Mapping[str, Any], tag: str) -> _File:
    """The file of stores that were pickled, one for all of a process.

    dask sends a store with every task. Each would open the file and decode tiles of its own. Files
    that were not asked for lately are forgotten. Raises InputError where the file is no longer the
    one of the tag.
    """
    with _shared_lock:
        file = _shared.pop((path, tag), None)
        if file is None:
            file = _File(path, options)
            if file.view.tag != tag:
                file.close()
                raise InputError(f"{path}: the file is another one than when the store was pickled")
        _shared[path, tag] = file
        while len(_shared) > SHARED_FILES:
            _shared.popitem(last=False)
        return file


class DecodedStore(Store):
    """A store of zarr-python that decodes each chunk when it is read.

    Attributes:
        path: of the file.
        options: of `fhash_codec.open`.
        tag: hexadecimal text that differs where any bytes of the store may.
    """

    supports_writes = False
    supports_deletes = False
    supports_listing = True

    def __init__(self, path: str | Path, options: Mapping[str, Any]) -> None:
        """Open the file, which `close` closes."""
        super().__init__(read_only=True)
        self.path = os.fspath(path)
        if "://" not in self.path:
            self.path = os.path.abspath(self.path)
        self.options = dict(options)
        self._file: _File | None = _File(path, options)
        self._is_own = True
        self._closed = False
        self.tag = self._file.view.tag

    @classmethod
    def _restored(cls, path: str, options: Mapping[str, Any], tag: str) -> DecodedStore:
        """A store that was pickled; it opens the file when it is read for the first time."""
        store = cls.__new__(cls)
        Store.__init__(store, read_only=True)
        store.path, store.options, store.tag = path, dict(options), tag
        store._file, store._is_own, store._closed = None, False, False
        return store

    def with_read_only(self, read_only: bool = False) -> DecodedStore:
        """Return this store; raises InputError for one that can be written."""
        if not read_only:
            raise InputError(f"{self.path}: decoded values cannot be written")
        return self

    def close(self) -> None:
        """Release the file; the store cannot be read any more."""
        if self._file is not None and self._is_own:
            self._file.close()
        self._file, self._closed = None, True
        super().close()

    @property
    def view(self) -> ZarrView:
        """The keys and bytes; raises InputError for a closed store, and for another file."""
        if self._closed:
            raise InputError(f"{self.path}: the store is closed; make another by zarr_store")
        if self._file is None:
            self._file = _shared_file(self.path, self.options, self.tag)
        return self._file.view

    # -- reading --

    async def get(
        self,
        key: str,
        prototype: BufferPrototype | None = None,
        byte_range: ByteRequest | None = None,
    ) -> Buffer | None:
        """Return the bytes of a key, or a part of them; None where there is no such key.

        Raises DamagedFileError for a damaged tile, InputError for a closed store.
        """
        view = self.view
        await self._ensure_open()
        # Decoding takes long enough for zarr to ask for other chunks in the meantime.
        is_short = view.is_document(key)
        data = view.get(key) if is_short else await asyncio.to_thread(view.get, key)
        if data is None:
            return None
        return (prototype or default_buffer_prototype()).buffer.from_bytes(_asked(data, byte_range))

    async def get_partial_values(
        self,
        prototype: BufferPrototype,
        key_ranges: Iterable[tuple[str, ByteRequest | None]],
    ) -> list[Buffer | None]:
        """Return parts of keys, in the order asked for."""
        return list(
            await asyncio.gather(*(self.get(key, prototype, part) for key, part in key_ranges))
        )

    async def exists(self, key: str) -> bool:
        """Return whether there is a key; nothing is decoded."""
        return self.view.size(key) is not None

    async def getsize(self, key: str) -> int:
        """Return the bytes of a key, without decoding; raises FileNotFoundError without a key."""
        size = self.view.size(key)
        if size is None:
            raise FileNotFoundError(key)
        return size

    async def list(self) -> AsyncIterator[str]:
        """Yield every key."""
        for key in self.view.listing():
            yield key

    async def list_prefix(self, prefix: str) -> AsyncIterator[str]:
        """Yield every key that begins with a prefix."""
        for key in self.view.listing(prefix):
            yield key

    async def list_dir(self, prefix: str) -> AsyncIterator[str]:
        """Yield the names right below a path."""
        for name in self.view.children(prefix.strip("/")):
            yield name

    # -- writing, which is refused --

    async def set(self, key: str, value: Buffer) -> None:
        """Refuse to write; raises ValueError."""
        self._check_writable()

    async def delete(self, key: str) -> None:
        """Refuse to delete; raises ValueError."""
        self._check_writable()

    # -- identity --

    def __eq__(self, other: object) -> bool:
        """Whether another store gives the same bytes for every key."""
        return isinstance(other, DecodedStore) and (other.path, other.tag) == (self.path, self.tag)

    def __hash__(self) -> int:
        return hash((self.path, self.tag))

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        return DecodedStore._restored, (self.path, self.options, self.tag)

    def __repr__(self) -> str:
        return f"<fhash DecodedStore of {self.path}>"

    def __str__(self) -> str:
        return f"fhash://{self.path}"


def _asked(data: bytes, byte_range: ByteRequest | None) -> bytes:
    """The bytes that zarr asks for."""
    match byte_range:
        case RangeByteRequest(start, end):
            return data[start:end]
        case OffsetByteRequest(offset):
            return data[offset:]
        case SuffixByteRequest(suffix):
            return data[max(0, len(data) - suffix) :]
    return data
