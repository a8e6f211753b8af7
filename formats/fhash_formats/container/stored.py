"""One array of an open container, read region by region."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.container.array import ArrayMetadata
from fhash_formats.container.cache import ChunkCache
from fhash_formats.container.layout import Member
from fhash_formats.container.source import Source
from fhash_formats.container.zip_checked import read_member
from fhash_formats.errors import DamagedFileError, RegionError


@contextmanager
def damage_named(path: object) -> Iterator[None]:
    """Put the path before what is wrong with a file, and turn what a hostile or unreadable file provokes into DamagedFileError."""
    try:
        yield
    except DamagedFileError as error:
        raise type(error)(f"{path}: {error}") from error
    except MemoryError as error:
        raise DamagedFileError(f"{path}: what the file declares does not fit in memory") from error
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
        shape, chunk_shape: lengths per axis, at least 1; dtype: native byte order.
        dimension_names, attributes: as stored.
        chunks: member of the file by chunk index, in the order of the file.
        nbytes_stored: bytes of its chunks in the file.
    """

    def __init__(
        self, path: object, name: str, metadata: ArrayMetadata, chunks: Mapping[tuple[int, ...], Member], source: Source, cache: ChunkCache
    ) -> None:
        self._path, self._source, self._cache = path, source, cache
        self._metadata = metadata
        self.name = name
        self.chunks = chunks
        self.shape = metadata.shape
        self.dtype = metadata.dtype
        self.chunk_shape = metadata.chunk_shape
        self.dimension_names = metadata.dimension_names
        self.attributes = metadata.attributes
        self.nbytes_stored = sum(member.size for member in chunks.values())

    def read(self, region: tuple[slice, ...] | None = None) -> npt.NDArray[Any]:
        """The values in `region`, one slice per axis without step, everything if None; a fresh array.

        Touches only the chunks that intersect the region. They are kept in the container's cache, except when everything is read.
        Raises RegionError for a region outside the array, DamagedFileError for a damaged chunk.
        """
        bounds = [self._bounds(axis, part) for axis, part in enumerate(self._full(region))]
        with damage_named(self._path):
            values = np.empty([stop - start for start, stop in bounds], dtype=self.dtype)
            if values.size == 0:
                return values
            spans = [range(start // chunk, -(-stop // chunk)) for (start, stop), chunk in zip(bounds, self.chunk_shape, strict=True)]
            for index in product(*spans):
                chunk = self._chunk(index, keep=region is not None)
                target, origin = [], []
                for i, (start, stop), size in zip(index, bounds, self.chunk_shape, strict=True):
                    low, high = max(start, i * size), min(stop, (i + 1) * size)
                    target.append(slice(low - start, high - start))
                    origin.append(slice(low - i * size, high - i * size))
                values[tuple(target)] = chunk[tuple(origin)]
        return values

    def decode_chunk(self, index: tuple[int, ...]) -> npt.NDArray[Any]:
        """A full chunk, padding included, straight from the file; raises DamagedFileError naming its member."""
        member = self.chunks[index]
        data = read_member(self._source, member)
        try:
            return self._metadata.coder.decode(data)
        except DamagedFileError as error:
            raise type(error)(f"member {member.name}: {error}") from error

    def _chunk(self, index: tuple[int, ...], *, keep: bool) -> npt.NDArray[Any]:
        key = (self.name, index)
        chunk = self._cache.get(key)
        if chunk is None:
            chunk = self.decode_chunk(index)
            if keep:
                self._cache.put(key, chunk)
        return chunk

    def _full(self, region: tuple[slice, ...] | None) -> tuple[slice, ...]:
        if region is None:
            return tuple(slice(0, n) for n in self.shape)
        if len(region) != len(self.shape):
            raise RegionError(f"{self._path}: {self.name}: a region of {len(region)} axes; the array has {len(self.shape)}")
        return region

    def _bounds(self, axis: int, part: slice) -> tuple[int, int]:
        length = self.shape[axis]
        start = 0 if part.start is None else int(part.start)
        stop = length if part.stop is None else int(part.stop)
        if part.step not in (None, 1) or not 0 <= start <= stop <= length:
            raise RegionError(f"{self._path}: {self.name}: {part} on axis {axis}; slices without step within 0..{length} are allowed")
        return start, stop

    def __repr__(self) -> str:
        return f"<StoredArray {self.name} {self.shape} {self.dtype}>"
