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
from math import prod
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from fhash_codec.features.bricks import Coreset
from fhash_codec.paper.engines.parameters import (
    Chosen,
    Lattices,
    Parameters,
    Upsampling,
    adam_step,
    catch_up,
    catch_up_numbers,
    check_state,
    initial_parameters,
    layer_matrices,
    true_positions,
)
from fhash_codec.paper.network import Architecture


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


LIBRARIES = 1 << 28
"""Bytes for the libraries of CUDA: their code and the workspaces of matrix products."""
UNEVEN = 2
"""Largest number of bricks of a batch, as a multiple of the mean: batches have as many samples."""


def needed_bytes(architecture: Architecture, coreset: Coreset, batches: int) -> int:
    """Return about how many bytes a training takes, rather too many than too few.

    Args:
        architecture: the sizes of the model.
        coreset: the training samples.
        batches: batches of an epoch.
    """
    bricks, vertices = len(coreset.bricks), prod(coreset.brick_shape)
    samples = len(coreset.values) + 1
    size = architecture.embedding_size
    coarse = architecture.coarse_numbers
    network = sum(outputs * (inputs + 1) for outputs, inputs in architecture.layer_shapes)
    # Embeddings, mean and square of the finest level; values, masks, offsets and coordinates.
    held = 12 * size * samples + 4 * samples + coreset.mask_bits.nbytes
    held += bricks * (8 + 4 * 8)
    # Four vectors of the numbers in use, their places, rank, mask, and the initial tables.
    held += coarse * (4 * 4 + 8 + 4 + 1 + 4) + 16 * network
    batch = min(UNEVEN * -(-bricks // batches), bricks)
    return LIBRARIES + held + batch * vertices * _bytes_a_vertex(architecture)


def _bytes_a_vertex(architecture: Architecture) -> int:
    """Return the bytes that a training step holds for each vertex of its bricks."""
    inputs = architecture.inputs
    hidden = sum(outputs + 1 for outputs, _ in architecture.layer_shapes[:-1])
    # Inputs and their gradients, each also for samples alone; activations and their gradients.
    numbers = 4 * (inputs + 1) + 2 * hidden
    # Rows of the finest level, what Adam makes of them and the effect of missed steps, products of
    # the interpolation, target, residual and its square.
    numbers += 7 * architecture.embedding_size + 4 + 3 * architecture.embedding_size + 4
    # Mask, its bits and sums, ranks, places of the samples and their bricks.
    return 4 * numbers + 2 + 5 * 8


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
        device: torch.device,
    ) -> None:
        """Start from fresh parameters; arguments as in `make_engine`.

        The coreset is copied to the device.
        """
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
        self.fine.copy_(start.fine)
        self.visited = np.zeros(len(self.bricks), dtype=np.int64)
        self.step = self.settled = 0
        self.coarse = len(self.upsampling.used)
        self.flat = torch.cat(
            [start.coarse.to(device)[self.upsampling.used], start.network.to(device)]
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
    def infer(self, chosen: Chosen) -> Tensor:
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
        if columns.in_coreset is None:
            return values
        return values[true_positions(columns.in_coreset, count)]

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
        coarse = torch.zeros(self.architecture.coarse_numbers)
        moved = (self.flat_mean != 0) | (self.flat_square != 0)
        used = torch.where(moved, self.flat, 0.0) if self.step else self.flat
        coarse[self.upsampling.used.cpu()] = used[: self.coarse].cpu()
        return Parameters(
            fine=self.fine.cpu(), coarse=coarse, network=self.flat[self.coarse :].cpu().clone()
        )

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
        levels, size = len(self.architecture.levels) - 1, self.architecture.embedding_size
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
