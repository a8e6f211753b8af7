"""The size of a model: its levels, tables and layers, without their numbers and without torch.

Resolutions are found by integer arithmetic only (paper, sections 3.2.1 and 3.2.2).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from math import prod

Resolution = tuple[int, int, int, int]
"""Vertices per axis of one level, (t, z, y, x)."""


def ceil_log(n: int, base: int) -> int:
    """Return the smallest L with base**L >= n, for n >= 1 and base >= 2 (paper, equation 5).

    The result is exact. A floating-point logarithm is not, for example for n = 216 and base = 6.
    """
    exponent, power = 0, 1
    while power < n:
        power *= base
        exponent += 1
    return exponent


def axis_resolutions(size: int, fold: int, levels: int) -> list[int]:
    """Return the vertices of one axis at each level, finest first (paper, equations 4, 7 and 8).

    Each level divides the one before by `fold`, rounding up, down to a tail of levels with 2
    vertices. An axis of a single vertex has 1 at every level.
    """
    if size == 1:
        return [1] * levels
    resolutions = [size]
    while len(resolutions) < levels:
        previous = resolutions[-1]
        resolutions.append(-(-previous // fold) if previous > fold else 2)
    return resolutions


def level_resolutions(box: Sequence[int], key_frames: int, fold: int) -> tuple[Resolution, ...]:
    """Return the resolution of each level, finest first.

    The number of levels is the largest ceil(log_fold S) over the three spatial axes (paper,
    equations 5 and 6), and at least 1. Time follows the same rule as the spatial axes, from the
    number of key frames (paper, section 3.2.2).

    Args:
        box: vertices (z, y, x) of the feature bounding box.
        key_frames: number of key frames.
        fold: ratio between neighbouring levels, at least 2.
    """
    levels = max(1, *(ceil_log(size, fold) for size in box))
    columns = [axis_resolutions(size, fold, levels) for size in (key_frames, *box)]
    return tuple(zip(*columns, strict=True))


def parameter_count(levels: Sequence[Resolution], embedding_size: int) -> int:
    """Return the number of trained numbers in the tables of all levels, without the network."""
    return embedding_size * sum(prod(level) for level in levels)


@dataclass(frozen=True, kw_only=True)
class Architecture:
    """Sizes of the tables of all levels, and of the MLP that turns their embeddings into a value.

    Attributes:
        levels: vertices (t, z, y, x) of each table, finest first.
        embedding_size: numbers at each vertex of a table.
        hidden_layers: hidden layers of the MLP, with ReLU; 0 makes it a linear readout.
        width: neurons of each hidden layer.
        box_size: vertices (z, y, x) of the feature bounding box.
        key_frames: number of key frames.
    """

    levels: tuple[Resolution, ...]
    embedding_size: int
    hidden_layers: int
    width: int
    box_size: tuple[int, int, int]
    key_frames: int

    @classmethod
    def for_box(
        cls,
        box_size: tuple[int, int, int],
        key_frames: int,
        *,
        fold: int = 2,
        embedding_size: int = 2,
        hidden_layers: int = 2,
        width: int = 64,
    ) -> Architecture:
        """Return the paper's model of a feature bounding box and a number of key frames.

        The defaults are the paper's (section 4.2): fold 2, embeddings of 2 numbers, and an MLP of 2
        layers with 64 neurons. The layers are hidden ones: the paper's counts of parameters for
        tiny-cuda-nn, which is configured in the same words, come out with two hidden layers only.
        """
        levels = level_resolutions(box_size, key_frames, fold)
        return cls(
            levels=levels,
            embedding_size=embedding_size,
            hidden_layers=hidden_layers,
            width=width,
            box_size=box_size,
            key_frames=key_frames,
        )

    @property
    def sizes(self) -> Resolution:
        """Vertices (t, z, y, x) of the lattice of samples: key frames and box.

        They equal the resolution of the finest level (paper, equation 4).
        """
        return (self.key_frames, *self.box_size)

    @property
    def inputs(self) -> int:
        """Inputs of the MLP for one point: the embeddings of all levels, concatenated."""
        return len(self.levels) * self.embedding_size

    @property
    def layer_shapes(self) -> Sequence[tuple[int, int]]:
        """(outputs, inputs) of each linear layer."""
        widths = [self.inputs, *[self.width] * self.hidden_layers, 1]
        return [(outputs, inputs) for inputs, outputs in itertools.pairwise(widths)]

    @property
    def parameters(self) -> int:
        """Number of all trained numbers, in the tables and the MLP."""
        return self.parameters_of(parameter_count(self.levels, 1))

    def parameters_of(self, vertices: int) -> int:
        """Return the number of trained numbers of the MLP and of tables of so many vertices."""
        return vertices * self.embedding_size + sum(
            outputs * (inputs + 1) for outputs, inputs in self.layer_shapes
        )
