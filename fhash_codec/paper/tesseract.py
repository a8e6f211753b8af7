"""The tesseract encoding of one level: bucket index and interpolation (paper, section 3.2)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product

import torch
from torch import Tensor

from fhash_codec.paper.levels import Resolution


def bucket_index(corner: Tensor, resolution: Resolution) -> Tensor:
    """Return the F-Hash bucket int64 (...) of grid corners (..., 4) in (t, z, y, x).

    The index is ((t Rz + z) Ry + y) Rx + x, the linearisation of equation 9 of the paper. It maps
    the corners of a level one to one to 0 .. Rt Rz Ry Rx - 1: no collision, no empty bucket.
    """
    t, z, y, x = corner.unbind(-1)
    _, rz, ry, rx = resolution
    return ((t * rz + z) * ry + y) * rx + x


def locate(points: Tensor, sizes: Sequence[int], resolution: Resolution) -> tuple[Tensor, Tensor]:
    """Find the tesseract around each point (paper, section 3.2.4, steps 1 and 2).

    The first and the last vertex of an axis are the first and the last corner at every level.
    Positions outside the lattice are clamped to it. A position on a corner lies in the tesseract
    that begins there.

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


def interpolate(
    table: Tensor, points: Tensor, sizes: Sequence[int], resolution: Resolution
) -> Tensor:
    """Return the embeddings (n, E) at points, by quadrilinear interpolation between 16 corners.

    This is the sum of equations 10 to 12 of the paper, written as one product of four weights per
    corner (section 3.2.4, steps 3 and 4).

    Args:
        table: embeddings (buckets, E) of the level.
        points: positions (n, 4), as in `locate`.
        sizes: vertices (t, z, y, x) of the lattice of samples.
        resolution: vertices (t, z, y, x) of the level.
    """
    before, after_weight = locate(points, sizes, resolution)
    embeddings = torch.zeros(len(points), table.shape[1], dtype=table.dtype, device=table.device)
    for buckets, weights in _corners(before, after_weight, resolution):
        embeddings = embeddings + weights.prod(-1, keepdim=True) * table[buckets]
    return embeddings


def _corners(
    before: Tensor, after_weight: Tensor, resolution: Resolution
) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield for each of the 16 corners its bucket (n,) and its weight along each axis (n, 4).

    The corners come with the offset along x changing fastest, along t slowest.
    """
    last = torch.tensor(resolution, device=before.device) - 1
    for offsets in product((0, 1), repeat=4):
        offset = torch.tensor(offsets, device=before.device)
        # An axis of one corner has no corner after it. Its weight is 0, so any bucket will do.
        buckets = bucket_index(torch.minimum(before + offset, last), resolution)
        yield buckets, torch.where(offset.bool(), after_weight, 1 - after_weight)
