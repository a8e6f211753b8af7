"""`RemoteSource`: a source whose reads take long, each a request to somewhere else.

Three things make few requests of many reads. The end of the file, where header and directory lie,
is read once and kept. Ranges that a reader announces (`prefetch`) are merged with their neighbours
and fetched side by side. What was fetched is kept for a while.
"""

from __future__ import annotations

import os
import threading
from bisect import bisect_right, insort
from collections import OrderedDict, deque
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import Protocol

from fhash_formats.container.source import Range, Request, Source, check_range, merged
from fhash_formats.errors import InputError

__all__ = ["GAP", "TAIL_BYTES", "RemoteFile", "RemoteSource"]

TAIL_BYTES = 16 << 10
"""Bytes of the end of a file that are read first; directory and header of most files lie there."""
MAX_TAIL_BYTES = 1 << 20
"""Bytes of the end of a file that are kept for good."""
GAP = 16 << 10
"""Bytes between two ranges up to which both are fetched at once.

At 100 Mbit/s they take 1.3 ms, which is less than a further request does on any network.
"""
REQUEST_BYTES = 2 << 20
"""Bytes of a request for several ranges: large enough that its round trip does not count."""
AHEAD_BYTES = 16 << 20
"""Bytes that are fetched before they are read."""
KEPT_BYTES = 32 << 20
"""Bytes of requests that are kept once they came."""
CONNECTIONS = 8
"""Requests at once. Further ones rarely are faster, and servers refuse clients with many."""


class RemoteFile(Protocol):
    """A file elsewhere; several threads may call its methods.

    Attributes:
        size: number of bytes.
        connections: requests at once that it allows.
    """

    size: int
    connections: int

    def fetch(self, start: int, stop: int) -> bytes:
        """The bytes [start, stop), by one request; raises InputError where it fails for good."""
        ...

    def changed(self) -> bool:
        """Whether another file is there now."""
        ...


class _Fetch:
    """A request, its bytes once they came, and whether anybody began to fetch and to read them."""

    def __init__(self, request: Request, thread: int) -> None:
        self.request = request
        self.thread = thread  # that announced it
        self.data: Future[bytes] = Future()
        self.begun = False


