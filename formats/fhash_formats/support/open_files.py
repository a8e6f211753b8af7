"""The limit of open files of this process, which many systems set to 1024."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress

__all__ = ["many_files"]

OTHERS = 64
"""Files that a process has open beside those that it is about to open."""


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
    needed = count + OTHERS
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
