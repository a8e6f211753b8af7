"""The size of a model: which tables and layers it has; no numbers, no torch."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

from fhash_codec.paper.levels import Resolution, level_resolutions, parameter_count


@dataclass(frozen=True, kw_only=True)
class Architecture:
    """Tables per level (finest first) and an MLP from all embeddings of a point to one value in [0, 1].

    Attributes:
        levels: vertices (t, z, y, x) of each table.
        embedding_size: numbers at each vertex.
        hidden_layers, width: of the MLP with ReLU; no hidden layer is a linear readout.
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
        hidden_layers: int = 1,
        width: int = 64,
    ) -> Architecture:
        """The paper's model of a feature bounding box and a number of key frames."""
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
        """Vertices (t, z, y, x) on which the coreset lies: key frames and box; equal to the finest level."""
        return (self.key_frames, *self.box_size)

    @property
    def inputs(self) -> int:
        """Numbers that reach the MLP for one point."""
        return len(self.levels) * self.embedding_size

    @property
    def layer_shapes(self) -> Sequence[tuple[int, int]]:
        """(outputs, inputs) of each linear layer."""
        widths = [self.inputs, *[self.width] * self.hidden_layers, 1]
        return [(outputs, inputs) for inputs, outputs in itertools.pairwise(widths)]

    @property
    def parameters(self) -> int:
        """All trained numbers, tables and MLP."""
        return parameter_count(self.levels, self.embedding_size) + sum(
            o * (i + 1) for o, i in self.layer_shapes
        )
