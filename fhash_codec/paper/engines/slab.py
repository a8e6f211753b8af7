"""The slab engine: training and evaluation on the lattice by small separable matrix products.

A training sample is a lattice vertex. Its embedding at the finest level is therefore one entry of
the table, and every coarser level is a separable linear upsampling of a small sub-lattice; no 16
corners are looked up per sample. The unit of work is a brick of vertices of one key frame, and a
batch is a random set of bricks. The same code runs on a CPU and on CUDA; there the host never waits
for a step, sends it one message (sending.py), and launches it as one graph (graphs.py).

The finest embeddings are stored brick by brick, only for bricks that hold coreset vertices. Adam
visits just the bricks of a batch, yet gives what a dense Adam gives: a brick that was passed over
catches up on its missing steps, whose gradient is zero, in closed form before it is used
(`training.adam.catch_up`).
"""

from __future__ import annotations

from collections.abc import Mapping
from math import prod

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.engines import Chosen
from fhash_codec.paper.engines.graphs import StepGraphs
from fhash_codec.paper.engines.initial import (
    Parameters,
    check_state,
    initial_parameters,
    layer_matrices,
)
from fhash_codec.paper.engines.sending import Sender, Sent
from fhash_codec.paper.engines.upsampling import Lattices, Upsampling
from fhash_codec.training.adam import adam_step, adam_step_on_device, catch_up, corrections
from fhash_codec.training.positions import true_positions

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
        fine: finest embeddings (bricks, E, vertices of a brick); `fine_mean` and `fine_square` are
            their moments of Adam.
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
        self.values = torch.from_numpy(coreset.values).to(device)
        self.offsets = torch.from_numpy(coreset.offsets).to(device)
        self._bits = torch.arange(7, -1, -1, device=device, dtype=torch.uint8)
        self._scratch_memory: dict[str, Tensor] = {}
        self._sender, self._graphs = Sender(device), StepGraphs()
        self.upsampling = Upsampling(architecture, coreset, device)

        start = initial_parameters(architecture, coreset, seed)
        self.fine = start.fine.to(device)
        self.fine_mean, self.fine_square = torch.zeros_like(self.fine), torch.zeros_like(self.fine)
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
        self.step += 1
        sent = self._sender.send(
            chosen,
            catch_up(self.visited[chosen], self.step - 1, self.rates),
            (*corrections(self.step, float(self.rates[self.step])), 2.0 / max(samples, 1)),
        )
        if self.on_cpu:
            error = self._step(sent, samples)
        else:
            picked = samples if self._is_sparse(samples, len(chosen)) else None
            error = self._graphs.run((len(chosen), picked), lambda: self._step(sent, samples))
        self.visited[chosen] = self.step
        return error

    def _step(self, sent: Sent, samples: int) -> Tensor:
        """Do a training step on the device; return the sum of squared errors before it.

        Args:
            sent: the batch.
            samples: samples of the batch.
        """
        mean, square, fine = self._caught_up(sent)
        target, in_coreset = self._targets(sent.ids)
        lattices = self.upsampling.lattices(self.bricks[sent.ids])
        inputs = self._inputs(lattices, fine)
        self.gradient.zero_()
        error, input_gradient = self._backpropagate_samples(
            inputs, target, in_coreset, samples, sent.scale
        )
        level_gradients = input_gradient.view(
            -1, self.architecture.embedding_size, len(fine), *self.coreset.brick_shape
        )
        lattices.add_transposed(self.gradient, level_gradients[1:])

        fine_gradient = level_gradients[0].flatten(2).transpose(0, 1)
        self._move((fine, fine_gradient, mean, square), sent)
        vectors = (self.flat, self.gradient, self.flat_mean, self.flat_square)
        for part in self._parts(len(self.flat), ADAM_PART):
            self._move(tuple(vector[part] for vector in vectors), sent)
        self._store(sent.ids, mean, square, fine)
        return error

    @torch.no_grad()
    def infer(self, chosen: Chosen) -> Tensor:
        """Return the values (n,) at the samples of some bricks."""
        sent = self._sent(chosen)
        fine = self.fine[sent.ids] if self.settled == self.step else self._caught_up(sent)[2]
        lattices = self.upsampling.lattices(self.bricks[sent.ids])
        inputs = self._inputs(lattices, fine)
        in_coreset, count = self._in_coreset(sent.ids).reshape(-1), int(self.counts[chosen].sum())
        samples = true_positions(in_coreset, count)
        if not self._is_sparse(count, len(chosen)):
            return self._value(inputs)[samples]
        # Only samples go through the MLP where the bricks are sparse.
        return self._value(self._picked(inputs, samples))

    @torch.no_grad()
    def settle(self) -> None:
        """Let every brick catch up with the present step, so that evaluation is faster."""
        for first in range(0, len(self.bricks), FLUSH):
            sent = self._sent(np.arange(first, min(first + FLUSH, len(self.bricks))))
            self._store(sent.ids, *self._caught_up(sent))
        self.visited[self.visited > 0] = self.step
        self.settled = self.step

    @torch.no_grad()
    def parameters(self) -> Parameters:
        """Return the trained numbers, on the CPU. Embeddings that no sample ever moved are 0.

        On a CPU the finest embeddings are the engine's own memory, not a copy.
        """
        self.settle()
        for first in range(0, len(self.fine), FLUSH):
            part = slice(first, first + FLUSH)
            self.fine[part].masked_fill_(self._in_coreset(part).unsqueeze(1) == 0, 0.0)
        coarse = torch.zeros(
            sum(prod(level) for level in self.architecture.levels[1:])
            * self.architecture.embedding_size
        )
        moved = (self.flat_mean != 0) | (self.flat_square != 0)
        used = (
            torch.where(moved, self.flat, 0.0)[: self.coarse]
            if self.step
            else self.flat[: self.coarse]
        )
        coarse[self.upsampling.used.cpu()] = used.cpu()
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

    def _store(self, ids: Tensor, mean: Tensor, square: Tensor, fine: Tensor) -> None:
        """Write the finest embeddings of bricks, and their moments, back into the full arrays."""
        for array, rows in ((self.fine_mean, mean), (self.fine_square, square), (self.fine, fine)):
            array.index_copy_(0, ids, rows)

    def _sent(self, chosen: Chosen) -> Sent:
        """Return bricks on the device, with what they missed up to the present step."""
        return self._sender.send(chosen, catch_up(self.visited[chosen], self.step, self.rates))

    def _caught_up(self, sent: Sent) -> tuple[Tensor, Tensor, Tensor]:
        """Return what a dense Adam has for bricks that missed steps: mean, square, embeddings."""
        mean, square, fine = (
            array[sent.ids] for array in (self.fine_mean, self.fine_square, self.fine)
        )
        factor, epsilon, mean_decay, square_decay = sent.caught_up.unbind()
        fine.addcdiv_(mean * factor, square.sqrt().add_(epsilon), value=-1.0)
        return mean.mul_(mean_decay), square.mul_(square_decay), fine

    def _is_sparse(self, samples: int, bricks: int) -> bool:
        """Return whether a batch has so few samples that the MLP takes them alone."""
        return samples <= FULL * bricks * self.vertices

    def _targets(self, ids: Tensor) -> tuple[Tensor, Tensor]:
        """Return the samples of bricks, and the vertices that are samples, (bricks, vertices).

        The samples are normalised values, arbitrary outside the coreset. The mask is 0 or 1, uint8.
        """
        in_coreset = self._in_coreset(ids)
        rank = (
            in_coreset.cumsum(1, dtype=torch.int64)
            .add_(self.offsets[ids].unsqueeze(1) - 1)
            .clamp_(0)
        )
        return self.values[rank], in_coreset

    def _in_coreset(self, ids: Tensor | slice) -> Tensor:
        """Return which vertices (bricks, vertices) are in the coreset, as 0 and 1, uint8."""
        return (self.mask_bits[ids].unsqueeze(-1) >> self._bits & 1).flatten(1)[:, : self.vertices]

    def _inputs(self, lattices: Lattices, fine: Tensor) -> Tensor:
        """Return the inputs of the MLP (levels E + 1, samples) at the vertices of bricks.

        The last row is 1: the layers' biases are one more column of their matrices. The next call
        overwrites the result.

        Args:
            lattices: the sub-lattices of the bricks.
            fine: finest embeddings of the bricks (bricks, E, vertices).
        """
        size, shape = self.architecture.embedding_size, self.coreset.brick_shape
        inputs = self._scratch("inputs", self.architecture.inputs + 1, len(fine) * self.vertices)
        inputs[-1] = 1.0
        levels = inputs[:-1].view(-1, size, len(fine), *shape)
        levels[0].copy_(fine.view(len(fine), size, *shape).transpose(0, 1))
        lattices.interpolate(self.flat, levels[1:])
        return inputs

    def _picked(self, inputs: Tensor, samples: Tensor) -> Tensor:
        """Return the columns of some samples; the next call overwrites them."""
        picked = self._scratch("picked inputs", len(inputs), len(samples))
        torch.index_select(inputs, 1, samples, out=picked)
        return picked

    def _value(self, inputs: Tensor) -> Tensor:
        """Return the output of the MLP (samples,)."""
        result = torch.empty(inputs.shape[1], device=self.device)
        for part in self._parts(len(result), CHUNK):
            result[part] = self._forward(inputs[:, part])[-1][0]
        return result

    def _parts(self, count: int, most: int) -> list[slice]:
        """Return slices of `count` numbers, each of at most `most` on a CPU; one of all on CUDA."""
        size = most if self.on_cpu else max(count, 1)
        return [slice(first, first + size) for first in range(0, count, size)]

    def _move(self, tensors: tuple[Tensor, ...], sent: Sent) -> None:
        """Do a step of Adam on parameters, their gradient and its moments."""
        parameter, gradient, mean, square = tensors
        if self.on_cpu:
            rate = float(self.rates[self.step])
            adam_step(parameter, gradient, mean, square, self.step, rate)
        else:
            adam_step_on_device(parameter, gradient, mean, square, sent.correction, sent.pace)

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

    def _backpropagate_samples(
        self, inputs: Tensor, target: Tensor, in_coreset: Tensor, count: int, scale: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Do what `_backpropagate` does, through the `count` samples of sparse bricks alone.

        Around a feature most vertices of many bricks are no samples.
        """
        if not self._is_sparse(count, len(in_coreset)):
            return self._backpropagate(inputs, target, in_coreset, scale)
        flat_mask = in_coreset.reshape(-1)
        samples = true_positions(flat_mask, count)
        error, gradient = self._backpropagate(
            self._picked(inputs, samples), target.reshape(-1)[samples], flat_mask[samples], scale
        )
        whole = self._scratch("whole gradient", len(gradient), inputs.shape[1]).zero_()
        return error, whole.index_copy_(1, samples, gradient)

    def _backpropagate(
        self, inputs: Tensor, target: Tensor, in_coreset: Tensor, scale: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the sum of squared errors, and the gradient of scale/2 times it by the inputs.

        The gradients of the layers are added to `layer_gradients`.

        Args:
            inputs: inputs of the MLP (levels E + 1, samples).
            target: normalised values, as many as there are columns, of any shape.
            in_coreset: which of them are samples, of the same shape, 0 or 1.
            scale: factor of the gradients, of no axis.
        """
        gradient = self._scratch("gradient", self.architecture.inputs, inputs.shape[1])
        error = torch.zeros((), dtype=torch.float64, device=self.device)
        flat_target, flat_mask = target.reshape(-1), in_coreset.reshape(-1)
        for part in self._parts(inputs.shape[1], CHUNK):
            activations = self._forward(inputs[:, part])
            residual = (activations[-1][0] - flat_target[part]).mul_(flat_mask[part])
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
        """Return an uninitialised matrix, on a CPU in the same memory at every call with a name.

        Fresh pages would cost more than the arithmetic on them. On CUDA torch keeps freed memory
        itself, and a captured graph must not refer to memory that a larger batch replaces.
        """
        if not self.on_cpu:
            return torch.empty(rows, columns, device=self.device)
        memory = self._scratch_memory.get(name)
        if memory is None or len(memory) < rows * columns:
            memory = self._scratch_memory[name] = torch.empty(rows * columns, device=self.device)
        return memory[: rows * columns].view(rows, columns)
