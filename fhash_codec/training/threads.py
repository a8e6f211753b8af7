"""Number of threads that torch uses for training, and how these wait for each other.

Import this module before torch.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

# Between two small operations OpenMP threads spin, by default for milliseconds. On a machine in
# shared use the spinning threads keep off the core the very threads they wait for: training runs 8
# times slower beside a second training. 10,000 rounds take some tens of microseconds, more than the
# pause between operations, so an idle machine stays as fast.
os.environ.setdefault("GOMP_SPINCOUNT", "10000")

VERTICES_A_THREAD = 12_000
"""Vertices of a training step per thread; with fewer, a further thread costs more than it saves."""
_PROCESS = os.getpid()
"""The process that imported this module."""


def leave_threads_of_parent() -> None:
    """Let torch compute in one thread in a process forked since the import of this module.

    OpenMP believes there that it still has the threads of the parent, and waits for them for ever.
    """
    if os.getpid() != _PROCESS:
        import torch

        torch.set_num_threads(1)


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
