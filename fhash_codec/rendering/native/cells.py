"""In which cells of a frame something can be seen, where that is in few: finer than bricks, and only within those that matter."""

from __future__ import annotations

import ctypes

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.task.bricks import ROUNDING, Bricks
from fhash_codec.rendering.task.task import Task
from fhash_formats.support.threads import in_threads

__all__ = ["cells_of", "limits_of"]

Single = npt.NDArray[np.float32]
Numbers = npt.NDArray[np.int64]

PROBED = 64
"""Bricks by which it is guessed how many cells matter."""
MAX_SEEN = 0.5
"""Of the cells of those bricks, at most: of more, looking for them takes longer than samples in them."""
MAX_LIMITS = 16
"""Intervals of visible values."""
GROUP = 1024
"""Bricks that a thread takes at a time."""


def limits_of(bricks: Bricks, task: Task) -> Single:
    """Between which values something can be seen: float32 (n, 2), ascending, without their ends."""
    found: list[tuple[float, float]] = []
    if task.table is not None:
        table = task.table
        last = len(table.extinctions) - 1
        entries = np.linspace(table.low, table.high, last + 1)
        steps = np.flatnonzero(
            np.diff(np.concatenate([[0], table.extinctions > 0, [0]]).astype(np.int8))
        )
        for first, stop in steps.reshape(-1, 2):
            found.append(
                (
                    entries[first - 1] if first else -np.inf,
                    entries[stop] if stop <= last else np.inf,
                )
            )
    slack = ROUNDING * max(abs(limit) for limit in bricks.value_range)
    found += [(surface.value - slack, surface.value + slack) for surface in task.surfaces]
    joined: list[tuple[float, float]] = []
    for low, high in sorted(found):
        if joined and low <= joined[-1][1]:
            low, high = joined[-1][0], max(high, joined.pop()[1])
        joined.append((low, high))
    limits = np.array(joined, dtype=np.float64).reshape(-1, 2)
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


def cells_of(
    library: ctypes.CDLL, bricks: Bricks, task: Task, distance: npt.NDArray[np.int32]
) -> npt.NDArray[np.uint32] | None:
    """A bit for each of the cells of each brick: uint32 (z, y, x, 2), low half first; None where in most of them something can be seen.

    distance: of the bricks, as `Bricks.distance` has it: those of 0 are looked into.
    """
    limits = limits_of(bricks, task)
    numbers = np.flatnonzero(distance == 0).astype(np.int64)
    if len(limits) > MAX_LIMITS or not len(numbers):
        return None
    cells = np.zeros((*distance.shape, 2), dtype=np.uint32)
    shape, counts = (
        (ctypes.c_int64 * 3)(*bricks.values.shape),
        (ctypes.c_int64 * 3)(*distance.shape),
    )

    def look(chosen: Numbers, first: int, stop: int) -> int:
        return int(
            library.fhash_march_cells(
                ctypes.c_void_p(bricks.values.ctypes.data),
                shape,
                counts,
                ctypes.c_void_p(limits.ctypes.data),
                ctypes.c_int64(len(limits)),
                ctypes.c_void_p(chosen.ctypes.data),
                ctypes.c_int64(first),
                ctypes.c_int64(stop),
                ctypes.c_void_p(cells.ctypes.data),
            )
        )

    probed = np.ascontiguousarray(numbers[:: -(-len(numbers) // PROBED)])
    if look(probed, 0, len(probed)) > MAX_SEEN * 64 * len(probed):
        return None
    spans = [(first, min(first + GROUP, len(numbers))) for first in range(0, len(numbers), GROUP)]
    list(in_threads(lambda span: look(numbers, *span), spans))
    return cells
