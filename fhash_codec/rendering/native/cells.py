"""The visible cells of a frame, where they are few.

Cells are finer than bricks and are looked at only within bricks that matter.
"""

from __future__ import annotations

import ctypes

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.task.bricks import ROUNDING, SIDE, Bricks
from fhash_codec.rendering.task.task import Table, Task
from fhash_formats.support.threads import in_threads

__all__ = ["cells_of", "limits_of"]

Single = npt.NDArray[np.float32]
Numbers = npt.NDArray[np.int64]
Interval = tuple[float, float]

PROBED = 64
"""Bricks from which the share of visible cells is estimated."""
MAX_SEEN = 0.5
"""Largest share of visible cells in the probed bricks; above it the search for them takes longer
than samples in all cells.
"""
MAX_LIMITS = 16
"""Intervals of visible values, at most."""
GROUP = 1024
"""Bricks that a thread takes at a time."""


def limits_of(bricks: Bricks, task: Task) -> Single:
    """Intervals of the values that are visible: float32 (n, 2), ascending, without their ends."""
    slack = ROUNDING * max(abs(limit) for limit in bricks.value_range)
    intervals = [] if task.table is None else _opaque(task.table)
    intervals += [(surface.value - slack, surface.value + slack) for surface in task.surfaces]
    limits = np.array(_joined(intervals), dtype=np.float64).reshape(-1, 2)
    with np.errstate(over="ignore"):  # a surface beyond float32 lies at infinity, where no value is
        near = limits.astype(np.float32)
        # Outwards where float32 does not have them.
        below = np.where(
            near[:, 0] > limits[:, 0], np.nextafter(near[:, 0], np.float32(-np.inf)), near[:, 0]
        )
        above = np.where(
            near[:, 1] < limits[:, 1], np.nextafter(near[:, 1], np.float32(np.inf)), near[:, 1]
        )
    return np.stack([below, above], axis=-1)


def _opaque(table: Table) -> list[Interval]:
    """Intervals of the values to which a table gives an extinction."""
    last = len(table.extinctions) - 1
    entries = np.linspace(table.low, table.high, last + 1)
    changes = np.flatnonzero(
        np.diff(np.concatenate([[0], table.extinctions > 0, [0]]).astype(np.int8))
    )
    return [
        (entries[first - 1] if first else -np.inf, entries[stop] if stop <= last else np.inf)
        for first, stop in changes.reshape(-1, 2)
    ]


def _joined(intervals: list[Interval]) -> list[Interval]:
    """Intervals in ascending order, overlapping ones made one."""
    joined: list[Interval] = []
    for low, high in sorted(intervals):
        if joined and low <= joined[-1][1]:
            low, high = joined[-1][0], max(high, joined.pop()[1])
        joined.append((low, high))
    return joined


def cells_of(
    library: ctypes.CDLL, bricks: Bricks, task: Task, distance: npt.NDArray[np.int32]
) -> npt.NDArray[np.uint32] | None:
    """A bit for each cell of each brick, set where the cell is visible.

    distance: of the bricks, as `Bricks.distance` has it; bricks of distance 0 are looked into.
    The result is uint32 (z, y, x, 2), the lower half first, or None where most cells are visible.
    """
    limits = limits_of(bricks, task)
    chosen = np.flatnonzero(distance == 0).astype(np.int64)
    if len(limits) > MAX_LIMITS or not len(chosen):
        return None
    cells = np.zeros((*distance.shape, 2), dtype=np.uint32)
    shape = (ctypes.c_int64 * 3)(*bricks.values.shape)
    counts = (ctypes.c_int64 * 3)(*distance.shape)

    def look(numbers: Numbers, first: int, stop: int) -> int:
        """Set the bits of bricks by their numbers; how many bits are set."""
        return int(
            library.fhash_march_cells(
                bricks.values.ctypes.data,
                shape,
                counts,
                limits.ctypes.data,
                len(limits),
                numbers.ctypes.data,
                first,
                stop,
                cells.ctypes.data,
            )
        )

    probed = np.ascontiguousarray(chosen[:: -(-len(chosen) // PROBED)])
    if look(probed, 0, len(probed)) > MAX_SEEN * SIDE**3 * len(probed):
        return None
    spans = [(first, min(first + GROUP, len(chosen))) for first in range(0, len(chosen), GROUP)]
    list(in_threads(lambda span: look(chosen, *span), spans))
    return cells
