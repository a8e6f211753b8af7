"""Files elsewhere: bytes in few requests, to any file system of fsspec."""

from __future__ import annotations

import os
import threading
import time
import warnings
from bisect import bisect_right, insort
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext, suppress
from itertools import count
from typing import Any, TypeVar

from fhash_formats.container.zip_file import CHANGED, Range, Request, Source, check_range, merged
from fhash_formats.errors import (
    DamagedFileError,
    FhashError,
    FhashWarning,
    InputError,
    MissingDependencyError,
    MissingInputError,
)
from fhash_formats.support.files import object_store

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

    def __init__(self, file: FsspecFile) -> None:
        """Read the end of a file. Raises what `FsspecFile.fetch` raises."""
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
            in_tail = self._tail_start
            before = {(offset, min(size, in_tail - offset)) for offset, size in places}
            new = [place for place in before if place[1] > 0 and self._known(place) is None]
            if not new:
                return
            for fetch in [fetch for fetch in self._waiting if fetch.thread == thread]:
                self._waiting.remove(fetch)
                self._forget(fetch)
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
            if fetch.request.span in self._kept:
                self._kept.move_to_end(fetch.request.span)
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
            if announced and request.span not in self._kept:
                self._kept[request.span] = fetch
                insort(self._kept_places, request.span)
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


PAUSES = (0.2, 0.8, 3.2)
"""Seconds before a failed request is made again, each once."""
WHOLE_BYTES = 64 << 20
"""Bytes of a file that are read at once from a server that cannot give a part."""

END_BYTES = 128
"""Bytes of the end of a file by which two containers differ."""
_PASSING = {408, 425, 429, 500, 502, 503, 504}
"""HTTP statuses that say that the same request may succeed later."""
_CHANGED = 412
"""HTTP status that says that the file is not the one that was asked for."""
_STAMP = (
    *("size", "ETag", "etag", "Content-MD5", "Digest", "md5Hash", "content_md5", "checksum"),
    *("Last-Modified", "LastModified", "last_modified", "mtime", "modified", "updated"),
    *("generation", "VersionId", "version_id", "created", "ino", "e_tag"),
)
"""Entries of `fs.info` that differ between a file and another one in its place."""

Result = TypeVar("Result")


