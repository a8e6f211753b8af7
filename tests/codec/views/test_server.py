"""Ranges and conditions of HTTP requests."""

from __future__ import annotations

import errno
import http.client
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest

from fhash_codec.views.server import UNSATISFIABLE, Server, byte_range, names_tag
from fhash_codec.views.view import opened_view
from fhash_formats.errors import InputError


@pytest.mark.parametrize(
    ("header", "span"),
    [
        (None, None),
        ("bytes=0-9", (0, 10)),
        ("bytes=5-5", (5, 6)),
        ("bytes=90-", (90, 100)),
        ("bytes=90-1000", (90, 100)),
        ("bytes=-7", (93, 100)),
        ("bytes=-1000", (0, 100)),
        ("Bytes = 1-2", (1, 3)),
        ("bytes=100-", UNSATISFIABLE),
        ("bytes=100-200", UNSATISFIABLE),
        ("bytes=-0", UNSATISFIABLE),
        ("bytes=9-3", None),
        ("bytes=0-1,5-6", None),
        ("bytes=-", None),
        ("bytes=a-b", None),
        ("lines=0-1", None),
        ("bytes=" + "9" * 30 + "-", None),
    ],
)
def test_ranges(header: str | None, span: tuple[int, int] | None) -> None:
    assert byte_range(header, 100) == span


@pytest.mark.parametrize(
    ("header", "named"),
    [
        (None, False),
        ('"a"', True),
        ('W/"a"', True),
        ('"b", "a"', True),
        ("*", True),
        ('"b"', False),
        ("a", False),
        ("", False),
    ],
)
def test_tags(header: str | None, named: bool) -> None:
    assert names_tag(header, '"a"') is named


CHUNK = "/density/c/0/0/0/0"

Answer = tuple[int, dict[str, str], bytes]
Ask = Callable[..., Answer]


@contextmanager
def serving(
    path: Path, news: Callable[[str], None] = print, origins: Sequence[str] = ()
) -> Iterator[Server]:
    """A server in a thread of its own."""
    volume, view = opened_view(path)
    with volume, Server(view, news=news, origins=origins) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


def asking(server: Server) -> Ask:
    """A function that sends one request: a path, a method, headers."""

    def ask(path: str, method: str = "GET", **headers: str) -> Answer:
        connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1], timeout=30)
        try:
            names = {name.replace("_", "-"): value for name, value in headers.items()}
            connection.request(method, path, headers=names)
            answer = connection.getresponse()
            return answer.status, dict(answer.getheaders()), answer.read()
        finally:
            connection.close()

    return ask


@pytest.fixture
def ask(whole: Path) -> Iterator[Ask]:
    with serving(whole) as server:
        yield asking(server)


@pytest.mark.usefixtures("apart")
def test_every_key_has_the_bytes_of_the_view(feature: Path) -> None:
    with serving(feature) as server:
        ask, view = asking(server), server.view
        connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1])
        for key in view.listing():
            connection.request("GET", f"/{key}")  # all over one connection
            answer = connection.getresponse()
            assert answer.status == 200
            assert answer.read() == view.get(key)
        connection.close()
        absent = "/density/c/0/0/0/0"
        assert view.size(absent[1:]) is None
        assert ask(absent)[0] == 404


def raw(server: Server, request: bytes) -> tuple[bytes, dict[str, str], bytes]:
    """Status line, headers, and all that follows, of bytes sent over one connection."""
    with socket.create_connection(server.server_address[:2], timeout=30) as connection:
        connection.sendall(request)
        connection.shutdown(socket.SHUT_WR)
        head, _, rest = b"".join(iter(partial(connection.recv, 1 << 16), b"")).partition(
            b"\r\n\r\n"
        )
    status, *lines = head.split(b"\r\n")
    return status, dict(line.decode().split(": ", 1) for line in lines), rest


