"""The slab engine: training and evaluation on the lattice by small separable matrix products, without gathering 16 corners a sample.

A training sample is a lattice vertex, so the finest level is one embedding of its own, and every coarser level is a separable linear
upsampling of a small sub-lattice. The unit of work is a brick of vertices of one key frame; a batch is a random set of bricks. The same
code runs on a CPU and on CUDA.

The finest embeddings live brick by brick, only for bricks that hold coreset vertices. Adam visits just the bricks of a batch, yet gives
what a dense Adam gives: a brick that was passed over takes its missing steps (whose gradient is zero) in closed form before it is used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import prod

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from fhash_codec.architecture import Architecture
from fhash_codec.coreset import Coreset
from fhash_codec.engines.adam import BETA1, BETA2, EPSILON, catch_up
from fhash_codec.engines.initial import Parameters, initial_parameters, split
from fhash_codec.levels import Resolution

CHUNK = 1 << 14  # columns of the MLP at a time: the hidden activations stay in a core's cache
FLUSH = 1024  # bricks that are brought up to date at a time


@dataclass(frozen=True)
class _Upsampling:
    """How the bricks' vertices of one coarse level follow from a sub-lattice of its table, axis by axis.

    start: first corner of the sub-lattice, int64 per key frame or brick coordinate of each axis (t, z, y, x).
    weight: matrices (coordinates, vertices of a brick, corners of the sub-lattice) of each axis; one row per key frame for time.
    offset: positions (corners t z y, E, corners x) of the sub-lattice in the flat table, relative to its first number.
    """

    start: tuple[Tensor, ...]
    weight: tuple[Tensor, ...]
    offset: Tensor
    stride: tuple[int, int, int, int]


class SlabEngine:
    """Trains and evaluates an F-Hash model on a coreset, a batch of bricks at a time."""

    name = "slab"

    def __init__(
        self, architecture: Architecture, coreset: Coreset, rates: npt.NDArray[np.float64], *, seed: int, device: torch.device
    ) -> None:
        """Fresh parameters from `seed`; `rates` as in `engines.Engine`; the coreset is copied to the device."""
        self.architecture, self.coreset, self.rates, self.device = architecture, coreset, rates, device
        self.vertices = prod(coreset.brick_shape)
        self.bricks = torch.from_numpy(coreset.bricks.astype(np.int64)).to(device)
        self.mask_bits = torch.from_numpy(coreset.mask_bits).to(device)
        self.values = torch.from_numpy(coreset.values).to(device)
        self.offsets = torch.from_numpy(coreset.offsets).to(device)
        self.upsamplings = [_upsampling(architecture, level, coreset, device) for level in architecture.levels[1:]]

        start = initial_parameters(architecture, coreset, seed)
        self.fine = start.fine.to(device)
        self.fine_mean, self.fine_square = torch.zeros_like(self.fine), torch.zeros_like(self.fine)
        self.visited = torch.zeros(len(self.bricks), dtype=torch.int64, device=device)
        self.step = 0
        # Coarse tables and MLP in one flat vector: one fused Adam call, and each gradient is a view.
        self.flat = start.flat.to(device)
        self.flat.grad = torch.zeros_like(self.flat)
        self.tables, self.layers = split(architecture, self.flat.detach())
        self.table_gradients, self.layer_gradients = split(architecture, self.flat.grad)
        self.adam = torch.optim.Adam([self.flat], betas=(BETA1, BETA2), eps=EPSILON, fused=True)

    @torch.no_grad()
    def train(self, chosen: npt.NDArray[np.int64]) -> Tensor:
        """One Adam step on the bricks `chosen`; the sum of squared errors before it."""
        ids = torch.from_numpy(chosen).to(self.device)
        self.step += 1
        mean, square, fine = self._caught_up(ids, self.step - 1)
        target, mask = self._targets(ids)
        inputs = self._inputs(ids, fine)
        scale = 2.0 / max(int(np.diff(self.coreset.offsets)[chosen].sum()), 1)
        assert self.flat.grad is not None
        self.flat.grad.zero_()
        error, gradient = self._fit(inputs, target, mask, scale)
        self._scatter(ids, gradient)

        own = gradient[: self.architecture.embedding_size].view(-1, len(ids), self.vertices).transpose(0, 1)
        mean.mul_(BETA1).add_(own, alpha=1 - BETA1)
        square.mul_(BETA2).addcmul_(own, own, value=1 - BETA2)
        rate = float(self.rates[self.step])
        root = square.sqrt().mul_(1 / (1 - BETA2**self.step) ** 0.5).add_(EPSILON)
        fine.addcdiv_(mean, root, value=-rate / (1 - BETA1**self.step))
        self._store(ids, mean, square, fine)
        self.visited[ids] = self.step
        self.adam.param_groups[0]["lr"] = rate
        self.adam.step()
        return error

    @torch.no_grad()
    def infer(self, chosen: npt.NDArray[np.int64]) -> Tensor:
        """Values (bricks, vertices) of the bricks `chosen` at all their vertices."""
        ids = torch.from_numpy(chosen).to(self.device)
        _, _, fine = self._caught_up(ids, self.step)
        return self._value(self._inputs(ids, fine)).view(len(ids), self.vertices)

    @torch.no_grad()
    def squared_error(self, chosen: npt.NDArray[np.int64]) -> float:
        """Sum of squared errors over the coreset vertices of the bricks `chosen`."""
        target, mask = self._targets(torch.from_numpy(chosen).to(self.device))
        return float(((self.infer(chosen) - target) * mask).square().sum(dtype=torch.float64))

    @torch.no_grad()
    def parameters(self) -> Parameters:
        """The trained numbers, on the CPU; embeddings that no sample ever moved are 0."""
        for first in range(0, len(self.bricks), FLUSH):
            ids = torch.arange(first, min(first + FLUSH, len(self.bricks)), device=self.device)
            self._store(ids, *self._caught_up(ids, self.step))
        self.visited.masked_fill_(self.visited > 0, self.step)
        fine, flat = self.fine.clone(), self.flat.detach().clone()
        fine.masked_fill_(~self._mask(torch.arange(len(fine), device=self.device)).unsqueeze(1).bool(), 0.0)
        if self.step > 0:
            adam = self.adam.state[self.flat]
            moved = (adam["exp_avg"] != 0) | (adam["exp_avg_sq"] != 0)
            coarse = sum(len(table) for table in self.tables)
            flat[:coarse] *= moved[:coarse]
        return Parameters(fine=fine.cpu(), flat=flat.cpu())

    def state(self) -> dict[str, npt.NDArray[np.generic]]:
        """Everything that the next step depends on, as arrays."""
        adam = self.adam.state[self.flat]
        flat_mean = adam["exp_avg"] if adam else torch.zeros_like(self.flat)
        flat_square = adam["exp_avg_sq"] if adam else torch.zeros_like(self.flat)
        tensors = {
            "fine": self.fine,
            "fine_mean": self.fine_mean,
            "fine_square": self.fine_square,
            "visited": self.visited,
            "flat": self.flat,
            "flat_mean": flat_mean,
            "flat_square": flat_square,
        }
        return {"step": np.array(self.step)} | {name: tensor.detach().cpu().numpy() for name, tensor in tensors.items()}

    def restore(self, state: Mapping[str, npt.NDArray[np.generic]]) -> None:
        """Go on from `state`."""
        self.step = int(state["step"])
        for name in ("fine", "fine_mean", "fine_square", "visited", "flat"):
            getattr(self, name).copy_(torch.from_numpy(state[name]))
        self.adam.state[self.flat] = {
            "step": torch.tensor(float(self.step), device=self.device),
            "exp_avg": torch.from_numpy(state["flat_mean"].copy()).to(self.device),
            "exp_avg_sq": torch.from_numpy(state["flat_square"].copy()).to(self.device),
        }

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

    def _mask(self, ids: Tensor) -> Tensor:
        """Coreset vertices (bricks, vertices) as 0 and 1, uint8."""
        bits = torch.arange(7, -1, -1, device=self.device, dtype=torch.uint8)
        return (self.mask_bits[ids].unsqueeze(-1) >> bits & 1).flatten(1)[:, : self.vertices]

    def _inputs(self, ids: Tensor, fine: Tensor) -> Tensor:
        """Inputs of the MLP (levels E, samples) at the vertices of bricks, given their finest embeddings (bricks, E, vertices)."""
        size = self.architecture.embedding_size
        inputs = torch.empty(self.architecture.inputs, len(ids) * self.vertices, device=self.device)
        levels = inputs.view(-1, size, len(ids), *self.coreset.brick_shape)
        levels[0].copy_(fine.view(len(ids), size, *self.coreset.brick_shape).transpose(0, 1))
        coordinates = self.bricks[ids].unbind(1)
        for number, (table, upsampling) in enumerate(zip(self.tables, self.upsamplings, strict=True), start=1):
            levels[number].copy_(_upsample(table, upsampling, coordinates, size).permute(3, 0, 1, 2, 4))
        return inputs

    def _scatter(self, ids: Tensor, gradient: Tensor) -> None:
        """Add the gradient of the MLP's inputs to those of the coarse tables: the transpose of `_inputs`."""
        size = self.architecture.embedding_size
        levels = gradient.view(-1, size, len(ids), *self.coreset.brick_shape)
        coordinates = self.bricks[ids].unbind(1)
        for number, (table, upsampling) in enumerate(zip(self.table_gradients, self.upsamplings, strict=True), start=1):
            _upsample_transposed(table, upsampling, coordinates, levels[number].permute(1, 2, 3, 0, 4))

    def _value(self, inputs: Tensor) -> Tensor:
        """Output of the MLP (samples,)."""
        result = torch.empty(inputs.shape[1], device=self.device)
        for first in range(0, len(result), CHUNK):
            hidden = inputs[:, first : first + CHUNK]
            for number, (weight, bias) in enumerate(self.layers):
                hidden = torch.addmm(bias.unsqueeze(1), weight, hidden if number == 0 else hidden.relu_())
            result[first : first + CHUNK] = hidden[0]
        return result

    def _fit(self, inputs: Tensor, target: Tensor, mask: Tensor, scale: float) -> tuple[Tensor, Tensor]:
        """Sum of squared errors, and the gradient of `scale`/2 times it by the inputs; the MLP's gradients are added to theirs."""
        gradient = torch.empty_like(inputs)
        error = torch.zeros((), dtype=torch.float64, device=self.device)
        flat_target, flat_mask = target.view(-1), mask.view(-1)
        for first in range(0, inputs.shape[1], CHUNK):
            part = slice(first, first + CHUNK)
            activations = [inputs[:, part]]
            for number, (weight, bias) in enumerate(self.layers):
                out = torch.addmm(bias.unsqueeze(1), weight, activations[-1])
                activations.append(out if number == len(self.layers) - 1 else out.relu_())
            residual = (activations[-1][0] - flat_target[part]).mul_(flat_mask[part])
            error += residual.square().sum(dtype=torch.float64)
            back = residual.mul_(scale).unsqueeze(0)
            for number in range(len(self.layers) - 1, -1, -1):
                weight_gradient, bias_gradient = self.layer_gradients[number]
                weight_gradient.addmm_(back, activations[number].T)
                bias_gradient.add_(back.sum(1))
                weight = self.layers[number][0]
                if number == 0:
                    torch.mm(weight.T, back, out=gradient[:, part])
                else:
                    back = torch.ops.aten.threshold_backward(weight.T @ back, activations[number], 0.0)
        return error, gradient


