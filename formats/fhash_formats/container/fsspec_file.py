"""Files of any file system that fsspec knows: HTTP, S3, memory, an archive, ...

A request that fails for a reason that may pass is made again. A file that changes meanwhile is
noticed: a server of HTTP is asked for the bytes of the version that was opened. One that names no
version is asked again for the end of the file after the bytes came, since a container ends in a
digest of all; another file system is asked whether the file is still the same.
"""

from __future__ import annotations

import os
import threading
import time
import warnings
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from itertools import count
from typing import Any, TypeVar

from fhash_formats.container.remote import CONNECTIONS
from fhash_formats.container.source import CHANGED
from fhash_formats.errors import (
    DamagedFileError,
    FhashError,
    FhashWarning,
    InputError,
    MissingDependencyError,
    MissingInputError,
)

__all__ = ["FsspecFile"]

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
    *("generation", "VersionId", "version_id", "created", "ino"),
)
"""Entries of `fs.info` that differ between a file and another one in its place."""

Result = TypeVar("Result")


class FsspecFile:
    """A file of an fsspec file system (`RemoteFile`); several threads may call its methods.

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
        self._stamp = _stamp(info)
        self._conditions = _conditions(info) if self._http else {}
        self._gave_parts = False
        self._end: bytes | None = None
        self._clock = count()
        self._checked = -1
        self._check_lock = threading.Lock()

    @classmethod
    def open(cls, url: str, options: Mapping[str, Any]) -> FsspecFile:
        """The file that a URL names; `options` are those of its file system.

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
            return _stamp(self._info()) != self._stamp
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
                same = _stamp(self._tried(self._info)) == self._stamp
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


def _stamp(info: Mapping[str, Any]) -> dict[str, Any]:
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
