"""How many threads torch uses for training, and how they wait for each other. Import this before torch."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

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
