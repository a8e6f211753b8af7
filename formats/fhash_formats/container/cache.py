"""A cache of decoded chunks, bounded in bytes."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.support.fork_lock import ForkLock

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
