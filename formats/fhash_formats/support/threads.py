"""Threads that share work, locks that survive a fork, and the slabs into which a box is cut."""

from __future__ import annotations

import os
import threading
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from itertools import count
from math import prod
from threading import Lock
from typing import TypeVar, cast

from fhash_formats.errors import InputError, RegionError


class ForkLock:
    """A lock for `with` that is free in a forked process.

    A plain lock stays taken there for ever if another thread held it, for that thread is only in
    the parent. The state that it guards must bear being left between two of its changes.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        _locks.add(self)

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def _free(self) -> None:
        self._lock = threading.Lock()


_locks: weakref.WeakSet[ForkLock] = weakref.WeakSet()


def _renew_locks() -> None:
    for lock in _locks:
        lock._free()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew_locks)


Item = TypeVar("Item")
Result = TypeVar("Result")

MAX_THREADS = 1024
"""Number that FHASH_THREADS may ask for."""
ITEMS_PER_THREAD = 8
"""Items of `share_out` for each thread; with fewer a further thread does not pay."""
SHARES_PER_THREAD = 4
"""Shares of `share_out` for each thread."""
PART = 1 << 19
"""Values of a part of `row_parts`, at least; with fewer a further thread does not pay."""

_most: ContextVar[int | None] = ContextVar("most threads", default=None)


def usable_threads(threads: int | None = None) -> int:
    """The number of threads to use: `threads`, else FHASH_THREADS, else the usable processors.

    The environment variable FHASH_THREADS is read at each call. Within `at_most` there are no more
    than it allows. Raises InputError for a number of threads that is not allowed.
    """
    if threads is not None:
        if threads < 1:
            raise InputError(f"threads is {threads}; at least 1 is needed")
        return threads
    most, setting = _most.get(), os.environ.get("FHASH_THREADS")
    if setting is None:
        number = _processors()
    elif setting.isascii() and setting.isdigit() and 1 <= int(setting) <= MAX_THREADS:
        number = int(setting)
    else:
        raise InputError(f"FHASH_THREADS is '{setting:.40}'; allowed: 1 to {MAX_THREADS}")
    return number if most is None else min(number, most)


def _processors() -> int:
    """The number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def at_most(threads: int) -> Iterator[None]:
    """Limit `usable_threads` in the context, for a job that shares its process with others.

    The limit is that of the caller's thread and of the pools that it makes (`thread_pool`).
    """
    token = _most.set(threads)
    try:
        yield
    finally:
        _most.reset(token)


def in_threads(
    function: Callable[[Item], Result], items: Iterable[Item], threads: int | None = None
) -> Iterator[Result]:
    """Yield `function(item)` for each item, in the order of the items.

    Up to `threads` threads compute at once (default: `usable_threads()`); the caller's own thread
    is one of them. The first failure is raised, and items not begun by then are left out. Nothing
    is computed before the first result is asked for.
    """
    work, arguments = [function], list(items)
    results: list[Future[Result]] = [Future() for _ in arguments]
    numbers = count()
    stopped = False

    def compute_next() -> bool:
        """Compute the next item; False where none is left."""
        number = next(numbers)  # atomic, since several threads call this
        if stopped or number >= len(arguments):
            return False
        try:
            results[number].set_result(work[0](arguments[number]))
        except BaseException as error:
            results[number].set_exception(error)
        return True

    def compute_all() -> None:
        while compute_next():
            pass

    helpers: list[Future[None]] = []
    # RuntimeError: no more threads can be started. Those that run are enough.
    with suppress(RuntimeError):
        more = min(usable_threads() if threads is None else threads, len(arguments)) - 1
        for _ in range(more):
            helpers.append(_threads.pool(more).submit(compute_all))
    taken: Future[Result] = Future()
    try:
        for place, future in enumerate(results):
            while not future.done() and compute_next():
                pass
            result, results[place] = future.result(), taken
            future = taken  # so that nothing here holds what was yielded
            yield result
            del result
    finally:
        stopped = True
        for helper in helpers:
            # A helper that never began, because the pool is busy, has nothing left to do.
            if not helper.cancel():
                helper.result()
        # The pool holds such a helper until it is free, and would hold all of this with it.
        work.clear()
        arguments.clear()
        results.clear()


