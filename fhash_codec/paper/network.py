"""A trained model as plain numbers: the tables of every level and the dense layers of its head. numpy only.

A level's table is an array (t, z, y, x, embedding) whose corners align with the box: vertex i of an axis of S vertices lies at
i (R - 1) / (S - 1) among the R vertices of the level (0 where S is 1); time likewise from the key index, which is fractional between
key frames. The value at a point is the head of all levels' quadrilinearly interpolated embeddings, level-major: number
level * embedding_size + e, finest level first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from fhash_codec.paper.levels import Resolution
from fhash_formats.errors import DamagedFileError, InputError

Floats = npt.NDArray[np.float32]
Layer = tuple[Floats, Floats]
"""Weight (out, in) and bias (out,)."""

COLUMNS = 64
"""Samples per matrix product. BLAS picks its kernel by the shape; products of this size run in one thread and in the first-level cache."""
PRODUCTS = 64
"""Products per layer before the next layer: what they put out stays in the second-level cache."""


class TableSource(Protocol):
    """A level's table, wherever it lies: `shape` is (t, z, y, x, embedding)."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    def read(self, region: tuple[slice, ...]) -> npt.NDArray[Any]:
        """The embeddings of a region given as 5 slices of step 1 with explicit ends; float32 or float16."""
        ...


class ArrayTable:
    """An array in memory (t, z, y, x, embedding) as a TableSource."""

    def __init__(self, values: npt.NDArray[Any]) -> None:
        self.values = values

    @property
    def shape(self) -> tuple[int, ...]:
        return self.values.shape

    def read(self, region: tuple[slice, ...]) -> npt.NDArray[Any]:
        return self.values[region]


@dataclass(frozen=True, kw_only=True)
class Network:
    """All that decoding needs; raises InputError where the parts do not fit together.

    Attributes:
        levels: resolution (t, z, y, x) of each level, finest first.
        embedding_size: numbers at each vertex of a table.
        tables: one TableSource per level.
        layers: (weight, bias) from the features to one output; ReLU between them; one layer alone is a linear readout.
        box_size: vertices of the feature bounding box (z, y, x).
        key_frames: how many.
    """

    levels: tuple[Resolution, ...]
    embedding_size: int
    tables: Sequence[TableSource]
    layers: tuple[Layer, ...]
    box_size: tuple[int, int, int]
    key_frames: int

    def __post_init__(self) -> None:
        if not self.levels or len(self.tables) != len(self.levels):
            raise InputError(
                f"network: {len(self.tables)} tables for {len(self.levels)} levels; each level needs one"
            )
        if min(*self.box_size, self.key_frames) < 1:
            raise InputError(
                f"network: box {self.box_size} with {self.key_frames} key frames; every length must be at least 1"
            )
        for level, (resolution, table) in enumerate(zip(self.levels, self.tables, strict=True)):
            if tuple(table.shape) != (*resolution, self.embedding_size) or min(table.shape) < 1:
                raise InputError(
                    f"network: the table of level {level} has shape {tuple(table.shape)}, not {(*resolution, self.embedding_size)}"
                )
        width = self.features
        for index, (weight, bias) in enumerate(self.layers):
            if weight.ndim != 2 or weight.shape[1] != width or bias.shape != weight.shape[:1]:
                raise InputError(
                    f"network: layer {index} has weight {weight.shape} and bias {bias.shape}; it gets {width} numbers"
                )
            if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
                raise InputError(f"network: layer {index} holds numbers that are not finite")
            width = weight.shape[0]
        if not self.layers or width != 1:
            raise InputError(f"network: the last of {len(self.layers)} layers must have one output")

    @property
    def features(self) -> int:
        """Inputs of the head."""
        return len(self.levels) * self.embedding_size

    @cached_property
    def matrices(self) -> tuple[Floats, ...]:
        """The layers as matrices (out + 1, in + 1) on vectors with a 1 at the end: the bias is the last column and the 1 is handed on."""
        matrices = []
        for weight, bias in self.layers:
            matrix = np.zeros((weight.shape[0] + 1, weight.shape[1] + 1), np.float32)
            matrix[:-1, :-1], matrix[:-1, -1], matrix[-1, -1] = weight, bias, 1.0
            matrices.append(matrix)
        return tuple(matrices)

    def read(self, level: int, region: tuple[slice, ...]) -> npt.NDArray[Any]:
        """A region (t, z, y, x) of a level's table, with all embeddings; raises DamagedFileError for numbers that are not finite."""
        values = self.tables[level].read((*region, slice(0, self.embedding_size)))
        if not np.isfinite(values).all():
            raise DamagedFileError(
                f"the table of level {level} holds numbers that are not finite; the training diverged or the file is damaged"
            )
        return values


class DenseLayers:
    """The dense layers of a network with room for a fixed number of samples; one per thread.

    Attributes:
        inputs: (features + 1, samples) float32, to be filled by the caller; the last row is 1. `samples` is rounded up to whole products.
    """

    def __init__(self, network: Network, samples: int) -> None:
        self.matrices = network.matrices
        products = -(-samples // COLUMNS)
        self.inputs = np.zeros((network.features + 1, products * COLUMNS), np.float32)
        self.inputs[-1] = 1.0
        self.outputs = np.empty((products, COLUMNS), np.float32)
        self.hidden = [
            np.empty((min(products, PRODUCTS), matrix.shape[0], COLUMNS), np.float32)
            for matrix in self.matrices
        ]

    def run(self) -> Floats:
        """The outputs (samples,) for `inputs`; the next run overwrites them."""
        inputs = self.inputs.reshape(len(self.inputs), -1, COLUMNS).transpose(1, 0, 2)
        for start in range(0, len(inputs), PRODUCTS):
            current = inputs[start : start + PRODUCTS]
            for matrix, hidden in zip(self.matrices, self.hidden, strict=True):
                out = hidden[: len(current)]
                with np.errstate(
                    over="ignore", invalid="ignore"
                ):  # of hostile weights; values are clipped to their range
                    np.matmul(matrix, current, out=out)
                if hidden is not self.hidden[-1]:
                    np.maximum(out, 0.0, out=out)
                current = out
            self.outputs[start : start + PRODUCTS] = current[:, 0]
        return self.outputs.reshape(-1)

    def gradient(self) -> Floats:
        """Derivatives (features, samples) of the last run's outputs by its inputs; for at most PRODUCTS * COLUMNS samples.

        Backwards through the layers; on a ReLU's kink the derivative is that of its flat side.
        """
        assert len(self.outputs) <= PRODUCTS, "only the last products' hidden layers are kept"
        slope = np.broadcast_to(
            self.matrices[-1][0, :, None], (len(self.outputs), self.matrices[-1].shape[1], COLUMNS)
        )
        with np.errstate(over="ignore", invalid="ignore"):
            for matrix, hidden in zip(self.matrices[-2::-1], self.hidden[-2::-1], strict=True):
                slope = np.matmul(matrix.T, slope * (hidden > 0))
        return slope.transpose(1, 0, 2).reshape(len(self.inputs), -1)[:-1]