class RemoteSource(Source):
    """A file elsewhere as the source of a container."""

    gap = GAP

    def __init__(self, file: RemoteFile) -> None:
        """Read the end of a file. Raises what `RemoteFile.fetch` raises."""
        self._file = file
        self.size = file.size
        self._tail_start = max(0, self.size - TAIL_BYTES)
        self._tail = file.fetch(self._tail_start, self.size) if self.size else b""
        self._closed = False
        self._reset()

    def _reset(self) -> None:
        """Know no requests; a forked process has none of its parent's threads."""
        self._process = os.getpid()
        self._lock = threading.Lock()
        self._pool: ThreadPoolExecutor | None = None
        self._fetches: dict[Range, _Fetch] = {}
        self._kept: OrderedDict[Range, _Fetch] = OrderedDict()
        self._kept_places: list[Range] = []
        self._kept_bytes = 0
        self._waiting: deque[_Fetch] = deque()
        self._ahead: set[_Fetch] = set()

    def read(self, offset: int, size: int) -> bytes:
        """Exactly `size` bytes from `offset`; raises DamagedFileError if they are not there."""
        check_range(self, offset, size)
        if self._process != os.getpid():
            self._reset()
        with self._lock:
            if self._closed:
                raise InputError("the container is closed")
            start, tail = self._tail_start, self._tail
        if size == 0:
            return b""
        if offset >= start:
            return tail[offset - start : offset - start + size]
        before = min(size, start - offset)
        data = self._fetched(offset, before)
        if before == size:
            return data
        with self._lock:
            if self._tail_start == start and before + len(tail) <= MAX_TAIL_BYTES:
                self._tail_start, self._tail = offset, data + tail
        return data + tail[: size - before]

    def prefetch(self, ranges: Iterable[Range]) -> None:
        """Begin to fetch ranges that will be read soon, each as it stands here.

        They are merged where they are neighbours. No more requests than the file allows, and no
        more than AHEAD_BYTES, run ahead of the reads. What the same thread announced before,
        and nobody has begun to fetch, is forgotten: its reader gave up.
        """
        if self._process != os.getpid():
            self._reset()
        # An iterator may wait for a lock that a reader holds: it ends before this lock is taken.
        places, thread = list(ranges), threading.get_ident()
        with self._lock:
            for fetch in [fetch for fetch in self._waiting if fetch.thread == thread]:
                self._waiting.remove(fetch)
                self._forget(fetch)
            in_tail = self._tail_start
            before = {(offset, min(size, in_tail - offset)) for offset, size in places}
            new = [place for place in before if place[1] > 0 and self._known(place) is None]
            fetches = [_Fetch(request, thread) for request in merged(new, GAP, REQUEST_BYTES)]
            for fetch in fetches:
                self._fetches.update(dict.fromkeys(fetch.request.ranges, fetch))
            self._waiting.extend(fetches)
            # What came and was not read since an earlier call shall not hold up this one.
            self._ahead = {fetch for fetch in self._ahead if not fetch.data.done()}
        # A single request is as soon begun by the thread that reads it.
        if len(fetches) > 1:
            self._begin_more()

    def changed(self) -> bool:
        """Whether another file is there now."""
        return self._file.changed()

    def close(self) -> None:
        """Forget all that was fetched; requests that run still end."""
        with self._lock:
            self._closed = True
            pool, self._pool = self._pool, None
            self._fetches.clear()
            self._kept.clear()
            self._kept_places.clear()
            self._kept_bytes = 0
            self._waiting.clear()
            self._tail = b""
        if pool is not None:
            pool.shutdown(wait=False)

    def _fetched(self, offset: int, size: int) -> bytes:
        """Bytes before the tail: those of a request that was announced, or of their own."""
        with self._lock:
            fetch = self._known((offset, size))
            if fetch is None:
                request = Request(start=offset, stop=offset + size, ranges=((offset, size),))
                fetch = _Fetch(request, threading.get_ident())
            mine = not fetch.begun
            fetch.begun = True
            self._ahead.discard(fetch)
            if mine:
                with suppress(ValueError):
                    self._waiting.remove(fetch)
            if fetch.request.place in self._kept:
                self._kept.move_to_end(fetch.request.place)
        self._begin_more()
        if mine:
            self._run(fetch)
        start = offset - fetch.request.start
        return fetch.data.result()[start : start + size]

    def _begin_more(self) -> None:
        """Begin requests that wait, as far as those that run ahead of the reads allow."""
        with self._lock:
            while self._waiting and not self._closed:
                ahead = sum(fetch.request.size for fetch in self._ahead)
                if len(self._ahead) >= self._file.connections or ahead >= AHEAD_BYTES:
                    return
                fetch = self._waiting.popleft()
                if self._pool is None:
                    self._pool = ThreadPoolExecutor(
                        self._file.connections, thread_name_prefix="fhash-fetch"
                    )
                try:
                    self._pool.submit(self._run, fetch)
                except RuntimeError:  # no thread can be started; the reader will fetch it
                    return
                fetch.begun = True
                self._ahead.add(fetch)

    def _run(self, fetch: _Fetch) -> None:
        """Fetch a request, and keep it where it was announced and succeeded."""
        request = fetch.request
        try:
            data = self._file.fetch(request.start, request.stop)
        except BaseException as error:
            with self._lock:
                self._ahead.discard(fetch)
                self._forget(fetch)
            fetch.data.set_exception(error)
            return
        with self._lock:
            announced = self._fetches.get(request.ranges[0]) is fetch
            if announced and request.place not in self._kept:
                self._kept[request.place] = fetch
                insort(self._kept_places, request.place)
                self._kept_bytes += request.size
                while self._kept_bytes > KEPT_BYTES:
                    place, dropped = self._kept.popitem(last=False)
                    self._kept_places.remove(place)
                    self._kept_bytes -= dropped.request.size
                    self._forget(dropped)
        fetch.data.set_result(data)

    def _known(self, place: Range) -> _Fetch | None:
        """The request that a range was announced with, or one that came and holds it."""
        fetch = self._fetches.get(place)
        if fetch is None:
            # The nearest one that begins before it is enough: requests seldom overlap.
            number = bisect_right(self._kept_places, (place[0], self.size))
            nearest = self._kept_places[number - 1] if number else (0, 0)
            if sum(place) <= sum(nearest):
                fetch = self._kept[nearest]
        return fetch

    def _forget(self, fetch: _Fetch) -> None:
        """Let no range be read from a request any more."""
        for key in fetch.request.ranges:
            if self._fetches.get(key) is fetch:
                del self._fetches[key]
