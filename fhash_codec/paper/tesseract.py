"""The tesseract encoding of one level: F-Hash bucket index and quadrilinear interpolation (paper, Multi-Resolution Tesseract Encoding)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from fhash_codec.paper.levels import Resolution


def bucket_index(corner: Tensor, resolution: Resolution) -> Tensor:
    """F-Hash: the bucket of grid corners (..., 4) in (t, z, y, x), int64 (...).

    The paper's linearisation ((t Rz + z) Ry + y) Rx + x: a bijection from the corners of a level to 0 .. Rt Rz Ry Rx - 1.
    """
    t, z, y, x = corner.unbind(-1)
    _, rz, ry, rx = resolution
    return ((t * rz + z) * ry + y) * rx + x


def locate(
    points: Tensor, sizes: Sequence[int], resolution: Resolution
) -> tuple[Tensor, Tensor, Tensor]:
    """The tesseract around each point (n, 4), given in vertices (t, z, y, x) of a lattice of `sizes`.

    Returns the corner before it, int64 (n, 4); the weight of the corner after it, in [0, 1], (n, 4); and the derivative of that
    weight by the point's position, (4,). Corners align: the first and last vertex of an axis are the first and last corner at every
    level. Positions outside the lattice are clamped to it. A position on a corner lies in the tesseract that begins there.
    """
    count = torch.tensor(resolution, device=points.device)
    span = torch.tensor(
        [max(size - 1, 1) for size in sizes], dtype=points.dtype, device=points.device
    )
    # Multiply before dividing: a vertex that falls on a corner then gives a whole number exactly.
    position = torch.minimum(points.clamp_min(0), span) * (count - 1) / span
    before = torch.minimum(position.floor().long(), (count - 2).clamp_min(0))
    return before, position - before, (count - 1) / span


def interpolate(
    table: Tensor, points: Tensor, sizes: Sequence[int], resolution: Resolution
) -> Tensor:
    """Embeddings (n, E) at points (n, 4) from a table (buckets, E): the 16 corners weighted linearly in x, y, z, then t."""
    before, weight, _ = locate(points, sizes, resolution)
    result = torch.zeros(len(points), table.shape[1], dtype=table.dtype, device=table.device)
    for corner, share in _corners(before, weight, resolution):
        result = result + share.prod(-1, keepdim=True) * table[corner]
    return result


def interpolate_with_jacobian(
    table: Tensor, points: Tensor, sizes: Sequence[int], resolution: Resolution
) -> tuple[Tensor, Tensor]:
    """Embeddings (n, E) and their derivatives (n, E, 4) by the position in vertices (t, z, y, x).

    On the border of two cells the derivative is that of the cell after it; at the end of an axis, of the last cell.
    """
    before, weight, slope = locate(points, sizes, resolution)
    value = torch.zeros(len(points), table.shape[1], dtype=table.dtype, device=table.device)
    jacobian = torch.zeros(*value.shape, 4, dtype=table.dtype, device=table.device)
    for number, (corner, share) in enumerate(_corners(before, weight, resolution)):
        embedding = table[corner]
        value += share.prod(-1, keepdim=True) * embedding
        for axis in range(4):
            others = torch.cat([share[:, :axis], share[:, axis + 1 :]], dim=1).prod(
                -1, keepdim=True
            )
            sign = 1.0 if number >> (3 - axis) & 1 else -1.0
            jacobian[:, :, axis] += sign * slope[axis] * others * embedding
    return value, jacobian


def _corners(before: Tensor, weight: Tensor, resolution: Resolution) -> list[tuple[Tensor, Tensor]]:
    """For each of the 16 corners (bits t, z, y, x from high to low): its bucket (n,) and its weight per axis (n, 4)."""
    last = torch.tensor(resolution, device=before.device) - 1
    corners = []
    for number in range(16):
        step = torch.tensor(
            [number >> 3 & 1, number >> 2 & 1, number >> 1 & 1, number & 1], device=before.device
        )
        # An axis of one corner has no corner after it; its weight there is 0, so that any bucket of the table will do.
        bucket = bucket_index(torch.minimum(before + step, last), resolution)
        corners.append((bucket, torch.where(step.bool(), weight, 1 - weight)))
    return corners
