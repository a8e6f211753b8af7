"""The most recently used decoded chunks, up to a number of bytes."""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import Any

import numpy as np
import numpy.typing as npt

Key = tuple[str, tuple[int, ...], int]
"""Name of the array, index of the chunk and level of detail."""


class ChunkCache:
    """Least recently used chunks go first; safe for several threads. A chunk larger than `limit` bytes is not kept."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._bytes = 0
        self._chunks: OrderedDict[Key, npt.NDArray[Any]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: Key) -> npt.NDArray[Any] | None:
        """The chunk, or None."""
        with self._lock:
            chunk = self._chunks.get(key)
            if chunk is not None:
                self._chunks.move_to_end(key)
            return chunk

    def put(self, key: Key, chunk: np.ndarray[Any, Any]) -> None:
        """Keep a chunk; others go until the limit holds."""
        if chunk.nbytes > self._limit:
            return
        with self._lock:
            if key in self._chunks:
                return
            self._chunks[key] = chunk
            self._bytes += chunk.nbytes
            while self._bytes > self._limit:
                _, gone = self._chunks.popitem(last=False)
                self._bytes -= gone.nbytes

    def clear(self) -> None:
        """Keep nothing."""
        with self._lock:
            self._chunks.clear()
            self._bytes = 0
