"""The slab engine: training and evaluation on the lattice by small separable matrix products, without gathering 16 corners a sample.

A training sample is a lattice vertex, so the finest level is one embedding of its own, and every coarser level is a separable linear
upsampling of a small sub-lattice. The unit of work is a brick of vertices of one key frame; a batch is a random set of bricks. The same
code runs on a CPU and on CUDA.

The finest embeddings live brick by brick, only for bricks that hold coreset vertices. Adam visits just the bricks of a batch, yet gives
what a dense Adam gives: a brick that was passed over takes its missing steps (whose gradient is zero) in closed form before it is used.
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
from fhash_codec.paper.engines.initial import Parameters, initial_parameters, layer_matrices
from fhash_codec.paper.engines.upsampling import Lattices, Upsampling
from fhash_codec.training.adam import adam_step, catch_up

CHUNK = 1 << 13  # columns of the MLP at a time: the hidden activations stay in a core's cache
ADAM_PART = 1 << 17  # numbers of the flat vector that Adam moves at a time
STATE = ("fine", "fine_mean", "fine_square", "visited", "flat", "flat_mean", "flat_square")
FLUSH = 1024  # bricks that are brought up to date at a time


class SlabEngine:
    """Trains and evaluates an F-Hash model on a coreset, a batch of bricks at a time."""

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
        """Fresh parameters from `seed`; `rates` as in `engines.Engine`; the coreset is copied to the device."""
        self.architecture, self.coreset, self.rates, self.device = (
            architecture,
            coreset,
            rates,
            device,
        )
        self.vertices = prod(coreset.brick_shape)
        self.bricks = torch.from_numpy(coreset.bricks.astype(np.int64)).to(device)
        self.mask_bits = torch.from_numpy(coreset.mask_bits).to(device)
        self.values = torch.from_numpy(coreset.values).to(device)
        self.offsets = torch.from_numpy(coreset.offsets).to(device)
        self._kept: dict[str, Tensor] = {}
        self.upsampling = Upsampling(architecture, coreset, device)

        start = initial_parameters(architecture, coreset, seed)
        self.fine = start.fine.to(device)
        self.fine_mean, self.fine_square = torch.zeros_like(self.fine), torch.zeros_like(self.fine)
        self.visited = torch.zeros(len(self.bricks), dtype=torch.int64, device=device)
        self.step = self.settled = 0
        # What is used of the coarse tables, and the MLP, in one flat vector, of which layers and gradients are views.
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
    def train(self, chosen: npt.NDArray[np.int64]) -> Tensor:
        """One Adam step on the bricks `chosen`; the sum of squared errors before it."""
        ids = torch.from_numpy(chosen).to(self.device)
        self.step += 1
        mean, square, fine = self._caught_up(ids, self.step - 1)
        target, mask = self._targets(ids)
        lattices = self.upsampling.lattices(self.bricks[ids])
        inputs = self._inputs(lattices, fine)
        scale = 2.0 / max(int(np.diff(self.coreset.offsets)[chosen].sum()), 1)
        self.gradient.zero_()
        error, gradient = self._fit(inputs, target, mask, scale)
        levels = gradient.view(
            -1, self.architecture.embedding_size, len(ids), *self.coreset.brick_shape
        )
        lattices.add_transposed(self.gradient, levels[1:])

        rate = float(self.rates[self.step])
        adam_step(fine, levels[0].flatten(2).transpose(0, 1), mean, square, self.step, rate)
        self._store(ids, mean, square, fine)
        self.visited[ids] = self.step
        # In parts, so that what is computed on the way stays in the cache.
        for first in range(0, len(self.flat), ADAM_PART):
            held = slice(first, first + ADAM_PART)
            adam_step(
                self.flat[held],
                self.gradient[held],
                self.flat_mean[held],
                self.flat_square[held],
                self.step,
                rate,
            )
        return error

    @torch.no_grad()
    def infer(self, chosen: npt.NDArray[np.int64]) -> Tensor:
        """Values (bricks, vertices) of the bricks `chosen` at all their vertices."""
        ids = torch.from_numpy(chosen).to(self.device)
        fine = self.fine[ids] if self.settled == self.step else self._caught_up(ids, self.step)[2]
        lattices = self.upsampling.lattices(self.bricks[ids])
        return self._value(self._inputs(lattices, fine)).view(len(ids), self.vertices)

    @torch.no_grad()
    def squared_error(self, chosen: npt.NDArray[np.int64]) -> float:
        """Sum of squared errors over the coreset vertices of the bricks `chosen`."""
        target, mask = self._targets(torch.from_numpy(chosen).to(self.device))
        return float(((self.infer(chosen) - target) * mask).square().sum(dtype=torch.float64))

    @torch.no_grad()
    def settle(self) -> None:
        """Bring every brick to the present step; until the next step, evaluation is faster for it."""
        for first in range(0, len(self.bricks), FLUSH):
            ids = torch.arange(first, min(first + FLUSH, len(self.bricks)), device=self.device)
            self._store(ids, *self._caught_up(ids, self.step))
        self.visited.masked_fill_(self.visited > 0, self.step)
        self.settled = self.step

    @torch.no_grad()
    def parameters(self) -> Parameters:
        """The trained numbers, on the CPU, where the finest are the engine's own; embeddings that no sample ever moved are 0."""
        self.settle()
        for first in range(0, len(self.fine), FLUSH):
            part = slice(first, first + FLUSH)
            self.fine[part].masked_fill_(self._mask(part).unsqueeze(1) == 0, 0.0)
        coarse = torch.zeros(
            sum(prod(level) for level in self.architecture.levels[1:])
            * self.architecture.embedding_size
        )
        moved = (self.flat_mean != 0) | (self.flat_square != 0)
        kept = (
            torch.where(moved, self.flat, 0.0)[: self.coarse]
            if self.step
            else self.flat[: self.coarse]
        )
        coarse[self.upsampling.used.cpu()] = kept.cpu()
        return Parameters(
            fine=self.fine.cpu(), coarse=coarse, network=self.flat[self.coarse :].cpu().clone()
        )

    def state(self) -> dict[str, npt.NDArray[np.generic]]:
        """Everything that the next step depends on, as arrays."""
        return {"step": np.array(self.step)} | {
            name: getattr(self, name).cpu().numpy() for name in STATE
        }

    def restore(self, state: Mapping[str, npt.NDArray[np.generic]]) -> None:
        """Go on from `state`; raises KeyError or RuntimeError for a state of another model."""
        self.step, self.settled = int(state["step"]), -1
        for name in STATE:
            getattr(self, name).copy_(torch.from_numpy(state[name]))

    def _store(self, ids: Tensor, mean: Tensor, square: Tensor, fine: Tensor) -> None:
        for state, rows in ((self.fine_mean, mean), (self.fine_square, square), (self.fine, fine)):
            state.index_copy_(0, ids, rows)

    def _caught_up(self, ids: Tensor, step: int) -> tuple[Tensor, Tensor, Tensor]:
        """Adam's mean and square and the embeddings of bricks as a dense Adam has them after `step`."""
        mean, square, fine = self.fine_mean[ids], self.fine_square[ids], self.fine[ids]
        factor, epsilon, mean_decay, square_decay = (
            torch.from_numpy(column).to(self.device)[:, None, None]
            for column in catch_up(self.visited[ids].cpu().numpy(), step, self.rates)
        )
        fine.addcdiv_(mean * factor, square.sqrt().add_(epsilon), value=-1.0)
        return mean.mul_(mean_decay), square.mul_(square_decay), fine

    def _targets(self, ids: Tensor) -> tuple[Tensor, Tensor]:
        """Normalised values (bricks, vertices), anything outside the coreset, and the coreset mask as 0 and 1."""
        mask = self._mask(ids)
        rank = mask.cumsum(1, dtype=torch.int64).add_(self.offsets[ids].unsqueeze(1) - 1).clamp_(0)
        return self.values[rank], mask

    def _mask(self, ids: Tensor | slice) -> Tensor:
        """Coreset vertices (bricks, vertices) as 0 and 1, uint8."""
        bits = torch.arange(7, -1, -1, device=self.device, dtype=torch.uint8)
        return (self.mask_bits[ids].unsqueeze(-1) >> bits & 1).flatten(1)[:, : self.vertices]

    def _inputs(self, lattices: Lattices, fine: Tensor) -> Tensor:
        """Inputs of the MLP (levels E + 1, samples) at the vertices of bricks, given their finest embeddings (bricks, E, vertices).

        The last row is 1: the layers' biases are one more column of their matrices. Overwritten by the next call.
        """
        size, shape = self.architecture.embedding_size, self.coreset.brick_shape
        inputs = self._scratch("inputs", self.architecture.inputs + 1, len(fine) * self.vertices)
        inputs[-1] = 1.0
        levels = inputs[:-1].view(-1, size, len(fine), *shape)
        levels[0].copy_(fine.view(len(fine), size, *shape).transpose(0, 1))
        lattices.interpolate(self.flat, levels[1:])
        return inputs

    def _value(self, inputs: Tensor) -> Tensor:
        """Output of the MLP (samples,)."""
        result = torch.empty(inputs.shape[1], device=self.device)
        for first in range(0, len(result), CHUNK):
            activations = self._forward(inputs[:, first : first + CHUNK])
            result[first : first + CHUNK] = activations[-1][0]
        return result

    def _forward(self, inputs: Tensor) -> list[Tensor]:
        """Activations of each layer, from the inputs to the output, for at most CHUNK samples; overwritten by the next call."""
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

    def _fit(
        self, inputs: Tensor, target: Tensor, mask: Tensor, scale: float
    ) -> tuple[Tensor, Tensor]:
        """Sum of squared errors, and the gradient of `scale`/2 times it by the inputs; the MLP's gradients are added to theirs."""
        gradient = self._scratch("gradient", self.architecture.inputs, inputs.shape[1])
        error = torch.zeros((), dtype=torch.float64, device=self.device)
        flat_target, flat_mask = target.reshape(-1), mask.reshape(-1)
        for first in range(0, inputs.shape[1], CHUNK):
            part = slice(first, first + CHUNK)
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
        """A matrix to write in, the same memory at every call: fresh pages would cost more than the arithmetic on them."""
        kept = self._kept.get(name)
        if kept is None or len(kept) < rows * columns:
            kept = self._kept[name] = torch.empty(rows * columns, device=self.device)
        return kept[: rows * columns].view(rows, columns)
