"""Parameters of an engine: initial values, upsampling of coarse levels, and Adam."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import prod
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from fhash_codec.features.bricks import Coreset
from fhash_codec.paper.network import Architecture
from fhash_formats.support.arrays import Double, Longs, Single

BETA1 = 0.9
"""Decay of the mean of gradients per step."""
BETA2 = 0.999
"""Decay of the mean of squared gradients per step."""
EPSILON = 1e-8
"""Number added to the root of the mean square before it divides."""
WINDOW = 200
"""Steps without a gradient after which a parameter no longer moves.

(BETA1 / sqrt(BETA2))**200 is 8e-10.
"""

Chosen = Longs
"""Numbers (n,) of some bricks of the coreset, without repetition."""


class CatchUp(NamedTuple):
    """Effect of steps without a gradient on parameters, each float32 (n,).

    With Adam's mean m and mean square v as they were before these steps, a parameter moves by
    -factor * m / (sqrt(v) + epsilon). Then m decays by `mean_decay` and v by `square_decay`.
    """

    factor: Single
    epsilon: Single
    mean_decay: Single
    square_decay: Single


def corrections(step: int, rate: float) -> tuple[float, float]:
    """Return the numbers of a step of Adam: the factor of the mean square's root, and the pace.

    A parameter moves by -pace * mean / (factor * root + EPSILON).

    Args:
        step: number of the step, from 1 on.
        rate: learning rate.
    """
    return 1 / (1 - BETA2**step) ** 0.5, rate / (1 - BETA1**step)


def adam_step(
    parameter: Tensor, gradient: Tensor, mean: Tensor, square: Tensor, step: int, rate: float
) -> None:
    """Do one step of Adam in place, on tensors of one shape.

    torch.optim.Adam does the same, but loads torch's compiler on its first use, which takes as long
    as loading torch itself.

    Args:
        parameter: the numbers to move.
        gradient: their gradient.
        mean: mean of the gradients.
        square: mean of the squared gradients.
        step: number of the step, from 1 on.
        rate: learning rate.
    """
    correction, pace = corrections(step, rate)
    mean.lerp_(gradient, 1 - BETA1)
    square.mul_(BETA2).addcmul_(gradient, gradient, value=1 - BETA2)
    parameter.addcdiv_(mean, square.sqrt().mul_(correction).add_(EPSILON), value=-pace)


def catch_up(visited: Longs, step: int, rates: Double) -> CatchUp:
    """Return the effect of the steps visited + 1 .. step, all with a gradient of zero.

    At step j = visited + i Adam moves a parameter by
    -rate_j m b1^i / (1 - b1^j) / (sqrt(v b2^i / (1 - b2^j)) + eps). With r = b1 / sqrt(b2) and
    c_j = sqrt(1 - b2^j) / (1 - b1^j) that is
    -rate_j r^i c_j m / (sqrt(v) + eps sqrt((1 - b2^j) / b2^i)).
    All but the last root leave the sum over i. The root varies slowly and is replaced by its
    harmonic mean under the weights rate_j r^i c_j. That is exact where sqrt(v) is far above eps and
    where it is far below.

    Args:
        visited: number of the last step with a gradient for each parameter, int64 (n,); 0 for none.
        step: number of the present step.
        rates: learning rate of every step, counted from 1.
    """
    gap = step - visited
    missed = np.where(visited > 0, gap, 0)
    i = np.arange(1, min(int(missed.max(initial=0)), WINDOW) + 1)
    j = visited[:, None] + i
    within = i <= missed[:, None]
    correction2 = -np.expm1(j * np.log(BETA2))
    weight = np.where(within, rates[np.minimum(j, len(rates) - 1)] * (BETA1 / BETA2**0.5) ** i, 0.0)
    weight *= np.sqrt(correction2) / -np.expm1(j * np.log(BETA1))
    factor = weight.sum(axis=1)
    inverse = (weight / np.sqrt(correction2 / BETA2**i)).sum(axis=1)
    epsilon = EPSILON * np.divide(factor, inverse, out=np.ones_like(factor), where=inverse > 0)
    return CatchUp(
        factor=factor.astype(np.float32),
        epsilon=epsilon.astype(np.float32),
        mean_decay=(BETA1 ** missed.astype(np.float64)).astype(np.float32),
        square_decay=(BETA2 ** missed.astype(np.float64)).astype(np.float32),
    )


def catch_up_numbers(numbers: Tensor, effect: Tensor) -> None:
    """Let parameters and their moments catch up on missed steps, in place.

    Args:
        numbers: the parameters, their mean and their mean square, (3, E, n).
        effect: the columns of a `CatchUp`, (4, n).
    """
    parameter, mean, square = numbers
    factor, epsilon = effect[:2]
    parameter.addcdiv_(mean * factor, square.sqrt().add_(epsilon), value=-1.0)
    numbers[1:].mul_(effect[2:].unsqueeze(1))


def true_positions(mask: Tensor, count: int) -> Tensor:
    """Return where a mask (n,) is not 0, int64 (count,), ascending.

    `Tensor.nonzero` makes the host wait until the device has counted them.

    Args:
        mask: booleans, or 0 and 1 of an integer type.
        count: number of entries that are not 0.
    """
    if mask.device.type == "cpu":
        return mask.nonzero().squeeze(1)
    # Entry number k is the first at which k have been counted.
    return torch.searchsorted(mask.cumsum(0), torch.arange(1, count + 1, device=mask.device))


SPREAD = 1e-4
"""Bound of the initial embeddings, uniform in -SPREAD .. SPREAD (Müller et al. 2022, section 4)."""
BRICKS_AT_A_TIME = 1024
"""Bricks whose vertices draw their embeddings at a time."""


@dataclass(frozen=True)
class Parameters:
    """The trained numbers of a model.

    Attributes:
        fine: embeddings of the finest level (E, samples), those of the samples alone, in the order
            of `Coreset.values`. At all other vertices they are 0.
        coarse: the coarser tables, each (buckets, E), level by level in one vector.
        network: the layers, each a matrix (out, in + 1) whose last column is the bias, in one
            vector.
    """

    fine: Tensor
    coarse: Tensor
    network: Tensor

    def dense(self, architecture: Architecture) -> tuple[list[Tensor], list[tuple[Tensor, Tensor]]]:
        """Return views of the coarse tables and of the layers.

        Returns:
            The tables (buckets, E), and weight (out, in) and bias (out,) of each layer.
        """
        size = architecture.embedding_size
        tables = (
            torch.split(self.coarse, [prod(level) * size for level in architecture.levels[1:]])
            if len(self.coarse)
            else ()
        )
        layers = layer_matrices(architecture, self.network)
        return [table.view(-1, size) for table in tables], [
            (layer[:, :-1], layer[:, -1]) for layer in layers
        ]


def layer_matrices(architecture: Architecture, network: Tensor) -> list[Tensor]:
    """Return views of the layers (out, in + 1) inside one vector."""
    shapes = [(outputs, inputs + 1) for outputs, inputs in architecture.layer_shapes]
    vectors = torch.split(network, [prod(shape) for shape in shapes])
    return [vector.view(shape) for vector, shape in zip(vectors, shapes, strict=True)]


def initial_parameters(architecture: Architecture, coreset: Coreset, seed: int) -> Parameters:
    """Return random parameters that depend on the seed alone, float32 on the CPU.

    Embeddings are uniform in +-SPREAD (paper, section 3.2.4: uniform initialization). Layers are
    uniform in +-1/sqrt(inputs), as torch.nn.Linear starts them.
    """
    random = torch.Generator().manual_seed(seed)
    fine = _initial_fine(architecture.embedding_size, coreset, random)
    coarse = torch.empty(architecture.coarse_numbers).uniform_(-SPREAD, SPREAD, generator=random)
    layers = []
    for outputs, inputs in architecture.layer_shapes:
        bound = inputs**-0.5
        layers.append(torch.empty(outputs * (inputs + 1)).uniform_(-bound, bound, generator=random))
    return Parameters(fine=fine, coarse=coarse, network=torch.cat(layers))


def _initial_fine(size: int, coreset: Coreset, random: torch.Generator) -> Tensor:
    """Return the finest embeddings (E, samples) at the start.

    All vertices of a brick draw a number, samples or not: where a vertex starts depends on its
    brick alone.
    """
    fine = torch.empty(size, len(coreset.values))
    vertices = prod(coreset.brick_shape)
    for first in range(0, len(coreset.bricks), BRICKS_AT_A_TIME):
        bits = coreset.mask_bits[first : first + BRICKS_AT_A_TIME]
        drawn = torch.empty(len(bits), size, vertices)
        drawn.uniform_(-SPREAD, SPREAD, generator=random)
        in_coreset = torch.from_numpy(np.unpackbits(bits, axis=1, count=vertices)).bool()
        span = slice(*coreset.offsets[[first, first + len(bits)]].tolist())
        fine[:, span] = drawn.transpose(0, 1)[:, in_coreset]
    return fine


def check_state(
    state: Mapping[str, npt.NDArray[np.generic]], shapes: Mapping[str, Sequence[int]]
) -> None:
    """Raise KeyError or ValueError where a state of a checkpoint is of another model.

    It does so before a device is asked for memory: whatever fails then is not the checkpoint.

    Args:
        state: arrays by name.
        shapes: the shape that each array must have.
    """
    for name, shape in shapes.items():
        if state[name].shape != tuple(shape):
            raise ValueError(f"{name} is {state[name].shape}; the model has {tuple(shape)}")


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

    starts: tuple[Longs, ...]
    matrices: tuple[Double, ...]
    shapes: tuple[tuple[int, ...], ...]
    offsets: Longs


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


def axis_matrices(size: int, corners: int, length: int, count: int) -> tuple[Longs, Double]:
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


def level_matrices(
    architecture: Architecture, coreset: Coreset, resolution: tuple[int, ...]
) -> list[tuple[Longs, Double]]:
    """Return `axis_matrices` of a level along t, z, y and x; a key frame is a run along time."""
    lengths, counts = (1, *coreset.brick_shape), (architecture.key_frames, *coreset.brick_grid)
    return [
        axis_matrices(*along_axis)
        for along_axis in zip(architecture.sizes, resolution, lengths, counts, strict=True)
    ]


def _level_axes(
    architecture: Architecture, coreset: Coreset, resolution: tuple[int, ...], numbers: int
) -> LevelAxes:
    """Return the sub-lattices of one coarse level; `numbers` precede its flat table."""
    size, axes = architecture.embedding_size, level_matrices(architecture, coreset, resolution)
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
