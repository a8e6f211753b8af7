"""The limit of open files of this process, which many systems set to 1024."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress

__all__ = ["many_files", "open_files"]

OTHERS = 64
"""Files that a process may open meanwhile beside those that are asked for."""


@contextmanager
def many_files(count: int) -> Iterator[None]:
    """Let the process open `count` files in the context, as far as the system allows it.

    A process may raise its own limit up to the hard one. Where that is not enough, or where there
    is no such limit (Windows), nothing else changes.
    """
    try:
        import resource
    except ImportError:
        yield
        return
    limit, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = count + OTHERS + open_files()
    if most != resource.RLIM_INFINITY:
        needed = min(needed, most)
    if limit == resource.RLIM_INFINITY or needed <= limit:
        yield
        return
    with suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (needed, most))
    try:
        yield
    finally:
        with suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (limit, most))


def open_files() -> int:
    """Number of files, sockets and pipes that this process has open; 0 where nothing tells."""
    try:
        return len(os.listdir("/dev/fd"))
    except OSError:
        return 0
