"""Input encodings in training: levels of tables, the gather engine and the product's own engine."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import prod
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from fhash_bench.paper.data import EMBEDDING_SIZE, WIDTH
from fhash_codec.features.bricks import Coreset, sample_places
from fhash_codec.paper.engines import make_engine
from fhash_codec.paper.engines.parameters import BETA1, BETA2, EPSILON, SPREAD, corrections
from fhash_codec.paper.network import Architecture, Resolution, parameter_count


def of_key_frame(coreset: Coreset, key: int) -> Coreset:
    """The samples of one key frame, as a coreset of this frame alone in the same box."""
    rows = np.flatnonzero(coreset.bricks[:, 0] == key)
    bricks = coreset.bricks[rows].copy()
    bricks[:, 0] = 0
    counts = np.diff(coreset.offsets)[rows]
    return replace(
        coreset,
        key_frames=(coreset.key_frames[key],),
        bricks=bricks,
        mask_bits=coreset.mask_bits[rows],
        values=coreset.values[coreset.sample_indices(rows)] if len(rows) else coreset.values[:0],
        offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        occupancy=(coreset.occupancy[key],),
        apart=(),
        fringe=None,
    )


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


HIDDEN_LAYERS = 2
"""Hidden layers of the network of every encoding (paper, section 4.2: 2 layers)."""

Values = npt.NDArray[np.float32]
"""Normalised values: 0 and 1 are the least and the largest value of the series."""


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


CHUNK = 1 << 15
"""Samples of a batch that pass through the tables and the network at a time."""
KEPT_BYTES = 1 << 31
"""Largest memory for corners and weights of all samples; beyond it each step computes its own."""
WHOLE = 0.9
"""Share of buckets in reach of the samples above which tables are held whole."""


class GatherModel:
    """Tables and one network for some key frames, in training on a coreset.

    Attributes:
        levels: the levels, finest first.
        rank: place of each bucket of all levels among those in reach of a sample, -1 for others;
            None where all are held.
        table: embeddings (buckets in reach, E).
        layers: weight (out, in) and bias (out,) of each layer.
        step: training steps done so far.
    """

    def __init__(
        self,
        levels: Sequence[Level],
        coreset: Coreset,
        rates: npt.NDArray[np.float64],
        *,
        seed: int,
        device: torch.device,
        dtype: torch.dtype = torch.float32,
        like: GatherModel | None = None,
    ) -> None:
        """Start from random numbers.

        Args:
            levels: the levels, for the key frames and the box of the coreset.
            coreset: the training samples.
            rates: learning rate of every training step, counted from 1.
            seed: seed of the initial numbers.
            device: where the model is trained.
            dtype: type of all its numbers.
            like: a model with the same levels; where its samples are at the same places, their
                corners are shared.
        """
        self.levels, self.coreset, self.rates = tuple(levels), coreset, rates
        self.device, self.dtype, self.step = device, dtype, 0
        places = torch.from_numpy(sample_places(coreset))
        shared = like if like is not None and torch.equal(like.places, places) else None
        self.places: Tensor = places if shared is None else shared.places
        self.values = torch.from_numpy(coreset.values).to(device, dtype)
        self._first = np.concatenate([[0], np.cumsum([level.size for level in levels])])
        self.rank: Tensor | None = self._ranked() if shared is None else shared.rank
        self._kept: tuple[Tensor, Tensor] | None = self._keep() if shared is None else shared._kept

        random = torch.Generator().manual_seed(seed)
        held = int(self._first[-1]) if self.rank is None else int(self.rank.max()) + 1
        table = torch.empty(held, EMBEDDING_SIZE).uniform_(-SPREAD, SPREAD, generator=random)
        self.table = table.to(device, dtype).requires_grad_()
        widths = [EMBEDDING_SIZE * len(levels), *[WIDTH] * HIDDEN_LAYERS, 1]
        self.layers: list[tuple[Tensor, Tensor]] = []
        for inputs, outputs in itertools.pairwise(widths):
            bound = inputs**-0.5
            weight, bias = (
                torch.empty(shape).uniform_(-bound, bound, generator=random)
                for shape in ((outputs, inputs), (outputs,))
            )
            self.layers.append(
                (
                    weight.to(device, dtype).requires_grad_(),
                    bias.to(device, dtype).requires_grad_(),
                )
            )
        self._moments = [
            (torch.zeros_like(number), torch.zeros_like(number)) for number in self.numbers
        ]

    @property
    def numbers(self) -> list[Tensor]:
        """All trained tensors: the table, then weights and biases."""
        return [self.table, *(number for layer in self.layers for number in layer)]

    @property
    def embeddings(self) -> int:
        """Embeddings of all levels."""
        return int(self._first[-1])

    @property
    def tables(self) -> int:
        """Trained numbers of the tables."""
        return self.embeddings * EMBEDDING_SIZE

    @property
    def mlp(self) -> int:
        """Trained numbers of the network."""
        return sum(number.numel() for layer in self.layers for number in layer)

    def train(self, chosen: npt.NDArray[np.int64]) -> None:
        """Do one training step of Adam on the mean squared error of some bricks."""
        self.step += 1
        gradients = self.gradients(self.coreset.sample_indices(chosen))
        rate = float(self.rates[self.step])
        with torch.no_grad():
            for number, gradient, (mean, square) in zip(
                self.numbers, gradients, self._moments, strict=True
            ):
                adam_step(number, gradient, mean, square, self.step, rate)

    def gradients(self, samples: npt.NDArray[np.int64]) -> list[Tensor]:
        """Gradients of the mean squared error of some samples, as `numbers` lists them."""
        totals = [torch.zeros_like(number) for number in self.numbers]
        for first in range(0, len(samples), CHUNK):
            part = torch.from_numpy(samples[first : first + CHUNK])
            buckets, weights = self._corners(part)
            target = self.values[part.to(self.device)]
            error = (self._network(self._encoded(buckets, weights)) - target).square().sum()
            for total, gradient in zip(
                totals, torch.autograd.grad(error / len(samples), self.numbers), strict=True
            ):
                total += gradient
        return totals

    def settle(self) -> None:
        """Do nothing: every number takes part in every step."""

    @torch.no_grad()
    def infer(self, samples: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
        """Values (n,) at samples of the coreset by their numbers."""
        values = np.empty(len(samples), np.float32)
        for first in range(0, len(samples), CHUNK):
            part = slice(first, first + CHUNK)
            corners = self._corners(torch.from_numpy(samples[part]))
            values[part] = self._network(self._encoded(*corners)).cpu().numpy()
        return values

    @torch.no_grad()
    def sample(self, points: Tensor) -> Tensor:
        """Values (n,) at points (n, 4) of the box; buckets that no sample reached count as 0."""
        values = torch.empty(len(points), device=self.device, dtype=self.dtype)
        for first in range(0, len(points), CHUNK):
            part = slice(first, first + CHUNK)
            buckets, weights = self._around(points[part].to(self.device, torch.float64))
            if self.rank is not None:
                buckets = self.rank.to(self.device)[buckets].long()
                weights = weights.masked_fill(buckets < 0, 0.0)
                buckets = buckets.clamp_min(0)
            values[part] = self._network(self._encoded(buckets, weights.to(self.dtype)))
        return values

    def moved(self) -> int:
        """Embeddings that a gradient ever moved."""
        return int((self._moments[0][1] != 0).any(1).sum())

    @torch.no_grad()
    def arrays(self) -> list[npt.NDArray[np.float32]]:
        """The table of all buckets, 0 where no gradient moved them, then weights and biases."""
        moved = (self._moments[0][1] != 0).any(1, keepdim=True)
        held = torch.where(moved, self.table, 0.0).cpu()
        if self.rank is not None:
            whole = torch.zeros(self.embeddings, EMBEDDING_SIZE, dtype=self.dtype)
            whole[self.rank >= 0] = held
            held = whole
        rest = [number.detach().cpu() for number in self.numbers[1:]]
        return [number.float().numpy() for number in (held, *rest)]

    def _around(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Buckets of all levels (n, levels, corners) around points, and float64 weights."""
        corners = [level.corners(points) for level in self.levels]
        buckets = [
            index + int(first) for (index, _), first in zip(corners, self._first[:-1], strict=True)
        ]
        return torch.stack(buckets, 1), torch.stack([weight for _, weight in corners], 1)

    def _ranked(self) -> Tensor | None:
        """Place of each bucket among those in reach of a sample, int32; None where nearly all are.

        The others never get a gradient. Held or not, they change no trained number.
        """
        reached = torch.zeros(self.embeddings, dtype=torch.bool)
        for part in torch.split(self.places, CHUNK):
            buckets, weights = self._around(part.double())
            reached[buckets[weights > 0]] = True
        if int(reached.sum()) > WHOLE * len(reached):
            return None
        return torch.where(reached, reached.cumsum(0) - 1, -1).int()

    def _keep(self) -> tuple[Tensor, Tensor] | None:
        """Buckets (samples, levels, corners) int32 and weights of all samples, if they fit."""
        buckets, _ = self._around(self.places[:1].double())
        width = 4 if self.dtype == torch.float32 else 8
        if len(self.places) * buckets.numel() * (4 + width) > KEPT_BYTES:
            return None
        shape = (len(self.places), *buckets.shape[1:])
        kept = (
            torch.empty(shape, dtype=torch.int32, device=self.device),
            torch.empty(shape, dtype=self.dtype, device=self.device),
        )
        for first in range(0, len(self.places), CHUNK):
            part = slice(first, first + CHUNK)
            for array, rows in zip(kept, self._fresh(self.places[part]), strict=True):
                array[part] = rows
        return kept

    def _fresh(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Buckets and weights around samples at places (n, 4), computed now."""
        buckets, weights = self._around(places.double())
        if self.rank is not None:
            # A corner of weight 0 may be out of reach of all samples.
            buckets = self.rank[buckets].clamp_min(0)
        return buckets.to(self.device), weights.to(self.device, self.dtype)

    def _corners(self, samples: Tensor) -> tuple[Tensor, Tensor]:
        """Buckets int64 and weights of samples by their numbers."""
        if self._kept is None:
            buckets, weights = self._fresh(self.places[samples])
        else:
            buckets, weights = (kept[samples.to(self.device)] for kept in self._kept)
        return buckets.long(), weights

    def _encoded(self, buckets: Tensor, weights: Tensor) -> Tensor:
        """Inputs of the network (n, levels E): the embeddings of all levels, concatenated."""
        corners = buckets.shape[-1]
        encoded: Tensor = WeightedSum.apply(
            self.table, buckets.reshape(-1, corners), weights.reshape(-1, corners)
        )
        return encoded.view(len(buckets), -1)

    def _network(self, inputs: Tensor) -> Tensor:
        """Outputs (n,) of the network, with ReLU between its layers."""
        hidden = inputs
        for number, (weight, bias) in enumerate(self.layers):
            hidden = torch.nn.functional.linear(
                hidden if number == 0 else hidden.relu(), weight, bias
            )
        return hidden.squeeze(1)


class WeightedSum(torch.autograd.Function):
    """Weighted sums (n, E) of rows of a table, by `embedding_bag`.

    The gradient adds to one column of the table at a time: on a CPU this takes a tenth of the time
    of the gradient that comes with `embedding_bag`, which sorts the buckets of every batch.
    """

    @staticmethod
    def forward(ctx: Any, table: Tensor, buckets: Tensor, weights: Tensor) -> Tensor:
        """Sums for buckets (n, corners) and their weights."""
        ctx.save_for_backward(buckets, weights)
        ctx.shape = table.shape
        return torch.nn.functional.embedding_bag(
            buckets, table, per_sample_weights=weights, mode="sum"
        )

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        """Gradient by the table."""
        buckets, weights = ctx.saved_tensors
        (gradient,) = gradients
        rows, size = ctx.shape
        by_column = gradient.new_zeros(size, rows)
        for column in range(size):
            by_column[column].scatter_add_(
                0, buckets.reshape(-1), (weights * gradient[:, column, None]).reshape(-1)
            )
        return by_column.T, None, None


class LatticeModel:
    """An engine of the codec on grids whose finest level is the box itself.

    A grid for each key frame is a level whose resolution along time is the number of key frames.
    """

    def __init__(
        self,
        levels: Sequence[GridLevel],
        coreset: Coreset,
        rates: npt.NDArray[np.float64],
        *,
        seed: int,
        device: torch.device,
    ) -> None:
        """Start from random numbers; arguments as of `GatherModel`."""
        self.levels, self.coreset, self.device = tuple(levels), coreset, device
        architecture = Architecture(
            levels=tuple(level.resolution for level in levels),
            embedding_size=EMBEDDING_SIZE,
            hidden_layers=HIDDEN_LAYERS,
            width=WIDTH,
            box_size=coreset.box.shape,
            key_frames=len(coreset.key_frames),
        )
        self.tables = parameter_count(architecture.levels, EMBEDDING_SIZE)
        self.mlp = architecture.parameters - self.tables
        self.architecture = architecture
        self.engine = make_engine(architecture, coreset, rates, seed=seed, device=device.type)
        self.places = torch.from_numpy(sample_places(coreset))
        self._dense: list[Tensor] | None = None

    @property
    def embeddings(self) -> int:
        """Embeddings of all levels."""
        return self.tables // EMBEDDING_SIZE

    def train(self, chosen: npt.NDArray[np.int64]) -> None:
        """Do one training step of Adam on the mean squared error of some bricks."""
        self._dense = None
        self.engine.train(chosen)

    def settle(self) -> None:
        """Let every brick catch up with the last step."""
        self.engine.settle()

    def infer(self, samples: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
        """Values (n,) at samples of the coreset by their ascending numbers, whole bricks."""
        offsets = self.coreset.offsets
        first = np.searchsorted(offsets, samples[0]) if len(samples) else 0
        end = np.searchsorted(offsets, samples[-1] + 1) if len(samples) else 0
        assert not len(samples) or offsets[end] - offsets[first] == len(samples)
        values = [np.zeros(0, np.float32)]
        bricks = max(1, CHUNK // prod(self.coreset.brick_shape))
        for start in range(int(first), int(end), bricks):
            chosen = np.arange(start, min(start + bricks, int(end)))
            values.append(self.engine.infer(chosen))
        return np.concatenate(values)

    @torch.no_grad()
    def sample(self, points: Tensor) -> Tensor:
        """Values (n,) at points (n, 4) of the box."""
        if self._dense is None:
            self._dense = [torch.from_numpy(array).to(self.device) for array in self.arrays()]
        tables, layers = self._dense[: len(self.levels)], self._dense[len(self.levels) :]
        values = torch.empty(len(points), device=self.device)
        for first in range(0, len(points), CHUNK):
            part = slice(first, first + CHUNK)
            at = points[part].to(self.device, torch.float64)
            inputs = []
            for level, table in zip(self.levels, tables, strict=True):
                buckets, weights = level.corners(at)
                inputs.append(
                    torch.nn.functional.embedding_bag(
                        buckets, table, per_sample_weights=weights.float(), mode="sum"
                    )
                )
            hidden = torch.cat(inputs, 1)
            for number, (weight, bias) in enumerate(zip(layers[::2], layers[1::2], strict=True)):
                hidden = torch.nn.functional.linear(
                    hidden if number == 0 else hidden.relu(), weight, bias
                )
            values[part] = hidden.squeeze(1)
        return values

    def moved(self) -> int:
        """Embeddings that a gradient ever moved."""
        state = self.engine.state()
        fine = state["fine_square"] != 0
        coarse = state["flat_square"][: -self.mlp].reshape(-1, EMBEDDING_SIZE) != 0
        return int(fine.any(0).sum()) + int(coarse.any(1).sum())

    def arrays(self) -> list[npt.NDArray[np.float32]]:
        """The tables (buckets, E), 0 where no gradient moved them, then weights and biases."""
        numbers = self.engine.parameters()
        tables, layers = numbers.dense(self.architecture)
        finest = np.zeros((self.levels[0].size, EMBEDDING_SIZE), np.float32)
        finest[self.levels[0].buckets(self.places).numpy()] = numbers.fine.T
        rest = [number for layer in layers for number in layer]
        return [number.copy() for number in (finest, *tables, *rest)]
