"""HTTP server of a view, with ranges of bytes."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import ipaddress
import os
import re
import socket
import socketserver
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Protocol, TypeVar, runtime_checkable
from urllib.parse import unquote, urlsplit

from fhash_formats.errors import FhashError, InputError

UNSATISFIABLE = (-1, -1)
"""The range of a request for bytes beyond the end."""

_SINGLE = re.compile(r"\s*bytes\s*=\s*([0-9]{0,18})\s*-\s*([0-9]{0,18})\s*", re.IGNORECASE)


def byte_range(header: str | None, size: int) -> tuple[int, int] | None:
    """First byte and end of what a header `Range` asks for; None for the whole.

    header: the header's value; None where there is none. size: bytes of the whole.

    A header that is no single range of bytes does not count. UNSATISFIABLE is returned for a range
    that begins at or beyond the end.
    """
    match = None if header is None else _SINGLE.fullmatch(header)
    if match is None:
        return None
    first, last = match.groups()
    if not first and not last:
        return None
    if not first:
        length = int(last)
        return (max(0, size - length), size) if length and size else UNSATISFIABLE
    if last and int(last) < int(first):
        return None
    if int(first) >= size:
        return UNSATISFIABLE
    return int(first), min(size, int(last) + 1) if last else size


def names_tag(header: str | None, tag: str) -> bool:
    """Whether a header `If-None-Match` names an entity tag, quotes included, or any.

    A weak tag (`W/"..."`) names the strong one of the same text.
    """
    if header is None:
        return False
    names = [name.strip().removeprefix("W/") for name in header.split(",")]
    return tag in names or "*" in names


IDLE_SECONDS = 60
"""Seconds after which a connection without a request is closed."""
LOOPBACK = ("127.0.0.1", "::1", "localhost")
"""Names of this machine that no other reaches it by."""
MAX_CONNECTIONS = 256
"""Connections that are served at once, each by a thread; browsers and aiohttp open up to 100."""
EXHAUSTED = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)
"""Errors of accepting a connection that last until others are closed."""
PAUSE_SECONDS = 0.2
"""Seconds to wait where no connection can be accepted, instead of trying again at once."""
EXPOSED = "Accept-Ranges, Content-Length, Content-Range, ETag"
"""Headers of an answer that pages of allowed origins may read."""
PREFLIGHT = {
    "Access-Control-Allow-Methods": "GET, HEAD, OPTIONS",
    "Access-Control-Allow-Headers": "*, Range, If-Match, If-None-Match, If-Range, Cache-Control",
    "Access-Control-Max-Age": "86400",
    "Access-Control-Allow-Private-Network": "true",
}
"""Headers of the answer to a browser that asks what another origin may do.

