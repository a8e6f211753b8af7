"""The slab engine: training and evaluation on the lattice by small separable matrix products.

A training sample is a lattice vertex. Its embedding at the finest level is therefore one entry of
the table, and every coarser level is a separable linear upsampling of a small sub-lattice; no 16
corners are looked up per sample. The unit of work is a brick of vertices of one key frame, and a
batch is a random set of bricks. The same operations of torch run on a CPU and on CUDA. There, slab
trains the models that the kernels of `fused`, which is faster, do not take.

The finest embeddings are stored for the samples alone, brick by brick. Adam visits just the bricks
of a batch, yet gives what a dense Adam gives: a brick that was passed over catches up on its
missing steps, whose gradient is zero, in closed form before it is used (`parameters.catch_up`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from fhash_codec.features.bricks import Coreset
from fhash_codec.paper.engines.parameters import (
    BETA1,
    BETA2,
    EPSILON,
    Chosen,
    LevelAxes,
    Parameters,
    catch_up,
    check_state,
    coarse_axes,
    coarse_levels,
    corrections,
    initial_parameters,
    layer_matrices,
    used_numbers,
)
from fhash_codec.paper.network import Architecture, parameter_count
from fhash_formats.support.values import Single


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
        interpolated = coarse_levels(architecture, coreset)
        self.numbers = parameter_count(interpolated, self.size)
        levels = coarse_axes(architecture, coreset)
        self.starts = [
            torch.from_numpy(np.stack(starts, axis=1)).to(device)
            for starts in zip(*(level.starts for level in levels), strict=True)
        ]
        weights = [_weights(level) for level in levels]
        self.shapes = [tuple(weight.shape[1:] for weight in level) for level in weights]
        self.matrices = [
            torch.from_numpy(
                np.concatenate([each.reshape(len(each), -1) for each in along], axis=1)
            ).to(device)
            for along in zip(*weights, strict=True)
        ]
        offsets = [level.offsets for level in levels]
        self.counts = [len(offset) for offset in offsets]
        self.offset = torch.from_numpy(np.concatenate([*offsets, np.zeros(0, dtype=np.int64)])).to(
            device
        )
        self.level = torch.from_numpy(np.repeat(np.arange(len(offsets)), self.counts)).to(device)
        used, rank = used_numbers(levels, coreset, self.numbers)
        self.used = torch.from_numpy(used).to(device)
        self.rank = None if rank is None else torch.from_numpy(rank).to(device)

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


def _weights(level: LevelAxes) -> list[Single]:
    """Return the weights (coordinates, vertices, corners) along (key frame, z), y and x."""
    wt, wz, wy, wx = (weight for _, weight in level.axes)
    # (key frames, coordinates z, vertices z, corners t, corners z)
    wtz = wt[:, None, :, :, None] * wz[None, :, :, None, :]
    wtz = wtz.reshape(wt.shape[0] * wz.shape[0], wz.shape[1], -1)
    return [weight.astype(np.float32) for weight in (wtz, wy, wx)]


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


class Columns(NamedTuple):
    """The columns of a batch: all vertices of its bricks, or their samples alone.

    Around a feature most vertices of many bricks are no samples.

    Attributes:
        bricks: number of the bricks.
        ranks: place of each column among the samples of the coreset, int64 (columns,); of one that
            is no sample the place behind them all.
        vertices: number of its vertex among those of the bricks, int64 (columns,); None where all
            vertices are columns.
        in_coreset: which columns are samples, as 0 and 1 (columns,); None where all are.
    """

    bricks: int
    ranks: Tensor
    vertices: Tensor | None
    in_coreset: Tensor | None


def columns_of(in_coreset: Tensor, offsets: Tensor, none: int, alone: int | None) -> Columns:
    """Return the columns of some bricks.

    Args:
        in_coreset: which vertices (bricks, vertices) are samples, as 0 and 1.
        offsets: place of each brick's first sample (bricks,).
        none: place that stands for vertices that are no samples.
        alone: number of the samples, where they alone are columns; else None.
    """
    bricks = len(in_coreset)
    ranks = in_coreset.cumsum(1, dtype=torch.int64).add_(offsets.unsqueeze(1) - 1).view(-1)
    mask = in_coreset.reshape(-1)
    if alone is None:
        return Columns(bricks, ranks.masked_fill_(mask == 0, none), None, mask)
    vertices = true_positions(mask, alone)
    return Columns(bricks, ranks[vertices], vertices, None)


CHUNK = 1 << 13
"""Samples that go through the MLP at a time: their activations stay in a core's cache.

On CUDA all of a batch do: a launch costs more than a pass through the memory.
"""
FULL = 0.9
"""Share of samples among the vertices of a batch above which all vertices go through the MLP.

