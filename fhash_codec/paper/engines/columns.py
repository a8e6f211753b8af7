"""The columns of the MLP's inputs in a batch of the slab engine, and where their numbers are."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from fhash_codec.training.positions import true_positions


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