Without the last one Chrome keeps pages of the Internet from servers of the own machine.
"""
GUARDS = {
    "Content-Security-Policy": "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
}
"""Headers of every answer: no page shows it in a frame or takes it for another type."""
BUSY = "\r\n".join(
    (
        "HTTP/1.1 503 Service Unavailable",
        *("Retry-After: 1", "Content-Length: 0", "Connection: close"),
        *(f"{name}: {value}" for name, value in GUARDS.items()),
        *("Cross-Origin-Resource-Policy: same-origin", "", ""),
    )
).encode()
"""The answer to a connection beyond MAX_CONNECTIONS."""
NEWS = Callable[[str], None]
"""Is told a line for each answer that is an error of the server."""
Answer = tuple[HTTPStatus, dict[str, str], bytes]
"""Status, headers and body."""
Result = TypeVar("Result")


class View(Protocol):
    """Bytes by keys."""

    hint: str
    """Answer to a client that asks for an unknown key; `{url}` stands for that of the server."""

    def tag_of(self, key: str) -> str:
        """Text that differs where the bytes of a key may."""

    def size(self, key: str) -> int | None:
        """The number of bytes of a key; None where there is no such key."""

    def kind(self, key: str) -> str:
        """The media type of a key that there is."""

    def pieces(self, key: str, first: int, end: int) -> Iterator[bytes | memoryview]:
        """Yield the bytes of a key that there is, from `first` to before `end`."""


@runtime_checkable
class Answering(Protocol):
    """A view whose bytes are made for each request, such as pictures."""

    def answer(self, key: str, query: str) -> Answer:
        """The answer to a key with the text after its `?`; called in several threads at once."""


class Server(ThreadingHTTPServer):
    """A server of one view; several clients are served at once.

    Attributes:
        view: what is served.
        url: where, with a slash at the end.
        is_local: whether no other machine reaches it.
        origins: origins whose pages may read the answers.
    """

    daemon_threads = True
    block_on_close = False
    request_queue_size = 64
    # On Windows the option would let two servers have one port.
    allow_reuse_address = os.name == "posix"

    def __init__(
        self,
        view: View | Answering,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        origins: Sequence[str] = (),
        news: NEWS = print,
    ) -> None:
        """Listen at a port, 0 for any that is free; `serve_forever` answers.

        origins: what a browser calls them, `https://example.org`; `*` is every page, and `null`
        one that was opened from a file.
        Raises InputError where the port is taken, the host is no address of this machine, or an
        origin is none.
        """
        self.view, self.news = view, news
        self.origins = frozenset(map(_origin, origins))
        self._places = threading.Semaphore(MAX_CONNECTIONS)
        self._is_exhausted = False
        try:
            family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
            self.address_family = family
            super().__init__(address[:2], _Handler)  # type: ignore[arg-type]
        except (OSError, UnicodeError, OverflowError) as error:
            raise InputError(_refused(host, port, error)) from error
        self.is_local = ipaddress.ip_address(str(self.server_address[0])).is_loopback
        self._names = {*LOOPBACK, host.lower()}
        name = f"[{host}]" if ":" in host else host
        self.url = f"http://{name}:{self.server_address[1]}/"

    def server_bind(self) -> None:
        """Take the address; the base class would look up the host's full name, too, and wait."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = map(str, self.server_address[:2])  # type: ignore[assignment]

    def is_meant(self, host: str | None) -> bool:
        """Whether a request's Host names this server; on loopback alone it can be a foreign one."""
        if not self.is_local or host is None:  # no browser leaves it out
            return True
        try:
            return urlsplit(f"//{host}").hostname in self._names
        except ValueError:
            return False

    def allowed(self, origin: str | None) -> str | None:
        """The origin that an answer names as allowed to read it; None for none."""
        if "*" in self.origins:
            return "*"
        return origin if origin in self.origins else None

    def get_request(self) -> tuple[Any, Any]:
        """Accept a connection; waits where descriptors or memory have run out."""
        try:
            accepted = super().get_request()
        except OSError as error:
            if error.errno in EXHAUSTED:
                if not self._is_exhausted:
                    self.news(f"no connection can be accepted for now: {error.strerror}")
                self._is_exhausted = True
                time.sleep(PAUSE_SECONDS)
            raise
        self._is_exhausted = False
        return accepted

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection in a thread, or refuse it at once where too many are open."""
        if not self._places.acquire(blocking=False):
            # Answers of a few bytes fit the buffer of a new connection: nothing waits here.
            request.setblocking(False)
            with contextlib.suppress(OSError):
                request.send(BUSY)
            self.shutdown_request(request)
            return
        try:
            super().process_request(request, client_address)
        except Exception:  # no thread could be started
            self._places.release()
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve a connection to its end, and give its place back."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Tell what went wrong beyond a request; a client that goes away is no error."""
        error = sys.exception()
        if not isinstance(error, ConnectionError | TimeoutError):
            self.news(f"a connection failed: {type(error).__name__}: {error}")