To pick a sample moves a few numbers; the MLP multiplies thousands for it.
"""
ADAM_PART = 1 << 17
"""Numbers of the flat vector that Adam moves at a time on a CPU: they stay in the cache."""
STATE = ("fine", "fine_mean", "fine_square", "flat", "flat_mean", "flat_square")
"""Tensors that a checkpoint stores, by name, besides `visited` and the step."""
FLUSH = 1024
"""Bricks that are brought up to date at a time."""


class SlabEngine:
    """An `Engine` that trains on bricks.

    Attributes:
        fine: finest embeddings (E, samples) in the order of `Coreset.values`; `fine_mean` and
            `fine_square` are their moments of Adam.
        visited: number of the last training step that used each brick, 0 for none, int64 (bricks,)
            on the host.
        flat: the used numbers of the coarse tables, followed by the layers of the MLP, in one
            vector; `flat_mean` and `flat_square` are their moments, `gradient` is their gradient.
        coarse: number of the used numbers of the coarse tables.
        layers: matrices (out, in + 1) of the MLP, views of `flat`; `layer_gradients` are views of
            `gradient`.
        settled: number of the training step up to which all bricks have caught up.
    """

    name = "slab"

    def __init__(
        self,
        architecture: Architecture,
        coreset: Coreset,
        rates: npt.NDArray[np.float64],
        *,
        seed: int,
        device: torch.device | str,
    ) -> None:
        """Start from fresh parameters; arguments as in `make_engine`.

        The coreset is copied to the device.
        """
        device = torch.device(device)
        self.architecture, self.coreset = architecture, coreset
        self.rates, self.device = rates, device
        self.on_cpu = device.type == "cpu"
        self.vertices, self.counts = prod(coreset.brick_shape), np.diff(coreset.offsets)
        self.bricks = torch.from_numpy(coreset.bricks.astype(np.int64)).to(device)
        self.mask_bits = torch.from_numpy(coreset.mask_bits).to(device)
        # A sample more, which stands for every vertex that is none.
        self.values = torch.zeros(len(coreset.values) + 1, device=device)
        self.values[:-1] = torch.from_numpy(coreset.values)
        self.offsets = torch.from_numpy(coreset.offsets).to(device)
        self._bits = torch.arange(7, -1, -1, device=device, dtype=torch.uint8)
        self._scratch_memory: dict[str, Tensor] = {}
        self.upsampling = Upsampling(architecture, coreset, device)

        start = initial_parameters(architecture, coreset, seed)
        # Embeddings and both moments. They stay 0 for the sample that stands for no sample.
        self._numbers = torch.zeros(3, len(start.fine), len(self.values), device=device)
        self.fine, self.fine_mean, self.fine_square = self._numbers[..., :-1].unbind()
        self.fine.copy_(torch.from_numpy(start.fine))
        self.visited = np.zeros(len(self.bricks), dtype=np.int64)
        self.step = self.settled = 0
        self.coarse = len(self.upsampling.used)
        self.flat = torch.cat(
            [
                torch.from_numpy(start.coarse).to(device)[self.upsampling.used],
                torch.from_numpy(start.network).to(device),
            ]
        )
        self.flat_mean, self.flat_square, self.gradient = (
            torch.zeros_like(self.flat) for _ in range(3)
        )
        self.layers = layer_matrices(architecture, self.flat[self.coarse :])
        self.layer_gradients = layer_matrices(architecture, self.gradient[self.coarse :])

    @torch.no_grad()
    def train(self, chosen: Chosen) -> Tensor:
        """Do one training step on a batch; return the sum of squared errors before it."""
        samples = int(self.counts[chosen].sum())
        ids, effect = self._sent(chosen)
        columns = self._columns(ids, samples)
        numbers = self._caught_up(effect, columns)
        lattices = self.upsampling.lattices(self.bricks[ids])
        inputs = self._inputs(lattices, numbers[0], columns)
        self.gradient.zero_()
        error, input_gradient = self._backpropagate(inputs, columns, 2.0 / max(samples, 1))
        size = len(self.fine)
        level_gradients = self._at_all_vertices(input_gradient[size:], columns)
        lattices.add_transposed(self.gradient, self._by_level(level_gradients))

        self.step += 1
        step, rate = self.step, float(self.rates[self.step])
        fine, mean, square = numbers
        adam_step(fine, input_gradient[:size], mean, square, step, rate)
        for part in self._chunks(len(self.flat), ADAM_PART):
            mean, square = self.flat_mean[part], self.flat_square[part]
            adam_step(self.flat[part], self.gradient[part], mean, square, step, rate)
        self._numbers.index_copy_(2, columns.ranks, numbers)
        self.visited[chosen] = step
        return error

    @torch.no_grad()
    def infer(self, chosen: Chosen) -> Single:
        """Return the values (n,) at the samples of some bricks."""
        count = int(self.counts[chosen].sum())
        ids, effect = self._sent(chosen)
        columns = self._columns(ids, count)
        if self.settled == self.step:
            fine = self._numbers[0].index_select(1, columns.ranks)
        else:
            fine = self._caught_up(effect, columns)[0]
        lattices = self.upsampling.lattices(self.bricks[ids])
        values = self._value(self._inputs(lattices, fine, columns))
        if columns.in_coreset is not None:
            values = values[true_positions(columns.in_coreset, count)]
        return values.cpu().numpy()

    @torch.no_grad()
    def settle(self) -> None:
        """Let every brick catch up with the present step, so that evaluation is faster."""
        for first in range(0, len(self.bricks), FLUSH):
            end = min(first + FLUSH, len(self.bricks))
            span = slice(*self.coreset.offsets[[first, end]].tolist())
            _, effect = self._sent(np.arange(first, end))
            samples = self.offsets[first : end + 1].diff()
            catch_up_numbers(self._numbers[..., span], effect.repeat_interleave(samples, dim=1))
        self.visited[self.visited > 0] = self.step
        self.settled = self.step

    @torch.no_grad()
    def parameters(self) -> Parameters:
        """Return the trained numbers, on the CPU. Embeddings that no sample ever moved are 0.

        On a CPU the finest embeddings are the engine's own memory, not a copy.
        """
        self.settle()
        coarse = torch.zeros(self.upsampling.numbers)
        moved = (self.flat_mean != 0) | (self.flat_square != 0)
        used = torch.where(moved, self.flat, 0.0) if self.step else self.flat
        coarse[self.upsampling.used.cpu()] = used[: self.coarse].cpu()
        trained = Parameters(
            fine=self.fine.cpu().numpy(),
            coarse=coarse.numpy(),
            network=self.flat[self.coarse :].cpu().clone().numpy(),
        )
        return trained.as_stored(self.architecture, self.coreset)

    def state(self) -> dict[str, npt.NDArray[np.generic]]:
        """Return parameters, Adam's moments and the step number as arrays."""
        tensors = {name: getattr(self, name).cpu().numpy() for name in STATE}
        return {"step": np.array(self.step), "visited": self.visited, **tensors}

    def restore(self, state: Mapping[str, npt.NDArray[np.generic]]) -> None:
        """Continue from a `state`; raises KeyError or ValueError for one of another model."""
        check_state(state, {name: getattr(self, name).shape for name in (*STATE, "visited")})
        self.step, self.settled = int(state["step"]), -1
        self.visited[:] = state["visited"]
        for name in STATE:
            getattr(self, name).copy_(torch.from_numpy(state[name]))

    def _sent(self, chosen: Chosen) -> tuple[Tensor, Tensor]:
        """Return bricks on the device, and what they missed up to the present step.

        Returns:
            Their numbers (bricks,), and the columns of `CatchUp` (4, bricks).
        """
        effect = np.stack(catch_up(self.visited[chosen], self.step, self.rates))
        ids = torch.from_numpy(np.ascontiguousarray(chosen))
        return ids.to(self.device), torch.from_numpy(effect).to(self.device)

    def _columns(self, ids: Tensor, samples: int) -> Columns:
        """Return the columns of the MLP's inputs for bricks that have so many samples."""
        alone = samples if samples <= FULL * len(ids) * self.vertices else None
        return columns_of(self._in_coreset(ids), self.offsets[ids], len(self.values) - 1, alone)

    def _caught_up(self, effect: Tensor, columns: Columns) -> Tensor:
        """Return what a dense Adam has for columns of bricks that missed steps.

        The numbers (3, E, columns) are the finest embeddings, their mean and their square.
        `effect` is that of `_sent`.
        """
        numbers = self._numbers.index_select(2, columns.ranks)
        if columns.vertices is None:
            effect = effect.unsqueeze(2).expand(-1, -1, self.vertices).reshape(4, -1)
        else:
            effect = effect[:, columns.vertices // self.vertices]
        catch_up_numbers(numbers, effect)
        return numbers

    def _in_coreset(self, ids: Tensor) -> Tensor:
        """Return which vertices (bricks, vertices) are in the coreset, as 0 and 1, uint8."""
        return (self.mask_bits[ids].unsqueeze(-1) >> self._bits & 1).flatten(1)[:, : self.vertices]

    def _inputs(self, lattices: Lattices, fine: Tensor, columns: Columns) -> Tensor:
        """Return the inputs of the MLP (levels E + 1, columns).

        The last row is 1: the layers' biases are one more column of their matrices. The next call
        overwrites the result.

        Args:
            lattices: the sub-lattices of the bricks.
            fine: finest embeddings (E, columns).
            columns: the columns.
        """
        inputs = self._scratch("inputs", self.architecture.inputs + 1, fine.shape[1])
        inputs[: len(fine)], inputs[-1] = fine, 1.0
        coarse = inputs[len(fine) : -1]
        if columns.vertices is None:
            lattices.interpolate(self.flat, self._by_level(coarse))
        else:
            whole = self._scratch("coarse inputs", len(coarse), columns.bricks * self.vertices)
            lattices.interpolate(self.flat, self._by_level(whole))
            torch.index_select(whole, 1, columns.vertices, out=coarse)
        return inputs

    def _at_all_vertices(self, rows: Tensor, columns: Columns) -> Tensor:
        """Return rows (n, columns) as rows over all vertices of the bricks, with 0 between them."""
        if columns.vertices is None:
            return rows
        whole = self._scratch("whole gradient", len(rows), columns.bricks * self.vertices)
        return whole.zero_().index_copy_(1, columns.vertices, rows)

    def _by_level(self, rows: Tensor) -> Tensor:
        """Return rows (coarse levels * E, vertices) as (coarse levels, E, bricks, z, y, x)."""
        levels, size = len(self.upsampling.shapes), self.architecture.embedding_size
        bricks = rows.shape[1] // self.vertices
        return rows.view(levels, size, bricks, *self.coreset.brick_shape)

    def _value(self, inputs: Tensor) -> Tensor:
        """Return the output of the MLP (samples,)."""
        result = torch.empty(inputs.shape[1], device=self.device)
        for part in self._chunks(len(result), CHUNK):
            result[part] = self._forward(inputs[:, part])[-1][0]
        return result

    def _chunks(self, count: int, most: int) -> list[slice]:
        """Return slices of `count` numbers, each of at most `most` on a CPU; one of all on CUDA."""
        size = most if self.on_cpu else max(count, 1)
        return [slice(first, first + size) for first in range(0, count, size)]

    def _forward(self, inputs: Tensor) -> list[Tensor]:
        """Return the activations of each layer for a chunk of samples, the inputs first.

        The next call overwrites them.
        """
        count = inputs.shape[1]
        activations = [inputs]
        for number, layer in enumerate(self.layers):
            if number == len(self.layers) - 1:
                activations.append(layer @ activations[-1])
            else:
                # The last row stays 1: it carries the bias of the next layer.
                hidden = self._scratch(f"hidden {number}", len(layer) + 1, count)
                hidden[-1] = 1.0
                torch.mm(layer, activations[-1], out=hidden[:-1]).clamp_min_(0.0)
                activations.append(hidden)
        return activations

    def _backpropagate(
        self, inputs: Tensor, columns: Columns, scale: float
    ) -> tuple[Tensor, Tensor]:
        """Return the sum of squared errors, and the gradient of scale/2 times it by the inputs.

        The gradients of the layers are added to `layer_gradients`.

        Args:
            inputs: inputs of the MLP (levels E + 1, columns).
            columns: the columns.
            scale: factor of the gradients.
        """
        gradient = self._scratch("gradient", self.architecture.inputs, inputs.shape[1])
        error = torch.zeros((), dtype=torch.float64, device=self.device)
        target = self.values[columns.ranks]
        for part in self._chunks(inputs.shape[1], CHUNK):
            activations = self._forward(inputs[:, part])
            residual = activations[-1][0] - target[part]
            if columns.in_coreset is not None:
                residual.mul_(columns.in_coreset[part])
            error += residual.square().sum(dtype=torch.float64)
            back = residual.mul_(scale).unsqueeze(0)
            for number in range(len(self.layers) - 1, -1, -1):
                self.layer_gradients[number].addmm_(back, activations[number].T)
                weight = self.layers[number][:, :-1]
                if number == 0:
                    torch.mm(weight.T, back, out=gradient[:, part])
                else:
                    down = self._scratch(f"back {number}", weight.shape[1], back.shape[1])
                    torch.mm(weight.T, back, out=down)
                    hidden = activations[number][:-1]
                    back = torch.ops.aten.threshold_backward.grad_input(
                        down, hidden, 0.0, grad_input=down
                    )
        return error, gradient

    def _scratch(self, name: str, rows: int, columns: int) -> Tensor:
        """Return an uninitialised matrix, in the same memory at every call with a name.

        Fresh pages would cost more than the arithmetic on them.
        """
        memory = self._scratch_memory.get(name)
        if memory is None or len(memory) < rows * columns:
            memory = self._scratch_memory[name] = torch.empty(rows * columns, device=self.device)
        return memory[: rows * columns].view(rows, columns)
