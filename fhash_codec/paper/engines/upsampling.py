"""Interpolation of the coarse levels at the vertices of whole bricks: separable products of small matrices, and their transpose.

A brick needs a small sub-lattice of each coarse table. Where that begins and the matrices that interpolate from it depend only on the
brick's coordinates, axis by axis, so both are made once per coordinate and looked up. Time is one more factor of the product along z.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import prod

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.architecture import Architecture

BRICKS_AT_A_TIME = 1024


class Upsampling:
    """What all bricks of a coreset share.

    Attributes:
        used: positions, ascending, of the numbers of the coarse tables that some brick needs; the tables lie level by level in a flat
            vector. Training holds only these: around a sparse feature most of the coarse tables is out of reach.
    """

    used: Tensor

    def __init__(self, architecture: Architecture, coreset: Coreset, device: torch.device) -> None:
        """Tables by brick coordinate: (key frame, z) together, y, and x."""
        lengths, counts = (1, *coreset.brick_shape), (architecture.key_frames, *coreset.brick_grid)
        self.size, self.layers = architecture.embedding_size, coreset.brick_grid[0]
        numbers = 0
        starts, matrices, offsets, self.shapes = [], [], [], []
        for level in architecture.levels[1:]:
            axes = [
                axis_matrices(s, r, n, c)
                for s, r, n, c in zip(architecture.sizes, level, lengths, counts, strict=True)
            ]
            stride = [prod(level[axis + 1 :]) * self.size for axis in range(4)]
            (start_t, wt), (start_z, wz), (start_y, wy), (start_x, wx) = axes
            start_tz = (start_t[:, None] * stride[0] + start_z * stride[1]).reshape(-1) + numbers
            # (key frames, coordinates z, vertices z, corners t, corners z)
            wtz = wt[:, None, :, :, None] * wz[None, :, :, None, :]
            starts.append([start_tz, start_y * stride[2], start_x * stride[3]])
            matrices.append(
                [wtz.reshape(len(start_tz), -1), wy.reshape(len(wy), -1), wx.reshape(len(wx), -1)]
            )
            self.shapes.append(
                [(wz.shape[1], wt.shape[2] * wz.shape[2]), wy.shape[1:], wx.shape[1:]]
            )
            corners = [np.arange(w.shape[2]) * s for (_, w), s in zip(axes, stride, strict=True)]
            t, z, x, y, e = np.ix_(
                corners[0], corners[1], corners[3], corners[2], np.arange(self.size)
            )
            offsets.append((t + z + x + y + e).reshape(-1))
            numbers += prod(level) * self.size
        join = [
            np.concatenate(parts, axis=1) if parts else np.zeros((1, 0))
            for parts in zip(*matrices, strict=True)
        ]
        self.starts = [
            torch.from_numpy(np.stack(parts, axis=1)).to(device)
            for parts in zip(*starts, strict=True)
        ]
        self.matrices = [torch.from_numpy(part.astype(np.float32)).to(device) for part in join]
        self.counts = [len(offset) for offset in offsets]
        self.offset = torch.from_numpy(np.concatenate([*offsets, np.zeros(0, dtype=np.int64)])).to(
            device
        )
        self.level = torch.from_numpy(np.repeat(np.arange(len(offsets)), self.counts)).to(device)
        reached = torch.zeros(numbers, dtype=torch.bool, device=device)
        for part in torch.split(
            torch.from_numpy(coreset.bricks.astype(np.int64)).to(device), BRICKS_AT_A_TIME
        ):
            reached[self._positions(self._coordinates(part))] = True
        self.used = reached.nonzero().squeeze(1)
        self.rank = (reached.cumsum(0, dtype=torch.int32) - 1) if len(self.used) < numbers else None

    def _coordinates(self, bricks: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        t, z, y, x = bricks.unbind(1)
        return t * self.layers + z, y, x

    def _positions(self, coordinates: tuple[Tensor, ...]) -> Tensor:
        """Where the sub-lattices of bricks lie in the flat tables (bricks, numbers)."""
        if not self.shapes:
            return self.offset.expand(len(coordinates[0]), 0)
        base = sum(
            (start[c] for start, c in zip(self.starts, coordinates, strict=True)),
            torch.zeros((), dtype=torch.int64),
        )
        return base[:, self.level] + self.offset

    def lattices(self, bricks: Tensor) -> Lattices:
        """The sub-lattices and matrices of bricks (n, 4), coordinates (key frame, z, y, x) int64."""
        coordinates = self._coordinates(bricks)
        index = self._positions(coordinates)
        if self.rank is not None:
            index = self.rank[index].long()
        if not self.shapes:
            return Lattices(index=index, counts=[], matrices=[], size=self.size)
        rows = [
            torch.split(matrices[c], [prod(shape[axis]) for shape in self.shapes], dim=1)
            for axis, (matrices, c) in enumerate(zip(self.matrices, coordinates, strict=True))
        ]
        levels = [
            tuple(row[n].view(-1, *shape[axis]) for axis, row in enumerate(rows))
            for n, shape in enumerate(self.shapes)
        ]
        return Lattices(index=index, counts=self.counts, matrices=levels, size=self.size)


@dataclass(frozen=True, kw_only=True)
class Lattices:
    """The parts of the coarse tables that some bricks need.

    index: positions (bricks, numbers) among the used numbers of the flat tables; counts: numbers of each level, in the order
        (corners t z x y, E): in this order each axis is one batched product, without a copy in between.
    matrices: per level those of (t, z), y and x, each (bricks, vertices, corners).
    """

    index: Tensor
    counts: list[int]
    matrices: list[tuple[Tensor, ...]]
    size: int

    def interpolate(self, flat: Tensor, out: Tensor) -> None:
        """Write the embeddings (levels, E, bricks, z, y, x) at all vertices of the bricks into `out`."""
        parts = torch.split(flat[self.index], self.counts, dim=1) if self.counts else ()
        for level, (numbers, (wtz, wy, wx)) in enumerate(zip(parts, self.matrices, strict=True)):
            bricks = len(wtz)
            # (bricks, x y E, t z) by (t z, Z), then (y E Z, x) by (x, X), then (Y, y) by (y, E Z X); capitals are vertices.
            values = torch.bmm(
                numbers.reshape(bricks, wtz.shape[2], -1).transpose(1, 2), wtz.transpose(1, 2)
            )
            values = torch.bmm(
                values.view(bricks, wx.shape[2], -1).transpose(1, 2), wx.transpose(1, 2)
            )
            values = torch.bmm(wy, values.view(bricks, wy.shape[2], -1))
            out[level].copy_(
                values.view(bricks, wy.shape[1], self.size, wtz.shape[1], -1).permute(2, 0, 3, 1, 4)
            )

    def add_transposed(self, flat: Tensor, gradient: Tensor) -> None:
        """Add to the flat tables' gradient what gradients (levels, E, bricks, z, y, x) of the embeddings give."""
        parts = []
        for level, (wtz, wy, wx) in enumerate(self.matrices):
            bricks = len(wtz)
            values = gradient[level].permute(1, 3, 0, 2, 4).reshape(bricks, wy.shape[1], -1)
            values = torch.bmm(wy.transpose(1, 2), values).view(bricks, -1, wx.shape[1])
            values = torch.bmm(wx.transpose(1, 2), values.transpose(1, 2)).view(
                bricks, -1, wtz.shape[1]
            )
            parts.append(torch.bmm(wtz.transpose(1, 2), values.transpose(1, 2)).view(bricks, -1))
        if parts:
            flat.index_add_(0, self.index.reshape(-1), torch.cat(parts, dim=1).view(-1))


def axis_matrices(
    size: int, corners: int, length: int, count: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """First corner (count,) and weights (count, length, corners of a sub-lattice) for `count` runs of `length` vertices of an axis.

    The axis has `size` vertices and `corners` corners, aligned (tesseract.locate); vertices past its end repeat the last one.
    """
    vertex = np.minimum(np.arange(count * length), size - 1).reshape(count, length)
    position = vertex * (corners - 1) / max(size - 1, 1)
    before = np.minimum(position.astype(np.int64), max(corners - 2, 0))
    share = position - before
    wide = min(int((before[:, -1] - before[:, 0]).max()) + 2, corners)
    start = np.minimum(before[:, 0], corners - wide)
    weight = np.zeros((count, length, wide))
    rows, columns = np.ogrid[:count, :length]
    weight[rows, columns, before - start[:, None]] = 1 - share
    if corners > 1:
        weight[rows, columns, before - start[:, None] + 1] = share
    return start, weight
