"""The size of a model: its tables and its layers, without their numbers and without torch."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

from fhash_codec.paper.levels import Resolution, level_resolutions, parameter_count


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
