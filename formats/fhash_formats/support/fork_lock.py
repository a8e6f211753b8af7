"""A lock for what forked processes go on to use."""

from __future__ import annotations

import os
import threading
import weakref

__all__ = ["ForkLock"]


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


def _forked() -> None:
    for lock in _locks:
        lock._free()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forked)
