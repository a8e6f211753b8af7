"""A trained network as plain numbers: the tables of all levels and the dense layers. numpy only.

A level's table is an array (t, z, y, x, embedding). Its first and last vertices coincide with those
of the box: vertex i of an axis with S vertices lies at i (R - 1) / (S - 1) among the R vertices of
the level, at 0 where S is 1. Time follows the same rule, from the key index, which is fractional
between key frames. The inputs of the dense layers at a point are the embeddings of all levels,
interpolated linearly along the four axes. Input level * embedding_size + e is embedding e of a
level; the finest level comes first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from fhash_codec.paper.architecture import Resolution
from fhash_codec.paper.tables.ranked import SparseFrame
from fhash_formats.errors import DamagedFileError, InputError

Floats = npt.NDArray[np.float32]
Layer = tuple[Floats, Floats]
"""Weight (out, in) and bias (out,)."""


class TableSource(Protocol):
    """A level's table, in memory or elsewhere."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Lengths of the axes (t, z, y, x, embedding)."""
        ...

    def read(self, region: tuple[slice, ...]) -> npt.NDArray[Any]:
        """Return the embeddings of a region, float32 or float16.

        The region is 5 slices of step 1 with explicit ends.
        """
        ...


@runtime_checkable
class SparseSource(TableSource, Protocol):
    """A level's table that holds some vertices only; the embeddings of all others are 0."""

    def frame(self, node: int) -> SparseFrame:
        """Return the embeddings of a time node."""
        ...


class ArrayTable:
    """A `TableSource` of an array in memory, (t, z, y, x, embedding)."""

    def __init__(self, values: npt.NDArray[Any]) -> None:
        self.values = values

    @property
    def shape(self) -> tuple[int, ...]:
        """Lengths of the axes of the array."""
        return self.values.shape

    def read(self, region: tuple[slice, ...]) -> npt.NDArray[Any]:
        """Return a region as a view."""
        return self.values[region]


@dataclass(frozen=True, kw_only=True)
class Network:
    """Everything that decoding needs. Raises InputError where the parts do not fit together.

    Attributes:
        levels: resolution (t, z, y, x) of each level, finest first.
        embedding_size: numbers at each vertex of a table.
        tables: one TableSource per level.
        layers: (weight, bias) of each layer, from the inputs to one output. ReLU stands between
            layers; a single layer is a linear readout.
        box_size: vertices of the feature bounding box (z, y, x).
        key_frames: number of key frames.
    """

    levels: tuple[Resolution, ...]
    embedding_size: int
    tables: Sequence[TableSource]
    layers: tuple[Layer, ...]
    box_size: tuple[int, int, int]
    key_frames: int

    def __post_init__(self) -> None:
        self._check_tables()
        self._check_layers()

    @property
    def inputs(self) -> int:
        """Number of inputs of the first layer."""
        return len(self.levels) * self.embedding_size

    @property
    def sparse(self) -> bool:
        """Whether every level holds some vertices only."""
        return all(isinstance(table, SparseSource) for table in self.tables)

    @cached_property
    def matrices(self) -> tuple[Floats, ...]:
        """Layers as matrices (out + 1, in + 1) that include the biases.

        They act on vectors whose last number is 1: the bias is the last column, and the last row
        hands the 1 on to the next layer.
        """
        matrices = []
        for weight, bias in self.layers:
            matrix = np.zeros((weight.shape[0] + 1, weight.shape[1] + 1), np.float32)
            matrix[:-1, :-1], matrix[:-1, -1], matrix[-1, -1] = weight, bias, 1.0
            matrices.append(matrix)
        return tuple(matrices)

    def read(self, level: int, region: tuple[slice, ...]) -> npt.NDArray[Any]:
        """Return all embeddings in a region of a level's table.

        Args:
            level: index of the level, 0 for the finest.
            region: slices (t, z, y, x).

        Raises:
            DamagedFileError: numbers in the table are not finite.
        """
        values = self.tables[level].read((*region, slice(0, self.embedding_size)))
        _check_finite(values, level)
        return values

    def sparse_frame(self, level: int, node: int) -> SparseFrame | None:
        """Return the embeddings at a time node of a level that holds some vertices only.

        None for a level that holds all vertices. Arguments and errors are those of `read`.
        """
        table = self.tables[level]
        if not isinstance(table, SparseSource):
            return None
        frame = table.frame(node)
        _check_finite(frame.values, level)
        return frame

    def _check_tables(self) -> None:
        if not self.levels or len(self.tables) != len(self.levels):
            raise InputError(
                f"network: {len(self.tables)} tables for {len(self.levels)} levels; "
                "each level needs one"
            )
        if min(*self.box_size, self.key_frames) < 1:
            raise InputError(
                f"network: box {self.box_size} with {self.key_frames} key frames; "
                "every length must be at least 1"
            )
        for number, (resolution, table) in enumerate(
            zip(self.levels, self.tables, strict=True), start=1
        ):
            shape, needed = tuple(table.shape), (*resolution, self.embedding_size)
            if shape != needed or min(shape) < 1:
                raise InputError(
                    f"network: the table of level {number} has shape {shape}, not {needed}"
                )

    def _check_layers(self) -> None:
        width = self.inputs
        for number, (weight, bias) in enumerate(self.layers, start=1):
            if weight.ndim != 2 or weight.shape[1] != width or bias.shape != weight.shape[:1]:
                raise InputError(
                    f"network: layer {number} has weight {weight.shape} and bias {bias.shape}; "
                    f"it gets {width} numbers"
                )
            if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
                raise InputError(f"network: layer {number} holds numbers that are not finite")
            width = weight.shape[0]
        if not self.layers or width != 1:
            raise InputError(f"network: the last of {len(self.layers)} layers must have one output")


def _check_finite(values: npt.NDArray[Any], level: int) -> None:
    """Refuse numbers in the table of a level, counted from 0, that are not finite."""
    if not np.isfinite(values).all():
        # Messages count levels from 1, as the arrays of the file do.
        raise DamagedFileError(
            f"the table of level {level + 1} holds numbers that are not finite; "
            "the training diverged or the file is damaged"
        )
