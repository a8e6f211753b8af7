"""The F-Hash model at any point: tables and a small MLP, written for clarity; the oracle of every faster engine."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.tesseract import interpolate, interpolate_with_jacobian


class FHash(nn.Module):
    """Multi-resolution tesseract encoding and MLP (paper, Input Encoding).

    A point is (t, z, y, x) in vertices of the key frames and the feature bounding box, fractional anywhere between;
    the value is normalised to the series' range.
    """

    def __init__(
        self,
        architecture: Architecture,
        tables: Sequence[Tensor],
        layers: Sequence[tuple[Tensor, Tensor]],
    ) -> None:
        """Tables (buckets, E) per level, finest first, and (weight (out, in), bias (out,)) per layer; they are trained in place."""
        super().__init__()
        self.architecture = architecture
        self.tables = nn.ParameterList(nn.Parameter(table) for table in tables)
        self.weights = nn.ParameterList(nn.Parameter(weight) for weight, _ in layers)
        self.biases = nn.ParameterList(nn.Parameter(bias) for _, bias in layers)

    def forward(self, points: Tensor) -> Tensor:
        """Values (n,) at points (n, 4)."""
        sizes, levels = self.architecture.sizes, self.architecture.levels
        hidden = torch.cat(
            [
                interpolate(table, points, sizes, level)
                for table, level in zip(self.tables, levels, strict=True)
            ],
            dim=1,
        )
        for number, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            hidden = nn.functional.linear(hidden if number == 0 else hidden.relu(), weight, bias)
        return hidden.squeeze(1)

    @torch.no_grad()
    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Values (n,) and their analytic derivatives (n, 4) by t, z, y, x at points (n, 4).

        The chain rule forwards: the Jacobian of the embeddings goes through each layer beside the value. On a ReLU's kink the
        derivative is the one of its flat side; on the border of two cells, that of the cell after it.
        """
        sizes, levels = self.architecture.sizes, self.architecture.levels
        encoded = [
            interpolate_with_jacobian(table, points, sizes, level)
            for table, level in zip(self.tables, levels, strict=True)
        ]
        hidden, jacobian = (
            torch.cat([value for value, _ in encoded], dim=1),
            torch.cat([slope for _, slope in encoded], dim=1),
        )
        for number, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            if number > 0:
                jacobian = jacobian * (hidden > 0).unsqueeze(-1)
                hidden = hidden.relu()
            hidden = nn.functional.linear(hidden, weight, bias)
            jacobian = torch.einsum("oi,nia->noa", weight, jacobian)
        return hidden.squeeze(1), jacobian.squeeze(1)
