"""What small bricks of a frame hold, so that a ray passes over those of which nothing can be seen.

A brick is SIDE cells along each axis, with the vertices on all its faces: neighbours share those between them.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fhash_codec import native
from fhash_codec.rendering.task.palette import Palette
from fhash_codec.rendering.task.task import Frame, Task
from fhash_formats.support.threads import in_threads

__all__ = ["SIDE", "Bricks"]

Single = npt.NDArray[np.float32]

SIDE = 4
"""Cells: with twice as many a narrow interval takes up to twice the samples."""
FARTHEST = 255
"""Bricks that a ray passes over at once, at most."""
ROUNDING = 2.0**-22
"""Of the largest magnitude: how far an interpolated float32 may lie beyond the values it is from."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Bricks:
    """The smallest and largest values of a frame's bricks, for every picture of that frame.

    Attributes:
        values: float32 (z, y, x), contiguous, those of the frame with NaN for what is infinite.
        low, high: float32 (z, y, x) of bricks; infinity and minus infinity where a brick has no value.
    """

    values: Single
    low: Single
    high: Single

    @classmethod
    def of(cls, frame: Frame) -> Bricks:
        """From a frame's values, in a time that is short beside that of a picture."""
        values = np.ascontiguousarray(frame.values, dtype=np.float32)
        low, high = _extremes(values)
        if np.isneginf(low).any() or np.isposinf(high).any():
            values = np.where(np.isfinite(values), values, np.float32(np.nan))
            low, high = _extremes(values)
        return cls(values=values, low=low, high=high)

    @property
    def value_range(self) -> tuple[float, float]:
        """The smallest and the largest value; (0, 0) where there is none."""
        low, high = float(self.low.min()), float(self.high.max())
        return (low, high) if low <= high else (0.0, 0.0)

    def matters(self, task: Task) -> npt.NDArray[np.bool_]:
        """Whether anything of a brick (z, y, x) can be seen: a value with extinction, or one of a surface."""
        low, high = self.low.astype(np.float64), self.high.astype(np.float64)
        known = low <= high
        low, high = np.where(known, low, 0.0), np.where(known, high, 0.0)
        slack = ROUNDING * max(float(np.abs(low).max()), float(np.abs(high).max()))
        found = np.zeros(low.shape, dtype=bool)
        if task.table is not None:
            found |= np.asarray(Palette.of(task.table).visible(low, high))
        for surface in task.surfaces:
            found |= (low - slack <= surface.value) & (surface.value <= high + slack)
        return found & known

    def distance(self, task: Task) -> npt.NDArray[np.int32]:
        """How many bricks away, diagonals counted as one, the nearest is that matters: int32 (z, y, x), 0..FARTHEST."""
        matters = self.matters(task)
        distance = np.where(matters, 0, FARTHEST).astype(np.int32)
        if not matters.any():
            return distance
        library = native.library()
        if library is not None:
            library.fhash_march_distance(
                (ctypes.c_int64 * 3)(*distance.shape), ctypes.c_void_p(distance.ctypes.data)
            )
            return distance
        near = matters
        for step in range(1, min(max(distance.shape), FARTHEST)):
            near = _spread(near)
            distance[near & (distance == FARTHEST)] = step
        return distance


def _extremes(values: Single) -> tuple[Single, Single]:
    bricks = [max(-(-(size - 1) // SIDE), 1) for size in values.shape]
    low, high = np.empty(bricks, dtype=np.float32), np.empty(bricks, dtype=np.float32)
    library = native.library()
    if library is None:
        low[...] = _reduced(np.where(np.isnan(values), np.float32(np.inf), values), np.minimum)
        high[...] = _reduced(np.where(np.isnan(values), np.float32(-np.inf), values), np.maximum)
        return low, high
    shape, counts = (ctypes.c_int64 * 3)(*values.shape), (ctypes.c_int64 * 3)(*bricks)

    def layer(number: int) -> None:
        scratch = np.empty(2 * values.shape[2], dtype=np.float32)
        library.fhash_march_bricks(
            ctypes.c_void_p(values.ctypes.data),
            shape,
            counts,
            ctypes.c_int64(SIDE),
            ctypes.c_int64(number),
            ctypes.c_int64(number + 1),
            ctypes.c_void_p(low.ctypes.data),
            ctypes.c_void_p(high.ctypes.data),
            ctypes.c_void_p(scratch.ctypes.data),
        )

    if values.size < 2**18:
        for number in range(bricks[0]):
            layer(number)
    else:
        list(in_threads(layer, range(bricks[0])))
    return low, high


def _reduced(values: Single, ufunc: np.ufunc) -> Single:
    """The ufunc over each brick, axis by axis."""
    for axis, size in enumerate(values.shape):
        starts = np.arange(0, max(size - 1, 1), SIDE)
        within = ufunc.reduceat(values, starts, axis=axis)
        faces = np.take(values, np.minimum(starts + SIDE, size - 1), axis=axis)
        values = ufunc(within, faces)
    return values


def _spread(mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """A mask, and the neighbours of what it has, diagonals too."""
    for axis in range(mask.ndim):
        wide = mask.copy()
        head, tail = [slice(None)] * mask.ndim, [slice(None)] * mask.ndim
        head[axis], tail[axis] = slice(None, -1), slice(1, None)
        wide[tuple(head)] |= mask[tuple(tail)]
        wide[tuple(tail)] |= mask[tuple(head)]
        mask = wide
    return mask
