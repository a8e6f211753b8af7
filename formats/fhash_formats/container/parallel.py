"""Work in threads, for what releases the interpreter's lock."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from itertools import count
from threading import Lock
from typing import TypeVar

from fhash_formats.errors import InputError

Item = TypeVar("Item")
Result = TypeVar("Result")

MOST_THREADS = 1024


def usable_threads() -> int:
    """Processors that this process may use, or N where the environment says `FHASH_THREADS=N`; it is read at each call.

    Raises InputError for what is not a number of threads.
    """
    given = os.environ.get("FHASH_THREADS")
    if given is not None:
        if not (given.isascii() and given.isdigit() and 1 <= int(given) <= MOST_THREADS):
            raise InputError(f"FHASH_THREADS is '{given:.40}'; allowed: 1 to {MOST_THREADS}")
        return int(given)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """`function` of each item, computed in as many threads as there are processors, in the order of the items.

    The caller's own thread is one of them. The first failure is raised; what was not begun then is left undone.
    """
    work = list(items)
    found: list[Future[Result]] = [Future() for _ in work]
    numbers = count()
    stopped = False

    def one() -> bool:
        """Do what is next, if there is any."""
        number = next(numbers)
        if stopped or number >= len(work):
            return False
        try:
            found[number].set_result(function(work[number]))
        except BaseException as error:
            found[number].set_exception(error)
        return True

    def every() -> None:
        while one():
            pass

    helpers: list[Future[None]] = []
    with suppress(
        RuntimeError
    ):  # where no more threads can be started, there are fewer: the caller's own is enough
        more = min(usable_threads(), len(work)) - 1
        for _ in range(more):
            helpers.append(_threads.pool(more).submit(every))
    try:
        for future in found:
            while not future.done() and one():
                pass
            yield future.result()
    finally:
        stopped = True
        for helper in helpers:
            # One that never began, because all of the pool is busy, has nothing left to do.
            if not helper.cancel():
                helper.result()


class _Threads:
    """Threads that wait for work: starting new ones for every call would take longer than small work itself."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._pool: ThreadPoolExecutor | None = None
        self._size = 0

    def pool(self, size: int) -> ThreadPoolExecutor:
        """A pool of at least so many threads."""
        with self._lock:
            if self._pool is None or self._size < size:
                if self._pool is not None:
                    self._pool.shutdown(wait=False)  # what it has begun it ends
                self._pool, self._size = ThreadPoolExecutor(size, thread_name_prefix="fhash"), size
            return self._pool


def _forked() -> None:
    """A forked process has none of its parent's threads, and their pool would hang there."""
    global _threads
    _threads = _Threads()


_threads = _Threads()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forked)