def _axis(size: int, corners: int, length: int, count: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float32]]:
    """First corner (count,) and weights (count, length, sub-lattice) of `count` runs of `length` vertices of an axis of `size`.

    Vertices past the end repeat the last one. Corners align (tesseract.locate).
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
    return start, weight.astype(np.float32)


def _upsampling(architecture: Architecture, level: Resolution, coreset: Coreset, device: torch.device) -> _Upsampling:
    lengths, counts = (1, *coreset.brick_shape), (architecture.key_frames, *coreset.brick_grid)
    axes = [_axis(s, r, n, c) for s, r, n, c in zip(architecture.sizes, level, lengths, counts, strict=True)]
    size = architecture.embedding_size
    stride = (prod(level[1:]) * size, prod(level[2:]) * size, level[3] * size, size)
    wide = [np.arange(weight.shape[2]) for _, weight in axes]
    t, z, y, e, x = np.ix_(wide[0] * stride[0], wide[1] * stride[1], wide[2] * stride[2], np.arange(size), wide[3] * stride[3])
    offset = torch.from_numpy((t + z + y + e + x).reshape(-1)).to(device)
    starts = tuple(torch.from_numpy(start).to(device) for start, _ in axes)
    weights = tuple(torch.from_numpy(weight).to(device) for _, weight in axes)
    return _Upsampling(start=starts, weight=weights, offset=offset, stride=stride)


def _matrices(upsampling: _Upsampling, coordinates: tuple[Tensor, ...]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Positions (bricks, numbers) of the sub-lattices in the flat table, and the matrices of t and z together, y, and x."""
    base = sum(start[c] * s for start, c, s in zip(upsampling.start, coordinates, upsampling.stride, strict=True))
    wt, wz, wy, wx = (weight[c] for weight, c in zip(upsampling.weight, coordinates, strict=True))
    # (bricks, z, corners t, corners z) flattened: time is one more factor of the product along z.
    wtz = (wt.unsqueeze(-1) * wz.unsqueeze(2)).flatten(2)
    assert isinstance(base, Tensor)
    return base.unsqueeze(1) + upsampling.offset, wtz, wy, wx