class FsspecFile:
    """A file of an fsspec file system; several threads may call its methods.

    Attributes:
        size: number of bytes.
        connections: requests at once; 1 for file systems that are not made for several.
    """

    def __init__(
        self, fs: Any, path: str, name: str, *, pause: Callable[[float], object] = time.sleep
    ) -> None:
        """Ask for size and version of a file.

        Args:
            fs: file system of fsspec.
            path: of the file, as the file system wants it.
            name: for messages.
            pause: waits for a number of seconds.

        Raises MissingInputError, or InputError for a folder, without permission or connection.
        """
        self._made, self._process = fs, os.getpid()
        self._path, self._name, self._pause = path, name, pause
        self._http = "http" in _protocols(fs)
        self.connections = CONNECTIONS if getattr(fs, "async_impl", False) else 1
        self._turn = threading.Lock()
        self._whole: bytes | None = None
        info = self._tried(self._info)
        if info.get("type") == "directory":
            raise InputError(f"{name}: a folder; a .fhz container is one file")
        if not isinstance(info.get("size"), int):
            raise InputError(f"{name}: its server does not say its size; download it first")
        self.size: int = info["size"]
        self._partial = info.get("partial", True)
        self._stamp = state_of(info)
        self._conditions = _conditions(info) if self._http else {}
        self._gave_parts = False
        self._end: bytes | None = None
        self._clock = count()
        self._checked = -1
        self._check_lock = threading.Lock()

    @classmethod
    def open(cls, url: str, options: Mapping[str, Any]) -> FsspecFile:
        """The file that a URL names; `options` are those of its file system in fsspec.

        Raises MissingDependencyError without fsspec or the package for the URL's scheme,
        InputError for an unknown scheme or option, and what the constructor raises.
        """
        try:
            from fsspec.core import url_to_fs
        except ImportError as error:
            raise MissingDependencyError(
                f"{url}: URLs need fsspec; pip install 'fhash[remote]'"
            ) from error
        try:
            store = None if options else object_store(url)
            if store is not None:
                return cls(store, url, url)
            fs, path = url_to_fs(url, **options)
        except ImportError as error:
            needed = "pip install 'fhash[remote]'" if url.startswith("http") else _first_line(error)
            raise MissingDependencyError(f"{url}: a package is missing; {needed}") from error
        except FileNotFoundError as error:
            raise MissingInputError(f"{url}: no such file") from error
        except (ValueError, TypeError, OSError) as error:
            raise InputError(f"{url}: cannot be opened: {_first_line(error)}") from error
        return cls(fs, path, url)

    def fetch(self, start: int, stop: int) -> bytes:
        """The bytes [start, stop), by one request, again where that fails for a while.

        Raises MissingInputError or InputError that says why, also where the file changed, and
        DamagedFileError for a file that is shorter than its size.
        """
        if self._whole is None and not self._partial:
            self._read_whole()
        if self._whole is not None:
            return self._whole[start:stop]
        data = self._tried(lambda: self._range(start, stop))
        if self._whole is None and not self._conditions:
            if self._http and self._end is None and stop == self.size:
                self._end = data[-END_BYTES:]
            else:
                self._check_unchanged()
        return data

    def changed(self) -> bool:
        """Whether another file is there now, or none; False where that cannot be known."""
        try:
            return state_of(self._info()) != self._stamp
        except FileNotFoundError as error:
            return not _may_pass(error)
        except Exception:
            return False

    @property
    def _fs(self) -> Any:
        """The file system; a forked process needs one of its own."""
        if self._process != os.getpid():
            made = self._made
            self._made = type(made)(*made.storage_args, **made.storage_options)
            self._process = os.getpid()
            self._check_lock, self._turn = threading.Lock(), threading.Lock()
        return self._made

    def _alone(self) -> AbstractContextManager[object]:
        """A block in which no other thread uses a file system that is not made for several."""
        return nullcontext() if self.connections > 1 else self._turn

    def _info(self) -> dict[str, Any]:
        fs = self._fs
        with self._alone():
            fs.invalidate_cache(self._path)
            return dict(fs.info(self._path))

    def _range(self, start: int, stop: int) -> bytes:
        """The bytes [start, stop) by one request."""
        if self._http:
            data = self._http_range(start, stop)
        else:
            fs = self._fs
            with self._alone():
                data = fs.cat_file(self._path, start=start, end=stop)
        if len(data) != stop - start:
            raise _ShortError(f"{len(data)} bytes came for the range {start} to {stop}")
        return bytes(data)

    def _http_range(self, start: int, stop: int) -> bytes:
        """The same by HTTP: `cat_file` would load a whole file where a server gives no parts."""
        headers = self._headers()
        options = {"size": self.size, "cache_type": "none", "headers": headers}
        try:
            with self._fs.open(self._path, "rb", **options) as file:
                file.seek(start)
                data = bytes(file.read(stop - start))
            self._gave_parts = True
            return data
        except ValueError as error:
            if "range requests" not in str(error):
                raise
        if "If-Range" in self._conditions:
            if self._gave_parts:
                # The whole of another version, of which nothing was loaded.
                raise InputError(f"{self._name}: {CHANGED}")
            # Some servers do not know their own tags; then the other condition is left.
            del self._conditions["If-Range"]
            return self._http_range(start, stop)
        self._read_whole()
        assert self._whole is not None
        return self._whole[start:stop]

    def _headers(self) -> dict[str, str]:
        own = self._fs.kwargs.get("headers", {})
        return {"Accept-Encoding": "identity", **own, **self._conditions}

    def _read_whole(self) -> None:
        """Read a file at once whose server gives no parts; refuse a large one."""
        if self.size > WHOLE_BYTES:
            raise InputError(
                f"{self._name}: its server gives no parts of files (no range requests), and the"
                f" file has {self.size} bytes; download it first"
            )
        warnings.warn(
            f"{self._name}: its server gives no parts of files (no range requests);"
            f" all {self.size} bytes are read",
            FhashWarning,
            stacklevel=2,
        )

        def read() -> bytes:
            data = bytes(self._fs.cat_file(self._path, headers=self._headers()))
            if len(data) != self.size:
                raise _ShortError(f"{len(data)} bytes came for {self.size}")
            return data

        self._whole = self._tried(read)

    def _check_unchanged(self) -> None:
        """Raise InputError if another file is there than was opened.

        One question answers for all bytes that came before it was asked.
        """
        came = next(self._clock)
        with self._check_lock:
            if self._checked > came:
                return
            asked = next(self._clock)
            if not self._http:
                same = state_of(self._tried(self._info)) == self._stamp
            else:
                end = self._tried(lambda: self._range(max(0, self.size - END_BYTES), self.size))
                same = self._end in (None, end)
                self._end = end if self._end is None else self._end
            if not same:
                raise InputError(f"{self._name}: {CHANGED}")
            self._checked = asked

    def _tried(self, action: Callable[[], Result]) -> Result:
        """The result of an action, which is tried again while its failure may pass."""
        for pause in (*PAUSES, None):
            try:
                return action()
            except FhashError:
                raise
            except Exception as error:
                if _status(error) == _CHANGED:
                    raise InputError(f"{self._name}: {CHANGED}") from error
                if pause is None or not _may_pass(error):
                    raise self._explained(error) from error
            self._pause(pause)
        raise AssertionError("the last trial returns or raises")

    def _explained(self, error: Exception) -> FhashError:
        """The error that a user is told of a failed request."""
        status = _status(error)
        if isinstance(error, _ShortError):
            if self.changed():
                return InputError(f"{self._name}: {CHANGED}")
            return DamagedFileError(f"the file is cut short: {error}")
        if status == 404 or (
            status is None and isinstance(error, FileNotFoundError) and not _may_pass(error)
        ):
            return MissingInputError(f"{self._name}: no such file")
        if status in (401, 403) or isinstance(error, PermissionError):
            return InputError(
                f"{self._name}: no permission to read it; storage_options may name a user"
            )
        reason = f"HTTP status {status}" if status is not None else _first_line(_cause(error))
        again = f", {len(PAUSES) + 1} times" if _may_pass(error) else ""
        return InputError(f"{self._name}: cannot be read{again}: {reason}")


