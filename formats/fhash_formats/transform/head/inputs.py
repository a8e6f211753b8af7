"""The inputs of the head."""

from __future__ import annotations

STEPS: tuple[tuple[int, int, int, int], ...] = (
    *((step, 0, 0, 0) for step in (-1, 1)),
    *((0, step, 0, 0) for step in (-1, 1)),
    *((0, 0, step, 0) for step in (-1, 1)),
    *((0, 0, 0, step) for step in (-1, 1)),
    *((0, step, 0, 0) for step in (-2, 2)),
    *((0, 0, step, 0) for step in (-2, 2)),
    *((0, 0, 0, step) for step in (-2, 2)),
    *((0, 0, first, second) for first in (-1, 1) for second in (-1, 1)),
    *((0, first, 0, second) for first in (-1, 1) for second in (-1, 1)),
    *((0, first, second, 0) for first in (-1, 1) for second in (-1, 1)),
)
"""Steps along (t, z, y, x) from a voxel to its 26 neighbours, in the order of the features."""


CROSS = ((0, 0, 0, 0), *STEPS[:8])
"""Steps to the nine voxels whose first-layer outputs a cross takes, in order: the voxel itself, then before and after along each axis."""


FEATURES = len(STEPS) + 2
"""Inputs of the network: one per neighbour, two functions of the voxel's own value."""
