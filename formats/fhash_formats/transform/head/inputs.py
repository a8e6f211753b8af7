"""The inputs of the head's network: the neighbours of a voxel, and functions of its own value."""

from __future__ import annotations

OFFSETS: tuple[tuple[int, int, int, int], ...] = (
    *((offset, 0, 0, 0) for offset in (-1, 1)),
    *((0, offset, 0, 0) for offset in (-1, 1)),
    *((0, 0, offset, 0) for offset in (-1, 1)),
    *((0, 0, 0, offset) for offset in (-1, 1)),
    *((0, offset, 0, 0) for offset in (-2, 2)),
    *((0, 0, offset, 0) for offset in (-2, 2)),
    *((0, 0, 0, offset) for offset in (-2, 2)),
    *((0, 0, first, second) for first in (-1, 1) for second in (-1, 1)),
    *((0, first, 0, second) for first in (-1, 1) for second in (-1, 1)),
    *((0, first, second, 0) for first in (-1, 1) for second in (-1, 1)),
)
"""Offsets along (t, z, y, x) from a voxel to its 26 neighbours, in the order of the inputs."""


CROSS = ((0, 0, 0, 0), *OFFSETS[:8])
"""Offsets to the nine voxels of a cross, in order.

They are the voxel itself, then the ones before and after it along each axis.
"""


INPUTS = len(OFFSETS) + 2
"""Number of inputs: one per neighbour, and two functions of the voxel's own value."""