HOST = b" HTTP/1.1\r\nHost: 127.0.0.1\r\n"
SMUGGLED = b"GET /zarr.json" + HOST + b"\r\n"
GOOD = "https://good.example"
REQUESTS = {
    "a key": (b"GET /zarr.json" + HOST, b"200"),
    "HEAD": (b"HEAD /zarr.json" + HOST, b"200"),
    "OPTIONS": (b"OPTIONS /zarr.json" + HOST, b"204"),
    "of an allowed page": (b"GET /zarr.json" + HOST + f"Origin: {GOOD}\r\n".encode(), b"200"),
    "kept": (b"GET /zarr.json" + HOST + b"If-None-Match: *\r\n", b"304"),
    "unknown": (b"GET /nothing" + HOST, b"404"),
    "another name": (b"GET / HTTP/1.1\r\nHost: evil.example\r\n", b"421"),
    "two names": (b"GET /" + HOST + b"Host: evil.example\r\n", b"400"),
    "no HTTP": (b"\0<script>\r\n", b"400"),
    "another version": (b"GET /zarr.json HTTP/1.x\r\n", b"400"),
    "no version": (b"GET /zarr.json\r\n", b"505"),
    "PUT": (b"PUT /zarr.json" + HOST, b"405"),
    "a range beyond": (b"GET /zarr.json" + HOST + b"Range: bytes=999999-\r\n", b"416"),
    "no body": (b"GET /zarr.json" + HOST + b"Content-Length: 0\r\n", b"200"),
    "a body": (b"GET /nothing" + HOST + b"Content-Length: 43\r\n", b"400"),
    "a body of HEAD": (b"HEAD /nothing" + HOST + b"Content-Length: 43\r\n", b"400"),
    "two lengths": (
        b"GET /nothing" + HOST + b"Content-Length: 0\r\nContent-Length: 43\r\n",
        b"400",
    ),
    "a chunked body": (b"GET /nothing" + HOST + b"Transfer-Encoding: chunked\r\n", b"400"),
}


@pytest.mark.parametrize("name", REQUESTS)
def test_every_answer_is_guarded_and_a_body_is_no_request(whole: Path, name: str) -> None:
    request, code = REQUESTS[name]
    bodied = name.startswith(("a body", "two lengths", "a chunked"))
    with serving(whole, origins=[GOOD]) as server:
        status, headers, rest = raw(server, request + b"\r\n" + (SMUGGLED if bodied else b""))
    assert status.split()[1] == code
    assert headers["Content-Security-Policy"] == "frame-ancestors 'none'"
    assert headers["X-Content-Type-Options"] == "nosniff"
    whose = "cross-origin" if "allowed" in name else "same-origin"
    assert headers["Cross-Origin-Resource-Policy"] == whose
    if bodied:
        assert headers["Connection"] == "close"
        assert b"HTTP/1.1" not in rest


def test_ranges_server(ask: Ask) -> None:
    _, headers, body = ask(CHUNK)
    size = len(body)
    assert headers["Accept-Ranges"] == "bytes"
    for asked, first, end in (
        ("bytes=10-19", 10, 20),
        (f"bytes={size - 3}-", size - 3, size),
        ("bytes=-5", size - 5, size),
        (f"bytes=4-{10 * size}", 4, size),
    ):
        status, headers, part = ask(CHUNK, Range=asked)
        assert status == 206
        assert part == body[first:end]
        assert headers["Content-Range"] == f"bytes {first}-{end - 1}/{size}"
        assert int(headers["Content-Length"]) == end - first
    status, headers, part = ask(CHUNK, Range=f"bytes={size}-")
    assert (status, headers["Content-Range"]) == (416, f"bytes */{size}")
    assert ask(CHUNK, Range="bytes=0-1,4-5")[::2] == (200, body)
    assert ask(CHUNK, "HEAD", Range="bytes=0-1")[::2] == (206, b"")


def test_what_a_client_has_is_not_sent_again(ask: Ask) -> None:
    _, headers, body = ask(CHUNK)
    tag = headers["ETag"]
    assert headers["Cache-Control"] == "no-cache"
    status, headers, empty = ask(CHUNK, If_None_Match=f'"other", {tag}')
    assert (status, empty, headers["ETag"]) == (304, b"", tag)
    assert ask(CHUNK, If_None_Match='"other"')[::2] == (200, body)
    assert ask("/zarr.json")[1]["ETag"] != tag
    assert ask(CHUNK, Range="bytes=0-3", If_Range=tag)[0] == 206
    assert ask(CHUNK, Range="bytes=0-3", If_Range='"other"')[::2] == (200, body)


