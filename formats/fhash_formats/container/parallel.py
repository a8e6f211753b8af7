"""Work in threads, for what releases the interpreter's lock."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def usable_threads() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """`function` of each item, computed in as many threads as there are processors, in the order of the items.

    The first failure is raised; what was not begun then is left undone.
    """
    # A pool of its own for each call: one that outlived it would hang in a process that forked meanwhile.
    pool = ThreadPoolExecutor(usable_threads(), thread_name_prefix="fhash")
    try:
        for future in [pool.submit(function, item) for item in items]:
            yield future.result()
    finally:
        pool.shutdown(cancel_futures=True)