class _Handler(BaseHTTPRequestHandler):
    """The answers to one client."""

    server: Server
    protocol_version = "HTTP/1.1"
    server_version = "fhash"
    sys_version = ""
    timeout = IDLE_SECONDS
    # Header and body go out together; the last packet does not wait for an acknowledgement.
    wbufsize = -1
    disable_nagle_algorithm = True

    def do_GET(self) -> None:
        """Answer with the bytes of a key."""
        self._answer(body=True)

    def do_HEAD(self) -> None:
        """Answer with the headers of a key; nothing is decoded but for an `Answering` view."""
        self._answer(body=False)

    def do_OPTIONS(self) -> None:
        """Answer a browser that asks what pages of another origin may do."""
        may = PREFLIGHT if self.server.allowed(self.headers.get("Origin")) else {}
        self._send(HTTPStatus.NO_CONTENT, headers={**may, "Allow": "GET, HEAD, OPTIONS"})

    def parse_request(self) -> bool:
        """Read a request; one with a body, or that is meant for another server, is refused."""
        if not super().parse_request():
            return False
        if self.request_version == "HTTP/0.9":  # whose answers have no headers
            self.send_error(HTTPStatus.HTTP_VERSION_NOT_SUPPORTED, "HTTP/1.0 or later is served")
            return False
        hosts = self.headers.get_all("Host", [])
        lengths = self.headers.get_all("Content-Length", [])
        if "Transfer-Encoding" in self.headers or any(each.strip() != "0" for each in lengths):
            # What a proxy takes for its body must not be read as the next request.
            self.send_error(HTTPStatus.BAD_REQUEST, "a request has no body here")
            return False
        if len(hosts) > 1:
            self.send_error(HTTPStatus.BAD_REQUEST, "a request names one Host")
            return False
        if self.server.is_meant(hosts[0] if hosts else None):
            return True
        self.close_connection = True
        # The name is a stranger's and may be of any bytes: it is not repeated.
        self._tell(
            HTTPStatus.MISDIRECTED_REQUEST, f"this is {self.server.url}; ask it by that name"
        )
        return False

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing of single requests."""

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Refuse a request that is no HTTP, or of another method, with one line."""
        self.close_connection = True
        self.request_version = self.protocol_version  # of a request that has none
        status = HTTPStatus(code)
        if status == HTTPStatus.NOT_IMPLEMENTED:
            status, message = HTTPStatus.METHOD_NOT_ALLOWED, "GET, HEAD and OPTIONS are served"
        self._tell(status, message or status.phrase, {"Allow": "GET, HEAD, OPTIONS"})

    def _answer(self, *, body: bool) -> None:
        view = self.server.view
        path, _, query = self.path.partition("?")
        key = unquote(path).removeprefix("/")
        if isinstance(view, Answering):
            if (answer := self._tried(key, partial(view.answer, key, query))) is not None:
                status, headers, data = answer
                headers = {"Cache-Control": "no-store", **headers}
                self._send(status, data if body else b"", headers=headers, length=len(data))
            return
        size = view.size(key)
        if size is None:
            self._tell(HTTPStatus.NOT_FOUND, view.hint.format(url=self.server.url))
            return
        tag = f'"{_key_tag(view.tag_of(key), key)}"'
        headers = {
            "ETag": tag,
            "Accept-Ranges": "bytes",
            "Cache-Control": "no-cache",  # kept, but asked for again: another file may be served
            "Content-Type": view.kind(key),
        }
        if names_tag(self.headers.get("If-None-Match"), tag):
            self._send(HTTPStatus.NOT_MODIFIED, headers=headers)
            return
        condition = self.headers.get("If-Range")
        asked = self.headers.get("Range") if condition in (None, tag) else None
        span = byte_range(asked, size)
        if span == UNSATISFIABLE:
            self._tell(
                HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE,
                f"the key has {size} bytes",
                {"Content-Range": f"bytes */{size}"},
            )
            return
        first, end = (0, size) if span is None else span
        status = HTTPStatus.OK
        if span is not None:
            status = HTTPStatus.PARTIAL_CONTENT
            headers["Content-Range"] = f"bytes {first}-{end - 1}/{size}"
        if not body:
            self._send(status, headers=headers, length=end - first)
            return
        pieces = view.pieces(key, first, end)
        start = self._tried(key, partial(next, pieces, b""))
        if start is not None:
            self._send(status, start, headers=headers, length=end - first)
            sent = len(start)
            for piece in pieces:
                self.wfile.write(piece)
                sent += len(piece)
            self.close_connection |= sent != end - first  # of a file that was cut meanwhile

    def _tried(self, key: str, make: Callable[[], Result]) -> Result | None:
        """The result of work for a key; None where it failed, which the client was told."""
        try:
            return make()
        except FhashError as error:
            line = str(error)
        except MemoryError:
            line = "out of memory"
        except Exception as error:
            line = f"unexpected {type(error).__name__}: {error}"
        line = " ".join(line.split())
        self.server.news(f"{key}: {line}")
        self._tell(HTTPStatus.INTERNAL_SERVER_ERROR, line)
        return None

    def _tell(self, status: HTTPStatus, line: str, headers: dict[str, str] | None = None) -> None:
        """Answer with one line of text."""
        text = f"{line}\n".encode()
        told = {
            "Content-Type": "text/plain; charset=utf-8",
            "Cache-Control": "no-store",
            **(headers or {}),
        }
        if self.command == "HEAD":
            self._send(status, headers=told, length=len(text))
        else:
            self._send(status, text, headers=told)

    def _send(
        self,
        status: HTTPStatus,
        data: bytes | memoryview = b"",
        *,
        headers: dict[str, str],
        length: int | None = None,
    ) -> None:
        """Send an answer. length: bytes of the whole body, where `data` is not all of it."""
        self.send_response(status)
        # A request that could not be read has no headers.
        asking = getattr(self, "headers", None)
        origin = self.server.allowed(asking.get("Origin") if asking else None)
        if origin is not None:
            self.send_header("Access-Control-Allow-Origin", origin)
            self.send_header("Access-Control-Expose-Headers", EXPOSED)
        whose = "same-origin" if origin is None else "cross-origin"
        headers = {**headers, **GUARDS, "Cross-Origin-Resource-Policy": whose}
        if self.server.origins - {"*"}:
            self.send_header("Vary", "Origin")
        for name, value in headers.items():
            self.send_header(name, value)
        if status not in (HTTPStatus.NO_CONTENT, HTTPStatus.NOT_MODIFIED):
            self.send_header("Content-Length", str(len(data) if length is None else length))
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(data)


def _origin(text: str) -> str:
    """An origin as browsers write it. Raises InputError for what is none."""
    if text in ("*", "null"):
        return text
    try:
        parts = urlsplit(text)
        if parts.scheme and parts.hostname and parts.path in ("", "/") and not parts.query:
            return f"{parts.scheme}://{parts.netloc}".lower()
    except ValueError:
        pass
    raise InputError(
        f"origin '{text}' is none; https://example.org or http://localhost:8080 is one"
    )


def _key_tag(tag: str, key: str) -> str:
    """The entity tag of a key, without quotes."""
    return hashlib.sha256(f"{tag}/{key}".encode()).hexdigest()[:32]


def _refused(host: str, port: int, error: Exception) -> str:
    """Says why nothing can listen there, and what to do."""
    if isinstance(error, socket.gaierror | UnicodeError):
        return f"host '{host}' is not known; 127.0.0.1 is this machine alone, 0.0.0.0 every address"
    if isinstance(error, OverflowError):
        return f"port {port} is outside 0 to 65535"
    reason = getattr(error, "strerror", None) or str(error)
    return f"{host}:{port} cannot be served: {reason}; give another --port, 0 for any that is free"