class _ShortError(OSError):
    """Fewer or more bytes than were asked for."""


def _protocols(fs: Any) -> tuple[str, ...]:
    protocol = fs.protocol
    return (protocol,) if isinstance(protocol, str) else tuple(protocol)


def state_of(info: Mapping[str, Any]) -> dict[str, Any]:
    """The state of a file by what `info` of its file system says; another file has another one."""
    return {key: info[key] for key in _STAMP if info.get(key) is not None}


def _conditions(info: Mapping[str, Any]) -> dict[str, str]:
    """Headers by which a server gives bytes of the version that was opened, and no others.

    Servers that ignore If-Match may heed If-Range, and give all of another version. A weak ETag
    equals none in either (RFC 9110, 13.1).
    """
    tag, modified = info.get("ETag"), info.get("Last-Modified")
    if isinstance(tag, str) and tag.startswith('"'):
        return {"If-Match": tag, "If-Range": tag}
    if isinstance(modified, str):
        return {"If-Unmodified-Since": modified, "If-Range": modified}
    return {}


def _cause(error: BaseException) -> BaseException:
    """The failure behind a FileNotFoundError, which fsspec makes of any failure of HTTP."""
    return error.__cause__ or error if isinstance(error, FileNotFoundError) else error


def _status(error: BaseException) -> int | None:
    """The HTTP status that a failure has; None where there is none."""
    status = getattr(_cause(error), "status", None)
    return status if isinstance(status, int) else None


def _may_pass(error: BaseException) -> bool:
    """Whether the same request may succeed later: connections, timeouts, servers that are busy."""
    status = _status(error)
    if status is not None:
        return status in _PASSING
    cause = _cause(error)
    lasting = FileNotFoundError | PermissionError | IsADirectoryError | NotADirectoryError
    if isinstance(cause, lasting | ValueError):
        return False
    return isinstance(cause, OSError) or type(cause).__module__.partition(".")[0] == "aiohttp"


def _first_line(error: BaseException) -> str:
    lines = str(error).splitlines()
    return (lines[0] if lines else type(error).__name__)[:200]
