"""A trained network as plain numbers: the tables of all levels and the dense layers. numpy only.

A level's table is an array (t, z, y, x, embedding). Its first and last vertices coincide with those
of the box: vertex i of an axis with S vertices lies at i (R - 1) / (S - 1) among the R vertices of
the level, at 0 where S is 1. Time follows the same rule, from the key index, which is fractional
between key frames. The inputs of the dense layers at a point are the embeddings of all levels,
interpolated linearly along the four axes. Input level * embedding_size + e is embedding e of a
level; the finest level comes first.

The promise of repeatable values
--------------------------------
A sample gets the same bits whatever other samples are evaluated with it. A matrix product of BLAS
alone does not promise that: BLAS picks its kernel, and with it the order of the sums, by the shape
of the matrices, and some kernels add in another order at another column. Two classes keep the
promise, both by construction and on every machine:

* `DenseLayers`, for the vertices of a region (`regions.py`). Regions are decoded in whole blocks at
  fixed places, and a block in products of exactly `COLUMNS` columns. So a vertex always lies in the
  same column of a product of the same shape. Where few vertices of a block are asked for, they move
  to fewer products (`run_some`), each within its column.
* The native library (`points.py`), for samples at free positions, which may come in any order. It
  adds without BLAS.

The bits may differ between machines, because their BLAS libraries and their vectors do.
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

COLUMNS = 64
"""Samples per matrix product: such a product runs in one thread and in the first-level cache."""
PRODUCTS = 64
"""Products per layer before the next layer: their outputs stay in the second-level cache."""
MAX_SHARE = 0.75
"""Share of all products up to which requested samples are gathered in fewer products.

Gathering costs some 15 % of the products of the usual network, 64 wide with two hidden layers.
"""
MIN_WEIGHTS = 2048
"""Numbers in the matrices of the smallest network for which samples are gathered.

Those of a smaller one are multiplied as fast as the inputs are gathered.
"""


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


class DenseLayers:
    """Dense layers of a network, evaluated by matrix products of fixed shape.

    The module's docstring says what that promises. An object has room for a fixed number of samples
    and belongs to one thread. Write the inputs of n samples into `inputs[:-1, :n]`, call `run`, and
    take the first n outputs; what the spare columns hold does not matter.

    Attributes:
        inputs: (network.inputs + 1, samples) float32, filled by the caller. The last row is 1 and
            must stay so. The number of samples is rounded up to whole products.
    """

    def __init__(self, network: Network, samples: int) -> None:
        self.matrices = network.matrices
        self._weights = sum(matrix.size for matrix in self.matrices)
        products = -(-samples // COLUMNS)
        self.inputs = np.zeros((network.inputs + 1, products * COLUMNS), np.float32)
        self.inputs[-1] = 1.0
        self.outputs = np.empty((products, COLUMNS), np.float32)
        self.hidden = [
            np.empty((min(products, PRODUCTS), matrix.shape[0], COLUMNS), np.float32)
            for matrix in self.matrices
        ]

    def run(self) -> Floats:
        """Return the outputs (samples,) for `inputs`. The next run overwrites them."""
        return self._run(self.inputs.reshape(len(self.inputs), -1, COLUMNS))

    def run_some(self, requested: npt.NDArray[np.bool_]) -> Floats:
        """Return outputs (samples,) for `inputs`; those that were not requested may be NaN.

        A requested output has the bits that `run` gives it.

        Args:
            requested: bool (n,), the samples whose outputs are needed, of the first n; no others
                are.
        """
        products = len(self.outputs)
        most = int(MAX_SHARE * products) if self._weights >= MIN_WEIGHTS else 0
        if np.count_nonzero(requested) > most * COLUMNS:
            return self.run()
        table = np.zeros((products, COLUMNS), np.bool_)
        table.reshape(-1)[: len(requested)] = requested
        ranks = np.cumsum(table, axis=0, dtype=np.int32)
        needed = int(ranks[-1].max())
        if needed > most:
            return self.run()
        # In each column the requested samples move up, so that they fill the first products.
        samples = np.flatnonzero(table)
        places = (ranks.reshape(-1)[samples] - 1) * COLUMNS + samples % COLUMNS
        moved = np.zeros(needed * COLUMNS, np.intp)
        moved[places] = samples
        inputs = np.take(self.inputs, moved, axis=1, mode="clip")
        outputs = np.full(products * COLUMNS, np.nan, np.float32)
        outputs[samples] = self._run(inputs.reshape(len(inputs), needed, COLUMNS))[places]
        return outputs

    def _run(self, inputs: Floats) -> Floats:
        """Return the outputs for inputs (network.inputs + 1, products, COLUMNS)."""
        inputs = inputs.transpose(1, 0, 2)
        for start in range(0, len(inputs), PRODUCTS):
            current = inputs[start : start + PRODUCTS]
            for matrix, hidden in zip(self.matrices, self.hidden, strict=True):
                out = hidden[: len(current)]
                # Hostile weights overflow; values are clipped to their range later.
                with np.errstate(over="ignore", invalid="ignore"):
                    np.matmul(matrix, current, out=out)
                if hidden is not self.hidden[-1]:
                    np.maximum(out, 0.0, out=out)
                current = out
            self.outputs[start : start + len(current)] = current[:, 0]
        return self.outputs[: len(inputs)].reshape(-1)
