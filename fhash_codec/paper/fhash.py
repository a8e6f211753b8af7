"""The F-Hash model as the paper describes it, in torch: tables and a small MLP.

`FHash` evaluates any point by the formulas of the paper and is written for clarity. The naive
engine trains it; the faster engine and the numpy decoder are tested against it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.tesseract import interpolate


class FHash(nn.Module):
    """Multi-resolution tesseract encoding, followed by an MLP (paper, sections 3.2.4 and 4.2)."""

    def __init__(
        self,
        architecture: Architecture,
        tables: Sequence[Tensor],
        layers: Sequence[tuple[Tensor, Tensor]],
    ) -> None:
        """Make a model of given numbers, which training then changes in place.

        Args:
            architecture: the sizes of tables and layers.
            tables: embeddings (buckets, E) of each level, finest first.
            layers: weight (outputs, inputs) and bias (outputs,) of each layer.
        """
        super().__init__()
        self.architecture = architecture
        self.tables = nn.ParameterList(nn.Parameter(table) for table in tables)
        self.weights = nn.ParameterList(nn.Parameter(weight) for weight, _ in layers)
        self.biases = nn.ParameterList(nn.Parameter(bias) for _, bias in layers)

    def forward(self, points: Tensor) -> Tensor:
        """Return values (n,), normalised to the range of the series, at points (n, 4).

        A point is (t, z, y, x) in vertices of the lattice of samples: t counts key frames; z, y and
        x count vertices of the feature bounding box. Fractions lie between vertices.
        """
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
