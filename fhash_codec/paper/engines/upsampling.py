"""Interpolation of the coarse levels at the vertices of whole bricks, and its transpose.

Both are separable products of small matrices. A brick needs a small sub-lattice of each coarse
table. The place of that sub-lattice and the matrices that interpolate from it depend only on the
brick's coordinates, axis by axis. They are made once per coordinate and looked up. Time is one more
factor of the product along z.
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
"""Bricks whose sub-lattices are marked as used at a time."""


@dataclass(frozen=True)
class LevelAxes:
    """The sub-lattices of one coarse level for every coordinate of a brick, axis by axis.

    The axes are (key frame, z) together, y, and x.

    Attributes:
        starts: for each axis, the start of the sub-lattice in the flat tables, int64
            (coordinates,).
        matrices: for each axis, the flattened interpolation matrices (coordinates, vertices *
            corners), float64.
        shapes: for each axis, the shape (vertices, corners) of one of these matrices.
        offsets: positions of the numbers of a sub-lattice relative to its start, in the order
            (corners t z x y, E), int64.
    """

    starts: tuple[npt.NDArray[np.int64], ...]
    matrices: tuple[npt.NDArray[np.float64], ...]
    shapes: tuple[tuple[int, ...], ...]
    offsets: npt.NDArray[np.int64]


class Upsampling:
    """The tables of starts and matrices that all bricks of a coreset share.

    The coarse tables lie level by level in a flat vector.

    Attributes:
        used: positions in that vector, ascending, of the numbers that some brick needs. Training
            holds only these: around a sparse feature most of the coarse tables is out of reach.
        rank: for each position in that vector its place among `used`; None if all are used.
    """

    used: Tensor

    def __init__(self, architecture: Architecture, coreset: Coreset, device: torch.device) -> None:
        """Make the tables by brick coordinate: (key frame, z) together, y, and x."""
        self.size, self.layers = architecture.embedding_size, coreset.brick_grid[0]
        numbers, levels = 0, []
        for resolution in architecture.levels[1:]:
            levels.append(_level_axes(architecture, coreset, resolution, numbers))
            numbers += prod(resolution) * self.size
        self.shapes = [level.shapes for level in levels]
        self.starts = [
            torch.from_numpy(np.stack(starts, axis=1)).to(device)
            for starts in zip(*(level.starts for level in levels), strict=True)
        ]
        self.matrices = [
            torch.from_numpy(np.concatenate(matrices, axis=1).astype(np.float32)).to(device)
            for matrices in zip(*(level.matrices for level in levels), strict=True)
        ]
        offsets = [level.offsets for level in levels]
        self.counts = [len(offset) for offset in offsets]
        self.offset = torch.from_numpy(np.concatenate([*offsets, np.zeros(0, dtype=np.int64)])).to(
            device
        )
        self.level = torch.from_numpy(np.repeat(np.arange(len(offsets)), self.counts)).to(device)
        in_use = self._in_use(torch.from_numpy(coreset.bricks.astype(np.int64)).to(device), numbers)
        self.used = in_use.nonzero().squeeze(1)
        self.rank = (in_use.cumsum(0, dtype=torch.int32) - 1) if len(self.used) < numbers else None

    def _in_use(self, bricks: Tensor, numbers: int) -> Tensor:
        """Return which numbers of the flat tables some brick needs, bool (numbers,)."""
        in_use = torch.zeros(numbers, dtype=torch.bool, device=bricks.device)
        for batch in torch.split(bricks, BRICKS_AT_A_TIME):
            in_use[self._positions(self._coordinates(batch))] = True
        return in_use

    def _coordinates(self, bricks: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the coordinates (key frame, z) together, y and x of bricks (n, 4)."""
        t, z, y, x = bricks.unbind(1)
        return t * self.layers + z, y, x

    def _positions(self, coordinates: tuple[Tensor, ...]) -> Tensor:
        """Return where the sub-lattices of bricks lie in the flat tables, (bricks, numbers)."""
        if not self.shapes:
            return self.offset.expand(len(coordinates[0]), 0)
        base = sum(
            (start[c] for start, c in zip(self.starts, coordinates, strict=True)),
            torch.zeros((), dtype=torch.int64),
        )
        return base[:, self.level] + self.offset

    def lattices(self, bricks: Tensor) -> Lattices:
        """Return the sub-lattices of bricks (n, 4), coordinates (key frame, z, y, x) int64."""
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
            tuple(row[level].view(-1, *shape[axis]) for axis, row in enumerate(rows))
            for level, shape in enumerate(self.shapes)
        ]
        return Lattices(index=index, counts=self.counts, matrices=levels, size=self.size)