def share_out(work: Callable[[Sequence[Item]], None], items: Sequence[Item], threads: int) -> None:
    """Call `work` on shares of `items`, in up to `threads` threads.

    There are several shares for each thread, since the processors of a machine are rarely equally
    free. Few items are one share, in the caller's thread.
    """
    workers = min(threads, len(items) // ITEMS_PER_THREAD)
    if workers <= 1:
        work(items)
        return
    shares = min(SHARES_PER_THREAD * workers, len(items))
    for _ in in_threads(work, [items[share::shares] for share in range(shares)], workers):
        pass


def row_parts(rows: int, row: int, threads: int) -> list[tuple[int, int]]:
    """Parts (first, end) of `rows` rows of `row` values each, one for each thread that pays."""
    count = max(1, min(threads, rows, rows * row // PART))
    return [(rows * part // count, rows * (part + 1) // count) for part in range(count)]


def thread_pool() -> ThreadPoolExecutor:
    """Create a pool of one thread per usable processor, for work that releases the GIL.

    The limit of `at_most` holds in its threads, too.
    """
    return ThreadPoolExecutor(
        usable_threads(),
        thread_name_prefix="fhash-tile",
        initializer=_most.set,
        initargs=(_most.get(),),
    )


def map_ahead(
    pool: ThreadPoolExecutor,
    function: Callable[[Item], Result],
    items: Iterable[Item],
    max_ahead: int,
) -> Iterator[Result]:
    """Yield `function(item)` for each item, in the order of the items.

    The caller's thread reads the items, and at most `max_ahead` of them before their results are
    yielded, so that memory stays bounded. Items that no thread has begun are left out if the
    iteration ends early.
    """
    waiting: deque[Future[Result]] = deque()
    try:
        for item in items:
            waiting.append(pool.submit(function, item))
            if len(waiting) >= max_ahead:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        for future in waiting:
            future.cancel()


def one_ahead(items: Iterator[Item]) -> Iterator[Item]:
    """Yield the items, the next of which is made in another thread meanwhile."""
    with thread_pool() as pool:
        end = object()
        waiting = pool.submit(next, items, end)
        while (item := waiting.result()) is not end:
            waiting = pool.submit(next, items, end)
            yield cast(Item, item)
            del item  # its memory is free before the one after the next is made


class _Threads:
    """A pool of threads that wait for work.

    Starting new threads for every call would take longer than small work itself.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._pool: ThreadPoolExecutor | None = None
        self._size = 0

    def pool(self, size: int) -> ThreadPoolExecutor:
        """A pool of at least `size` threads."""
        with self._lock:
            if self._pool is None or self._size < size:
                if self._pool is not None:
                    self._pool.shutdown(wait=False)  # work that it has accepted still ends
                self._pool, self._size = ThreadPoolExecutor(size, thread_name_prefix="fhash"), size
            return self._pool


def _forked() -> None:
    """Forget the pool in a forked process, which has none of its parent's threads."""
    global _threads
    _threads = _Threads()


_threads = _Threads()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forked)


def slab_shape(shape: Sequence[int], itemsize: int, limit: int) -> tuple[int, ...]:
    """The shape of chunks with at most `limit` bytes, but at least one value.

    An array within the limit is one chunk. A larger one is cut into slabs of equal thickness.
    Leading axes are cut first, down to single positions before the next axis is cut.

    Args:
        shape: of the array.
        itemsize: bytes of a value.
        limit: bytes of a chunk.
    """
    chunk = list(shape)
    for axis, length in enumerate(shape):
        layer_bytes = itemsize * prod(chunk[:axis] + chunk[axis + 1 :])
        slabs = -(-length // max(1, limit // max(1, layer_bytes)))
        chunk[axis] = -(-length // max(1, slabs))
    return tuple(chunk)


def chunk_region(
    index: Sequence[int], chunk: Sequence[int], shape: Sequence[int]
) -> tuple[slice, ...]:
    """The region of an array that a chunk covers, cut at the array's end.

    Args:
        index: place of the chunk in the grid of chunks.
        chunk: shape of a full chunk.
        shape: of the array.
    """
    spans = zip(index, chunk, shape, strict=True)
    return tuple(slice(i * n, min((i + 1) * n, length)) for i, n, length in spans)


def common_part(
    index: Sequence[int], chunk: Sequence[int], bounds: Sequence[tuple[int, int]]
) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """The part that a region shares with a chunk: its slices in the region, and in the chunk.

    Args:
        index: place of the chunk in the grid of chunks.
        chunk: shape of a full chunk.
        bounds: first vertex and end of the region along each axis; the region and the chunk meet.
    """
    in_region, in_chunk = [], []
    for i, n, (start, stop) in zip(index, chunk, bounds, strict=True):
        low, high = max(start, i * n), min(stop, (i + 1) * n)
        in_region.append(slice(low - start, high - start))
        in_chunk.append(slice(low - i * n, high - i * n))
    return tuple(in_region), tuple(in_chunk)


def region_bounds(
    region: Sequence[slice], shape: Sequence[int], what: str
) -> list[tuple[int, int]]:
    """First vertex and end along each axis of a region of slices.

    what: the array, for messages. Raises RegionError for a region that is not in the shape.
    """
    if len(region) != len(shape):
        raise RegionError(f"{what}: a region of {len(region)} axes; the array has {len(shape)}")
    bounds = []
    for axis, (span, length) in enumerate(zip(region, shape, strict=True)):
        start = 0 if span.start is None else int(span.start)
        stop = length if span.stop is None else int(span.stop)
        if span.step not in (None, 1) or not 0 <= start <= stop <= length:
            raise RegionError(
                f"{what}: {span} on axis {axis}; slices without step within 0..{length} are allowed"
            )
        bounds.append((start, stop))
    return bounds
