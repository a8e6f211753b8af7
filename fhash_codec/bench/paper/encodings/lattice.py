"""The product's engine for dense grids and F-Hash: training on whole bricks of the lattice."""

from __future__ import annotations

from collections.abc import Sequence
from math import prod

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from fhash_codec.bench.paper.encodings.corners import GridLevel
from fhash_codec.bench.paper.encodings.encoding import EMBEDDING_SIZE, HIDDEN_LAYERS, WIDTH
from fhash_codec.bench.paper.encodings.places import sample_places
from fhash_codec.features.bricks import Coreset
from fhash_codec.paper.engines.slab import SlabEngine
from fhash_codec.paper.network import Architecture, parameter_count

CHUNK = 1 << 15
"""Points that are evaluated at a time."""


class LatticeModel:
    """A `SlabEngine` on grids whose finest level is the box itself.

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
        self.engine = SlabEngine(architecture, coreset, rates, seed=seed, device=device)
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
            values.append(self.engine.infer(chosen).cpu().numpy())
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
        fine = self.engine.fine_square != 0
        coarse = self.engine.flat_square[: self.engine.coarse] != 0
        return int(fine.any(0).sum()) + int(coarse.view(-1, EMBEDDING_SIZE).any(1).sum())

    def arrays(self) -> list[npt.NDArray[np.float32]]:
        """The tables (buckets, E), 0 where no gradient moved them, then weights and biases."""
        numbers = self.engine.parameters()
        tables, layers = numbers.dense(self.engine.architecture)
        finest = torch.zeros(self.levels[0].size, EMBEDDING_SIZE)
        finest[self.levels[0].buckets(self.places)] = numbers.fine.T
        rest = [number for layer in layers for number in layer]
        return [number.numpy().copy() for number in (finest, *tables, *rest)]