@pytest.mark.parametrize("path", ["/zarr.json", CHUNK, "/nope"])
@pytest.mark.parametrize("origin", ["https://example.org", "null"])
def test_pages_of_named_origins_may_read(whole: Path, path: str, origin: str) -> None:
    with serving(whole, origins=["HTTPS://Example.org/", "null"]) as server:
        ask = asking(server)
        _, headers, _ = ask(path, Origin=origin)
        assert (headers["Access-Control-Allow-Origin"], headers["Vary"]) == (origin, "Origin")
        assert "ETag" in headers["Access-Control-Expose-Headers"]
        status, headers, body = ask(
            path, "OPTIONS", Origin=origin, Access_Control_Request_Method="GET"
        )
        assert (status, body) == (204, b"")
        assert headers["Access-Control-Allow-Origin"] == origin
        assert "Range" in headers["Access-Control-Allow-Headers"]
        assert headers["Access-Control-Allow-Methods"] == "GET, HEAD, OPTIONS"


@pytest.mark.parametrize("origins", [[], ["https://example.org"]])
def test_pages_of_other_origins_may_not(whole: Path, origins: list[str]) -> None:
    with serving(whole, origins=origins) as server:
        for method in ("GET", "OPTIONS"):
            for other in ("https://example.org.evil.net", "http://example.org", "null"):
                _, headers, _ = asking(server)("/zarr.json", method, Origin=other)
                assert not [name for name in headers if name.startswith("Access-Control")]
    with serving(whole, origins=["*"]) as server:
        assert asking(server)("/nope", Origin="null")[1]["Access-Control-Allow-Origin"] == "*"


