"""How many threads torch uses for training, and how they wait for each other. Import this before torch."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock

# Between two small operations OpenMP threads spin, by default for milliseconds; on a machine that others use too, the threads that
# spin keep those from running that are waited for (8 times slower beside a second training). 10,000 rounds are some tens of
# microseconds, more than the pause between operations: on an idle machine the speed stays the same.
os.environ.setdefault("GOMP_SPINCOUNT", "10000")

VERTICES_A_THREAD = (
    12_000  # of a training step; with fewer, a further thread costs more than it brings
)


@contextmanager
def threads_for(vertices: int) -> Iterator[int]:
    """Within it torch uses as many threads as pay for training steps of so many vertices, and no more than before; their number."""
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
