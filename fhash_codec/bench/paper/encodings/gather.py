"""The gather engine: any tables that look up corners, trained by Adam in plain PyTorch.

Training places are lattice vertices, so the corners around them and their weights are computed once
and kept, where they fit into memory. Then a step is a weighted sum of embeddings, a small network,
and the same sums backwards. Every encoding can be trained so, and then differs from the others by
its tables alone.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from fhash_codec.bench.paper.encodings.corners import Level
from fhash_codec.bench.paper.encodings.encoding import EMBEDDING_SIZE, HIDDEN_LAYERS, WIDTH
from fhash_codec.bench.paper.encodings.places import sample_places
from fhash_codec.features.bricks import Coreset
from fhash_codec.paper.engines.parameters import SPREAD, adam_step

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
        gradients = self.gradients(self.coreset.places(chosen))
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
        encoded: Tensor = WeightedSum.apply(  # type: ignore[no-untyped-call]
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