@pytest.mark.parametrize("text", ["example.org", "https://", "https://a/b", "https://[", ""])
def test_what_is_no_origin_is_refused(whole: Path, text: str) -> None:
    with serving(whole) as server, pytest.raises(InputError, match=r"origin '.*' is none"):
        Server(server.view, origins=[text])


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.net", "[", ""])
def test_names_of_other_machines_get_nothing_on_loopback(whole: Path, host: str) -> None:
    with serving(whole) as server:
        ask = asking(server)
        for path, method in (("/zarr.json", "GET"), (CHUNK, "HEAD"), ("/zarr.json", "OPTIONS")):
            status, _, body = ask(path, method, Host=host)
            assert (status, b"shape" in body) == (421, False)
        for name in ("localhost", "LOCALHOST:1", "[::1]:80", "127.0.0.1"):
            assert ask("/zarr.json", Host=name)[0] == 200
        with socket.create_connection(server.server_address[:2], timeout=30) as raw:
            raw.sendall(b"GET /zarr.json HTTP/1.0\r\n\r\n")
            assert raw.recv(15) == b"HTTP/1.1 200 OK"
    volume, view = opened_view(whole)
    with volume, Server(view, host="0.0.0.0") as everywhere:
        assert everywhere.is_meant("a.name.of.this.machine")
        with Server(view, host="127.0.0.2") as other:
            assert other.is_local
            assert other.is_meant("127.0.0.2:80")
            assert not other.is_meant("evil.example")


def test_connections_beyond_the_limit_are_told_so(
    whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fhash_codec.views.server.MAX_CONNECTIONS", 2)
    with serving(whole) as server:
        held = [http.client.HTTPConnection("127.0.0.1", server.server_address[1]) for _ in "ab"]
        for connection in held:
            connection.request("GET", "/zarr.json")
            assert connection.getresponse().read()
        status, headers, _ = asking(server)("/zarr.json")
        assert (status, headers["Retry-After"]) == (503, "1")
        for connection in held:
            connection.close()
        for _ in range(200):  # the server sees the end of a connection when its thread runs
            status = asking(server)("/zarr.json")[0]
            if status == 200:
                break
            time.sleep(0.05)
        assert status == 200


def test_without_descriptors_the_server_waits(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    news: list[str] = []
    failures = iter([OSError(errno.EMFILE, "Too many open files")] * 2)
    accept = socket.socket.accept

    def accept_later(self: socket.socket) -> object:
        for failure in failures:
            raise failure
        return accept(self)

    pauses: list[float] = []
    monkeypatch.setattr(socket.socket, "accept", accept_later)
    monkeypatch.setattr("fhash_codec.views.server.time.sleep", pauses.append)
    with serving(whole, news.append) as server:
        assert asking(server)("/zarr.json")[0] == 200
    assert news == ["no connection can be accepted for now: Too many open files"]
    assert len(pauses) == 2


@pytest.mark.parametrize(
    "path",
    [
        "/", "/nope", "/density", "/density/c/0/0/0/99", "/../../etc/passwd", "/%2e%2e/etc/passwd",
        "/zarr.json/", "/density/c/0/0/0/%30%30", "/whole.fhz", "/%7f", "/%ff%fe",
    ],
)  # fmt: skip
def test_other_paths_are_not_found(ask: Ask, path: str) -> None:
    status, headers, body = ask(path)
    assert status == 404
    assert body.count(b"\n") == 1
    assert headers["Cache-Control"] == "no-store"
    assert ask(path, "HEAD")[::2] == (404, b"")
    assert ask("/zarr.json")[0] == 200


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "BREW"])
def test_other_methods_are_refused(ask: Ask, method: str) -> None:
    status, headers, body = ask("/zarr.json", method)
    assert (status, headers["Allow"]) == (405, "GET, HEAD, OPTIONS")
    assert body == b"GET, HEAD and OPTIONS are served\n"


def test_what_is_no_http_is_refused_and_the_server_goes_on(whole: Path) -> None:
    with serving(whole) as server:
        for line in (b"nonsense\r\n\r\n", b"GET /zarr.json HTTP/9.9\r\n\r\n", b"\x00\xff\r\n\r\n"):
            with socket.create_connection(server.server_address[:2], timeout=30) as raw:
                raw.sendall(line)
                raw.recv(10_000)
        with socket.create_connection(server.server_address[:2]) as raw:
            raw.sendall(b"GET /zarr.json HTTP/1.1\r\n")  # and away in the middle of a request
        assert asking(server)("/zarr.json")[0] == 200


@pytest.mark.usefixtures("apart")
def test_a_damaged_tile_is_a_failure_of_one_answer(damaged: Path) -> None:
    news: list[str] = []
    with serving(damaged, news.append) as server:
        ask = asking(server)
        status, headers, body = ask(CHUNK)
        assert (status, headers["Cache-Control"]) == (500, "no-store")
        assert body.count(b"\n") == 1
        assert b"damaged.fhz" in body
        assert "ETag" not in headers
        (line,) = news
        assert line.startswith("density/c/0/0/0/0: ")
        last = list(server.view.listing("density/c/"))[-1]
        assert ask(f"/{last}")[::2] == (200, server.view.get(last))
        assert ask("/zarr.json")[0] == 200


def test_a_defect_is_a_failure_of_one_answer(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    news: list[str] = []
    with serving(whole, news.append) as server:
        get = server.view.get

        def fail(key: str) -> bytes | None:
            if key.startswith("density/c"):
                raise KeyError("several\nlines")
            return get(key)

        monkeypatch.setattr(server.view, "get", fail)
        assert asking(server)(CHUNK)[0] == 500
        assert news == [f"{CHUNK[1:]}: unexpected KeyError: 'several\\nlines'"]
        assert asking(server)("/zarr.json")[0] == 200


def test_addresses(whole: Path) -> None:
    with serving(whole) as server:
        port = server.server_address[1]
        assert server.url == f"http://127.0.0.1:{port}/"
        assert server.is_local
        view = server.view
        with pytest.raises(InputError, match=rf"127\.0\.0\.1:{port} cannot be served.*--port"):
            Server(view, port=port)
        with pytest.raises(InputError, match="host 'no such host' is not known"):
            Server(view, host="no such host")
        with pytest.raises(InputError, match="cannot be served"):
            Server(view, host="192.0.2.1")
        with Server(view, host="0.0.0.0") as everywhere:
            assert not everywhere.is_local
