"""A local HTTP server of files in memory that gives ranges of them, counts and can fail."""

from __future__ import annotations

import hashlib
import re
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

__all__ = ["RangeServer"]


MADE = "Thu, 01 Jan 2026 00:00:00 GMT"


class RangeServer:
    """The server; a context manager.

    Attributes:
        files: content by name; a test may replace it.
        log: (method, Range header or None, status, bytes of the body) of each request.
        failures: statuses of the next requests, "drop" for a connection that is cut.
        ranges: whether it gives parts of files.
        conditions: whether it heeds If-Match.
        range_conditions: whether it heeds If-Range.
        own_tags: whether it takes its own tags for those of the file.
        validators: whether it names ETag and Last-Modified.
        sized: whether it says how large a file is.
        token: value of the header Authorization that it wants; None for none.
    """

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}
        self.log: list[tuple[str, str | None, int, int]] = []
        self.failures: list[int | str] = []
        self.ranges = self.conditions = self.range_conditions = True
        self.validators = self.sized = self.own_tags = True
        self.token: str | None = None
        self.lock = threading.Lock()
        self._http = _Server(("127.0.0.1", 0), _Handler)
        self._http.owner = self
        self._thread = threading.Thread(target=self._http.serve_forever, args=(0.02,), daemon=True)

    def put(self, name: str, data: bytes) -> str:
        """Serve a file; its URL."""
        self.files[name] = data
        return f"http://127.0.0.1:{self._http.server_address[1]}/{name}"

    def taken(self) -> tuple[int, int]:
        """Requests and bytes since the last call."""
        with self.lock:
            requests, size = len(self.log), sum(entry[3] for entry in self.log)
            self.log.clear()
        return requests, size

    def __enter__(self) -> RangeServer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        """Answer no more."""
        self._http.shutdown()
        self._http.server_close()
        self._thread.join()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    request_queue_size = 64
    owner: RangeServer

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of clients that hang up."""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: _Server

    def log_message(self, *_: object) -> None:
        """Say nothing."""

    def do_HEAD(self) -> None:
        self._answer(body=False)

    def do_GET(self) -> None:
        self._answer(body=True)

    def _answer(self, body: bool) -> None:
        owner = self.server.owner
        data = owner.files.get(self.path.lstrip("/").partition("?")[0])
        with owner.lock:
            failure = owner.failures.pop(0) if owner.failures else None
        if failure == "drop":
            self._note(0, 0)
            self.close_connection = True
            return
        if failure is not None:
            self._send(int(failure), b"", {}, body)
            return
        if owner.token is not None and self.headers.get("Authorization") != owner.token:
            self._send(401, b"", {}, body)
            return
        if data is None:
            self._send(404, b"", {}, body)
            return
        tag = f'"{hashlib.sha256(data).hexdigest()[:16]}"'
        headers = {"ETag": tag, "Last-Modified": MADE} if owner.validators else {}
        if owner.conditions and self.headers.get("If-Match", tag) != tag:
            self._send(412, b"", headers, body)
            return
        asked = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range") or "")
        same = not owner.range_conditions or (
            owner.own_tags and self.headers.get("If-Range", tag) == tag
        )
        if asked and owner.ranges and (same or "If-Range" not in self.headers):
            start, stop = int(asked[1]), min(int(asked[2]) + 1, len(data))
            if start >= len(data):
                self._send(416, b"", headers, body)
                return
            headers["Content-Range"] = f"bytes {start}-{stop - 1}/{len(data)}"
            self._send(206, data[start:stop], headers, body)
            return
        self._send(200, data, headers, body)

    def _note(self, status: int, size: int) -> None:
        owner = self.server.owner
        with owner.lock:
            owner.log.append((self.command, self.headers.get("Range"), status, size))

    def _send(self, status: int, data: bytes, headers: dict[str, str], body: bool) -> None:
        # Noted first, so that whoever has the answer finds it in the log.
        self._note(status, len(data) if body else 0)
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        if self.server.owner.sized or body:
            self.send_header("Content-Length", str(len(data)))
        else:
            self.send_header("Transfer-Encoding", "chunked")
        self.end_headers()
        if body:
            self.wfile.write(data)