@dataclass(frozen=True, kw_only=True)
class Lattices:
    """The sub-lattices of the coarse tables that some bricks need, and how to interpolate in them.

    Attributes:
        index: positions (bricks, numbers) among the used numbers of the flat tables.
        counts: numbers of each level. They come in the order (corners t z x y, E); in this order
            each axis is one batched product, without a copy in between.
        matrices: per level, the matrices along (t, z), y and x, each (bricks, vertices, corners).
        size: numbers E of an embedding.
    """

    index: Tensor
    counts: list[int]
    matrices: list[tuple[Tensor, ...]]
    size: int

    def interpolate(self, flat: Tensor, out: Tensor) -> None:
        """Write the embeddings (levels, E, bricks, z, y, x) at all vertices into `out`."""
        levels = torch.split(flat[self.index], self.counts, dim=1) if self.counts else ()
        for level, (numbers, (wtz, wy, wx)) in enumerate(zip(levels, self.matrices, strict=True)):
            bricks = len(wtz)
            # Capitals are vertices, small letters corners. The products are (bricks, x y E, t z)
            # by (t z, Z), then (y E Z, x) by (x, X), then (Y, y) by (y, E Z X).
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

    def add_transposed(self, flat_gradient: Tensor, gradient: Tensor) -> None:
        """Add the gradient by the embeddings to the gradient by the flat tables.

        Args:
            flat_gradient: gradient by the used numbers of the flat tables, changed in place.
            gradient: gradient by the embeddings (levels, E, bricks, z, y, x).
        """
        levels = []
        for level, (wtz, wy, wx) in enumerate(self.matrices):
            bricks = len(wtz)
            values = gradient[level].permute(1, 3, 0, 2, 4).reshape(bricks, wy.shape[1], -1)
            values = torch.bmm(wy.transpose(1, 2), values).view(bricks, -1, wx.shape[1])
            values = torch.bmm(wx.transpose(1, 2), values.transpose(1, 2)).view(
                bricks, -1, wtz.shape[1]
            )
            levels.append(torch.bmm(wtz.transpose(1, 2), values.transpose(1, 2)).view(bricks, -1))
        if levels:
            flat_gradient.index_add_(0, self.index.reshape(-1), torch.cat(levels, dim=1).view(-1))


def axis_matrices(
    size: int, corners: int, length: int, count: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """Return the sub-lattice and the weights of each run of vertices along an axis.

    The first and the last vertex of the axis are the first and the last corner
    (`tesseract.locate`). Vertices beyond its end repeat the last one.

    Args:
        size: vertices of the axis.
        corners: corners of the level along the axis.
        length: vertices of a run.
        count: number of runs.

    Returns:
        The first corner of each sub-lattice (count,), and the weights (count, length, corners of a
        sub-lattice).
    """
    vertex = np.minimum(np.arange(count * length), size - 1).reshape(count, length)
    position = vertex * (corners - 1) / max(size - 1, 1)
    before = np.minimum(position.astype(np.int64), max(corners - 2, 0))
    after_weight = position - before
    sub_corners = min(int((before[:, -1] - before[:, 0]).max()) + 2, corners)
    start = np.minimum(before[:, 0], corners - sub_corners)
    weights = np.zeros((count, length, sub_corners))
    rows, columns = np.ogrid[:count, :length]
    weights[rows, columns, before - start[:, None]] = 1 - after_weight
    if corners > 1:
        weights[rows, columns, before - start[:, None] + 1] = after_weight
    return start, weights


def _level_axes(
    architecture: Architecture, coreset: Coreset, resolution: tuple[int, ...], numbers: int
) -> LevelAxes:
    """Return the sub-lattices of one coarse level; `numbers` precede its table in the flat vector.

    Each key frame counts as a run of one vertex along time.
    """
    lengths, counts = (1, *coreset.brick_shape), (architecture.key_frames, *coreset.brick_grid)
    size = architecture.embedding_size
    axes = [
        axis_matrices(*along_axis)
        for along_axis in zip(architecture.sizes, resolution, lengths, counts, strict=True)
    ]
    stride = [prod(resolution[axis + 1 :]) * size for axis in range(4)]
    (start_t, wt), (start_z, wz), (start_y, wy), (start_x, wx) = axes
    start_tz = (start_t[:, None] * stride[0] + start_z * stride[1]).reshape(-1) + numbers
    # (key frames, coordinates z, vertices z, corners t, corners z)
    wtz = wt[:, None, :, :, None] * wz[None, :, :, None, :]
    corners = [np.arange(w.shape[2]) * s for (_, w), s in zip(axes, stride, strict=True)]
    t, z, x, y, e = np.ix_(corners[0], corners[1], corners[3], corners[2], np.arange(size))
    return LevelAxes(
        starts=(start_tz, start_y * stride[2], start_x * stride[3]),
        matrices=(
            wtz.reshape(len(start_tz), -1),
            wy.reshape(len(wy), -1),
            wx.reshape(len(wx), -1),
        ),
        shapes=((wz.shape[1], wt.shape[2] * wz.shape[2]), wy.shape[1:], wx.shape[1:]),
        offsets=(t + z + x + y + e).reshape(-1),
    )
