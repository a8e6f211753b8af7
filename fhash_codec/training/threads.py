"""Number of threads that torch uses for training, and how these wait for each other.

Import this module before torch.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock

# Between two small operations OpenMP threads spin, by default for milliseconds. On a machine in
# shared use the spinning threads keep off the core the very threads they wait for: training runs 8
# times slower beside a second training. 10,000 rounds take some tens of microseconds, more than the
# pause between operations, so an idle machine stays as fast.
os.environ.setdefault("GOMP_SPINCOUNT", "10000")

VERTICES_A_THREAD = 12_000
"""Vertices of a training step per thread; with fewer, a further thread costs more than it saves."""


@contextmanager
def threads_for(vertices: int) -> Iterator[int]:
    """Limit torch's threads, while the context lasts, to those that pay for a training.

    The number never exceeds the number before. The context yields it.

    Args:
        vertices: vertices of a training step.
    """
    import torch

    before = torch.get_num_threads()
    threads = max(1, min(before, vertices // VERTICES_A_THREAD))
    torch.set_num_threads(threads)
    try:
        yield threads
    finally:
        torch.set_num_threads(before)


class _SingleThreadUsers:
    """Number of callers inside `one_thread`, and the torch threads before the first of them."""

    def __init__(self) -> None:
        self.lock = Lock()
        self.inside = 0
        self.threads_before = 1


_users = _SingleThreadUsers()


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch on one thread inside the context.

    Small batches gain little from a second thread, and wait for ever where another process holds
    its core. Contexts of several threads may overlap: torch's number of threads is partly a
    setting of the process, so the first context to begin saves it and the last to end restores it.
    """
    import torch

    with _users.lock:
        if not _users.inside:
            _users.threads_before = torch.get_num_threads()
        _users.inside += 1
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _users.lock:
            _users.inside -= 1
            if not _users.inside:
                torch.set_num_threads(_users.threads_before)
