"""Levels of tables: the buckets that surround a point, and their weights.

A point is (t, z, y, x): t counts key frames, z, y and x count vertices of the box that a model
covers. The first and the last vertex of an axis are the first and the last corner of every level
(`align_corners=True` in torch's words).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import prod
from typing import Protocol

import torch
from torch import Tensor

from fhash_codec.paper.network import Resolution

PRIMES = (805459861, 2654435761, 1)
"""Factors of the corner's z, y and x in the spatial hash (Müller et al. 2022, equation 4)."""


class Level(Protocol):
    """One level of an encoding, for all key frames of a model."""

    @property
    def size(self) -> int:
        """Buckets of the level, over all key frames of the model."""

    def corners(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Buckets and weights of the corners around points.

        Args:
            points: float64 (n, 4). Those outside the box are clamped to it.

        Returns:
            Buckets int64 (n, corners) from 0 to size - 1, and their weights float64 (n, corners),
            whose sum is 1.
        """


@dataclass(frozen=True)
class GridLevel:
    """A dense grid, whose buckets are its corners: no collisions.

    Attributes:
        resolution: corners (t, z, y, x).
        sizes: key frames, and vertices (z, y, x) of the box.
        apart: whether each key frame has a grid of its own, so that nothing is interpolated in
            time; resolution[0] is the number of key frames then. Otherwise the level is one of
            F-Hash, with 16 corners around a point.
    """

    resolution: Resolution
    sizes: Resolution
    apart: bool

    @property
    def size(self) -> int:
        return prod(self.resolution)

    @property
    def strides(self) -> list[int]:
        """Buckets from one corner to the next along t, z, y and x."""
        return [prod(self.resolution[axis + 1 :]) for axis in range(4)]

    def buckets(self, corners: Tensor) -> Tensor:
        """Buckets int64 (n,) of corners (n, 4): equation 9 of the paper, one to one."""
        return (corners.long() * torch.tensor(self.strides, device=corners.device)).sum(1)

    def corners(self, points: Tensor) -> tuple[Tensor, Tensor]:
        before, after_weight = locate(points, self.sizes, self.resolution)
        first = 0
        base = torch.zeros(len(points), 1, dtype=torch.int64, device=points.device)
        if self.apart:
            first, base = 1, points[:, :1].round().long() * self.strides[0]
        buckets, weights = _along(before, after_weight, self.resolution, first, self.strides)
        return _joined(buckets, weights, base, torch.add)


@dataclass(frozen=True)
class HashLevel:
    """A grid whose corners share a table of fixed size by a spatial hash; collisions happen.

    Every level is hashed into a whole table, also one whose corners would fit: the paper's counts
    of parameters are levels * table size * 2 * key frames. A key frame has a table of its own.

    Attributes:
        corners_per_axis: corners along z, y and x.
        table: buckets of the table of a key frame, a power of two.
        sizes: key frames, and vertices (z, y, x) of the box.
    """

    corners_per_axis: int
    table: int
    sizes: Resolution

    @property
    def size(self) -> int:
        return self.sizes[0] * self.table

    def corners(self, points: Tensor) -> tuple[Tensor, Tensor]:
        n = self.corners_per_axis
        resolution = (self.sizes[0], n, n, n)
        before, after_weight = locate(points, self.sizes, resolution)
        buckets, weights = _along(before, after_weight, resolution, 1, (0, *PRIMES))
        none = torch.zeros(len(points), 1, dtype=torch.int64, device=points.device)
        hashed, joined = _joined(buckets, weights, none, torch.bitwise_xor)
        key = points[:, :1].round().long() * self.table
        return key + hashed % self.table, joined

    def collisions(self) -> float:
        """Share of the corners of one key frame whose bucket has another corner as well, 0 to 1."""
        axis = torch.arange(self.corners_per_axis)
        z, y, x = (axis * prime for prime in PRIMES)
        corners = z[:, None, None] ^ y[:, None] ^ x
        counts = torch.bincount((corners % self.table).reshape(-1), minlength=self.table)
        return float(counts[counts > 1].sum()) / corners.numel()


def locate(points: Tensor, sizes: Sequence[int], resolution: Resolution) -> tuple[Tensor, Tensor]:
    """Find the cell of a level around each point (paper, section 3.2.4, steps 1 and 2).

    Positions outside the lattice are clamped to it. A position on a corner lies in the cell that
    begins there.

    Args:
        points: positions (n, 4), (t, z, y, x) in vertices of the lattice of samples.
        sizes: vertices (t, z, y, x) of that lattice.
        resolution: vertices (t, z, y, x) of the level.

    Returns:
        The corner before each point, int64 (n, 4), and the weight in [0, 1] of the corner after it
        along each axis, (n, 4).
    """
    corners = torch.tensor(resolution, device=points.device)
    span = torch.tensor(
        [max(size - 1, 1) for size in sizes], dtype=points.dtype, device=points.device
    )
    # Multiply before dividing: a vertex that falls on a corner then gives a whole number exactly.
    position = torch.minimum(points.clamp_min(0), span) * (corners - 1) / span
    before = torch.minimum(position.floor().long(), (corners - 2).clamp_min(0))
    return before, position - before


def _along(
    before: Tensor,
    after_weight: Tensor,
    resolution: Sequence[int],
    first: int,
    factors: Sequence[int],
) -> tuple[list[Tensor], list[Tensor]]:
    """Corners and weights before and after points along each axis from `first` on, (n, 2) each.

    A corner is multiplied by its axis's factor. An axis of one corner has it twice.
    """
    buckets, weights = [], []
    for axis in range(first, 4):
        corner, weight = before[:, axis], after_weight[:, axis]
        after = (corner + 1).clamp_max(resolution[axis] - 1)
        buckets.append(torch.stack([corner, after], 1) * factors[axis])
        weights.append(torch.stack([1 - weight, weight], 1))
    return buckets, weights


def _joined(
    buckets: Sequence[Tensor],
    weights: Sequence[Tensor],
    base: Tensor,
    combine: Callable[[Tensor, Tensor], Tensor],
) -> tuple[Tensor, Tensor]:
    """All combinations of the corners of all axes, x changing fastest.

    Args:
        buckets: parts of the bucket along each axis, (n, 2) each.
        weights: weights along each axis, (n, 2) each.
        base: part of the bucket that all corners share, (n, 1).
        combine: joins two parts of a bucket.
    """
    index, weight = base, torch.ones_like(weights[0][:, :1])
    for part, along in zip(buckets, weights, strict=True):
        index = combine(index[:, :, None], part[:, None, :]).flatten(1)
        weight = (weight[:, :, None] * along[:, None, :]).flatten(1)
    return index, weight
