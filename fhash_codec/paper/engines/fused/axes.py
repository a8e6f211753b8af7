"""The tables along each axis that the kernels interpolate by, and those of Adam's missed steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.engines.upsampling import axis_matrices
from fhash_codec.training.adam import BETA1, BETA2, WINDOW


@dataclass(frozen=True, kw_only=True)
class AxisTables:
    """The sub-lattices along an axis, for each coordinate of a brick and each coarse level.

    Attributes:
        corners: corners of a sub-lattice of each level.
        start: first corner of each sub-lattice, int32 (coordinates, levels).
        before: corner of the sub-lattice at or before each vertex, int32 (coordinates, levels,
            vertices).
        after: weight of the corner after that one, float32 of the same shape.
    """

    corners: tuple[int, ...]
    start: npt.NDArray[np.int32]
    before: npt.NDArray[np.int32]
    after: npt.NDArray[np.float32]


def axis_tables(architecture: Architecture, coreset: Coreset) -> list[AxisTables]:
    """Return the tables of the axes t, z, y and x. A key frame is a run of one vertex along t."""
    lengths, counts = (1, *coreset.brick_shape), (architecture.key_frames, *coreset.brick_grid)
    return [
        _axis_tables(size, [level[axis] for level in architecture.levels[1:]], length, count)
        for axis, (size, length, count) in enumerate(
            zip(architecture.sizes, lengths, counts, strict=True)
        )
    ]


def _axis_tables(size: int, resolutions: list[int], length: int, count: int) -> AxisTables:
    """Return the tables of one axis; arguments as in `upsampling.axis_matrices`."""
    corners = []
    start = np.empty((count, len(resolutions)), np.int32)
    before = np.empty((count, len(resolutions), length), np.int32)
    after = np.zeros((count, len(resolutions), length), np.float32)
    for level, resolution in enumerate(resolutions):
        start[:, level], weights = axis_matrices(size, resolution, length, count)
        corners.append(weights.shape[2])
        first = (weights != 0).argmax(axis=2)
        second = np.minimum(first + 1, weights.shape[2] - 1)
        weight = np.take_along_axis(weights, second[..., None], axis=2)[..., 0]
        before[:, level] = first
        after[:, level] = np.where(second > first, weight, 0.0)
    return AxisTables(corners=tuple(corners), start=start, before=before, after=after)


def missed_step_tables(
    rates: npt.NDArray[np.float64],
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Return the two tables by which a kernel sums what `training.adam.catch_up` sums.

    A step i after the last one with a gradient, step j in all, moves a number by
    r^i rate_j c_j m / (sqrt(v) + eps ...), as said there; the sum for eps has b1^i rate_j / (1 -
    b1^j) in place of r^i rate_j c_j.

    Args:
        rates: learning rate of every step, counted from 1.

    Returns:
        r^i and b1^i (WINDOW + 1, 2), and the factors of the steps j (steps, 2), both float32.
    """
    i, j = np.arange(WINDOW + 1)[:, None], np.arange(1, len(rates))
    powers = np.array([BETA1 / BETA2**0.5, BETA1]) ** i
    weights = np.zeros((len(rates), 2))
    weights[1:, 1] = rates[1:] / -np.expm1(j * np.log(BETA1))
    weights[1:, 0] = weights[1:, 1] * np.sqrt(-np.expm1(j * np.log(BETA2)))
    return powers.astype(np.float32), weights.astype(np.float32)
