"""Work in threads, for what releases the interpreter's lock."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from itertools import count
from threading import Thread
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def usable_threads() -> int:
    """Processors that this process may use."""
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

    # Threads of their own for each call: a pool that outlived it would hang in a process that forked meanwhile.
    helpers = [Thread(target=every, name="fhash", daemon=True) for _ in range(min(usable_threads(), len(work)) - 1)]
    try:
        for helper in helpers:
            helper.start()
        for future in found:
            while not future.done() and one():
                pass
            yield future.result()
    finally:
        stopped = True
        for helper in helpers:
            if helper.ident is not None:
                helper.join()
