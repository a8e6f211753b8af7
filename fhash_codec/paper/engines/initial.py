"""The parameters of a model, and where training starts: the same for every engine and device."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import prod

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.architecture import Architecture

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
    coarse_numbers = (
        sum(prod(level) for level in architecture.levels[1:]) * architecture.embedding_size
    )
    coarse = torch.empty(coarse_numbers).uniform_(-SPREAD, SPREAD, generator=random)
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
