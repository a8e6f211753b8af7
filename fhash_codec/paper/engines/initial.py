"""Where training starts, the same for every engine and device."""

from __future__ import annotations

from dataclasses import dataclass
from math import prod

import torch
from torch import Tensor

from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.architecture import Architecture

SPREAD = (
    1e-4  # of the initial embeddings, uniform in -SPREAD .. SPREAD (Mueller et al. 2022, section 4)
)


@dataclass(frozen=True)
class Parameters:
    """The trained numbers of a model.

    fine: embeddings of the finest level (bricks, E, vertices of a brick), only for bricks that hold coreset vertices.
    coarse: the coarser tables level by level, each (buckets, E), in one vector.
    network: each layer as a matrix (out, in + 1) whose last column is the bias, in one vector.
    """

    fine: Tensor
    coarse: Tensor
    network: Tensor

    def dense(self, architecture: Architecture) -> tuple[list[Tensor], list[tuple[Tensor, Tensor]]]:
        """The coarse tables (buckets, E) and the layers (weight (out, in), bias (out,)), as views."""
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
    """Views of the layers (out, in + 1) inside one vector."""
    shapes = [(outputs, inputs + 1) for outputs, inputs in architecture.layer_shapes]
    return [
        part.view(shape)
        for part, shape in zip(
            torch.split(network, [prod(shape) for shape in shapes]), shapes, strict=True
        )
    ]


def initial_parameters(architecture: Architecture, coreset: Coreset, seed: int) -> Parameters:
    """Uniform embeddings and layers (uniform in +-1/sqrt(inputs), torch's own start), float32 on the CPU."""
    random = torch.Generator().manual_seed(seed)
    fine = torch.empty(len(coreset.bricks), architecture.embedding_size, prod(coreset.brick_shape))
    fine.uniform_(-SPREAD, SPREAD, generator=random)
    coarse = sum(prod(level) for level in architecture.levels[1:]) * architecture.embedding_size
    tables = torch.empty(coarse).uniform_(-SPREAD, SPREAD, generator=random)
    parts = []
    for outputs, inputs in architecture.layer_shapes:
        bound = inputs**-0.5
        parts.append(torch.empty(outputs * (inputs + 1)).uniform_(-bound, bound, generator=random))
    return Parameters(fine=fine, coarse=tables, network=torch.cat(parts))