def _upsample(table: Tensor, upsampling: _Upsampling, coordinates: tuple[Tensor, ...], size: int) -> Tensor:
    """Embeddings (bricks, z, y, E, x) of one coarse level."""
    index, wtz, wy, wx = _matrices(upsampling, coordinates)
    lattice = table[index].view(len(index), wtz.shape[2], -1)
    planes = torch.bmm(wtz, lattice).view(len(index), wtz.shape[1], wy.shape[2], -1)
    rows = torch.matmul(wy.unsqueeze(1), planes)
    bricks, z, y, _ = rows.shape
    columns = torch.bmm(rows.view(bricks, z * y * size, wx.shape[2]), wx.transpose(1, 2))
    return columns.view(bricks, z, y, size, -1)


def _upsample_transposed(gradient: Tensor, upsampling: _Upsampling, coordinates: tuple[Tensor, ...], columns: Tensor) -> None:
    """Add to a flat table's gradient what gradients (bricks, z, y, E, x) of its embeddings give."""
    index, wtz, wy, wx = _matrices(upsampling, coordinates)
    bricks, z, y, size, _ = columns.shape
    rows = torch.bmm(columns.reshape(bricks, z * y * size, -1), wx).view(bricks, z, y, -1)
    planes = torch.matmul(wy.transpose(1, 2).unsqueeze(1), rows)
    lattice = torch.bmm(wtz.transpose(1, 2), planes.reshape(bricks, z, -1))
    gradient.index_add_(0, index.view(-1), lattice.view(-1))
