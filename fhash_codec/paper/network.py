"""Network of the paper: architecture, levels, ranks of vertices, MLP, and types of its numbers."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import isfinite, prod
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from fhash_codec.boxes import TableSource
from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.support.values import Longs, Mask, Single

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
    def parameters_of_finest(self) -> int:
        """Number of trained numbers in the finest table."""
        return parameter_count(self.levels[:1], self.embedding_size)

    @property
    def coarse_numbers(self) -> int:
        """Number of trained numbers in the tables of all levels but the finest."""
        return parameter_count(self.levels[1:], self.embedding_size)

    @property
    def parameters(self) -> int:
        """Number of all trained numbers, in the tables and the MLP."""
        return self.parameters_of(parameter_count(self.levels, 1))

    def parameters_of(self, vertices: int) -> int:
        """Return the number of trained numbers of the MLP and of tables of so many vertices."""
        return vertices * self.embedding_size + sum(
            outputs * (inputs + 1) for outputs, inputs in self.layer_shapes
        )


BLOCK_WORDS = 4
"""Words of a block: ones before a word in its block fit in one byte."""
MAX_COUNT = 2**32 - 1
"""Largest number of ones in a bitmap."""


@dataclass(frozen=True, eq=False)
class RankedBits:
    """A bitmap, and for each of its ones the number of ones before it.

    Attributes:
        words: uint64 (n,); position p is bit p % 64, 0 the lowest, of word p // 64.
        blocks: uint32 (ceil(n / 4) + 1,), ones before each block of 4 words; the last is the
            number of all ones.
        within: uint8 (n,), ones before each word in its block.
    """

    words: npt.NDArray[np.uint64]
    blocks: npt.NDArray[np.uint32]
    within: npt.NDArray[np.uint8]

    @classmethod
    def of_octets(cls, octets: npt.NDArray[np.uint8]) -> RankedBits:
        """Return the bitmap of bytes; position p is bit p % 8, 0 the lowest, of byte p // 8."""
        filled = np.zeros(-(-len(octets) // 8) * 8, np.uint8)
        filled[: len(octets)] = octets
        return cls.of_words(filled.view("<u8").astype(np.uint64, copy=False))

    @classmethod
    def of_words(cls, words: npt.NDArray[np.uint64]) -> RankedBits:
        """Return the bitmap of words; position p is bit p % 64, 0 the lowest, of word p // 64."""
        counts = np.zeros((-(-len(words) // BLOCK_WORDS), BLOCK_WORDS), np.uint8)
        counts.reshape(-1)[: len(words)] = np.bitwise_count(words)
        # Up to 3 words of 64 ones come before the last word of a block: 192 fit in a byte.
        before = np.cumsum(counts[:, :-1], axis=1, dtype=np.uint8)
        within = np.concatenate([np.zeros_like(before[:, :1]), before], axis=1).reshape(-1)
        blocks = np.zeros(len(counts) + 1, np.int64)
        np.cumsum(counts.sum(axis=1, dtype=np.int64), out=blocks[1:])
        if blocks[-1] > MAX_COUNT:
            raise InputError(
                f"a level needs {blocks[-1]} vertices at one time; at most {MAX_COUNT} are allowed"
            )
        return cls(words, blocks.astype(np.uint32), within[: len(words)])

    @property
    def count(self) -> int:
        """Number of ones."""
        return int(self.blocks[-1])

    def lookup(self, positions: Longs) -> Longs:
        """Return the place of each position among the ones, `count` where its bit is 0.

        Args:
            positions: int64 of any shape, in 0 .. 64 n - 1.
        """
        word = positions >> 6
        # The bit moves to the top of its word, and all that come after it fall out.
        upto = self.words[word] << (~positions & 63).view(np.uint64)
        ranks = self.blocks[word >> 2] + self.within[word] + np.bitwise_count(upto)
        return np.where(upto.view(np.int64) < 0, ranks.astype(np.int64) - 1, self.count)

    def before(self, position: int) -> int:
        """Return the number of ones before a position in 0 .. 64 n."""
        word, bit = divmod(position, 64)
        block = word - word % BLOCK_WORDS
        whole = int(np.bitwise_count(self.words[block:word]).sum())
        part = int(self.words[word]) & ((1 << bit) - 1) if bit else 0
        return int(self.blocks[block // BLOCK_WORDS]) + whole + part.bit_count()

    @property
    def octets(self) -> npt.NDArray[np.uint8]:
        """The bitmap as bytes, in the order of `of_octets`, filled up to whole words."""
        return self.words.astype("<u8", copy=False).view(np.uint8)

    def positions(self) -> Longs:
        """Return the positions of all ones, ascending."""
        return np.flatnonzero(np.unpackbits(self.octets, bitorder="little"))


@dataclass(frozen=True, eq=False)
class SparseFrame:
    """The embeddings of a level at one time, at the vertices that it holds; 0 at all others.

    Attributes:
        shape: vertices (z, y, x) of the level.
        bits: which vertices are held. Rows along x are filled up to whole bytes of bits.
        values: embeddings (bits.count + 1, E) of the held vertices in C order over (z, y, x),
            float16 or float32. The last row is 0: `bits.lookup` gives it for other vertices.
    """

    shape: tuple[int, int, int]
    bits: RankedBits
    values: npt.NDArray[Any]

    @classmethod
    def of(cls, mask: Mask, held: npt.NDArray[Any]) -> SparseFrame:
        """Return a frame of the embeddings (held vertices, E) of a mask (z, y, x)."""
        z, y, x = mask.shape
        rows = np.packbits(mask, axis=2, bitorder="little")
        nothing = np.zeros((1, held.shape[1]), held.dtype)
        bits = RankedBits.of_octets(rows.reshape(-1))
        return cls((z, y, x), bits, np.concatenate([held, nothing]))

    @property
    def row(self) -> int:
        """Bits of a row along x; vertex (z, y, x) has bit (z * shape[1] + y) * row + x."""
        return row_bits(self.shape[2])

    def take(self, z: Longs, y: Longs, x: Longs) -> npt.NDArray[Any]:
        """Return the embeddings (..., E) of vertices, whose indices broadcast to (...)."""
        positions = (z * self.shape[1] + y) * self.row + x
        return self.values.take(self.bits.lookup(positions), axis=0)

    def read(self, box: tuple[slice, ...]) -> npt.NDArray[Any]:
        """Return the embeddings (z, y, x, E) of a region: 3 slices with explicit ends."""
        z, y, x = box
        octets = self.bits.octets[: prod(self.shape[:2]) * self.row // 8]
        rows = octets.reshape(*self.shape[:2], -1)[z, y, x.start // 8 : -(-x.stop // 8)]
        bits = np.unpackbits(rows, axis=2, bitorder="little").view(np.bool_)
        held = bits[:, :, x.start % 8 : x.start % 8 + x.stop - x.start]
        result = np.zeros((*held.shape, self.values.shape[1]), self.values.dtype)
        if (y.start, y.stop, x.start, x.stop) == (0, self.shape[1], 0, self.shape[2]):
            # The embeddings of whole planes lie together.
            first = self.bits.before(z.start * self.shape[1] * self.row)
            result[held] = self.values[first : first + np.count_nonzero(held)]
        else:
            at = held.nonzero()
            result[at] = self.take(*(i + axis.start for i, axis in zip(at, box, strict=True)))
        return result


def row_bits(vertices: int) -> int:
    """Return the bits of a row of vertices along x, filled up to whole bytes."""
    return -(-vertices // 8) * 8


Layer = tuple[Single, Single]
"""Weight (out, in) and bias (out,)."""
UNIT = 2.0**-24
"""Relative error of one operation in float32, which is rounded to the nearest."""
INTERPOLATION = 32
"""Units of the largest embedding by which an interpolated one errs at most.

On each of four axes a weight, its complement, a difference, two products and a sum are rounded:
together at most 8 units, since the difference may be twice as large.
"""


def rounding_bound(peaks: npt.ArrayLike, layers: Sequence[Layer]) -> float:
    """Return the largest difference of the outputs of two readers of a network.

    Each evaluates it in float32, in an order of its own, with fused multiply-adds or without. A sum
    of n products and a bias errs by at most n + 1 units of the sum of their magnitudes (Higham,
    Accuracy and Stability of Numerical Algorithms, section 3.1). A layer passes on at most the
    magnitudes of its weights times the errors of its inputs, and ReLU no more than it gets.

    Args:
        peaks: largest magnitude of each input (inputs,).
        layers: the layers.
    """
    largest = np.asarray(peaks, np.float64)
    error = INTERPOLATION * UNIT * largest
    for weight, bias in layers:
        weights, biases = np.abs(weight).astype(np.float64), np.abs(bias).astype(np.float64)
        units = (weights.shape[1] + 1) * UNIT
        error = weights @ error + units / (1 - units) * (weights @ (largest + error) + biases)
        largest = weights @ largest + biases
    return 2 * float(error[0])


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

    @classmethod
    def of(
        cls, architecture: Architecture, tables: Sequence[TableSource], layers: Sequence[Layer]
    ) -> Network:
        """Return the network of an architecture with these tables and layers."""
        return cls(
            levels=architecture.levels,
            embedding_size=architecture.embedding_size,
            tables=tables,
            layers=tuple(layers),
            box_size=architecture.box_size,
            key_frames=architecture.key_frames,
        )

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
    def matrices(self) -> tuple[Single, ...]:
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

    def rounding(self) -> float:
        """Return the largest difference of the outputs of two readers; see `rounding_bound`."""
        peaks = []
        for level, (times, *space) in enumerate(self.levels):
            peak = np.zeros(self.embedding_size)
            for node in range(times):
                frame = self.sparse_frame(level, node)
                whole = (slice(node, node + 1), *(slice(0, n) for n in space))
                values = self.read(level, whole) if frame is None else frame.values
                peak = np.maximum(peak, np.abs(values).reshape(-1, self.embedding_size).max(axis=0))
            peaks.append(peak)
        return rounding_bound(np.concatenate(peaks), self.layers)

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


@dataclass(frozen=True, kw_only=True)
class NumberType:
    """The numbers of a file that embeddings are stored as.

    Attributes:
        dtype: type of the numbers, floating or unsigned.
        scale, offset: an embedding stored as an unsigned number is offset + scale * number.
    """

    dtype: np.dtype[Any]
    scale: float = 1.0
    offset: float = 0.0

    @classmethod
    def of(cls, values: Single, kind: str) -> NumberType:
        """Return the number type named `kind` with the scale and offset that fit some embeddings.

        Raises InputError where the embeddings are not finite or do not fit in the type.
        """
        dtype = np.dtype(kind)
        low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
        if not (isfinite(low) and isfinite(high)):
            raise InputError(
                "embeddings are not finite: the training diverged; set a lower --learning-rate"
            )
        if dtype.kind == "u":
            # The range includes 0, so that the 0 of untrained vertices costs little.
            low, high = min(low, 0.0), max(high, 0.0)
        reached = high - low if dtype.kind == "u" else max(-low, high)
        if reached > float(np.finfo(np.float32 if dtype.kind == "u" else dtype).max):
            raise InputError(
                f"embeddings reach {reached:g}, more than {kind} holds; use --tables float32"
            )
        if dtype.kind == "f":
            return cls(dtype=dtype)
        # float32 holds numbers below its `tiny` with fewer digits. A scale that small would not
        # give back the embeddings.
        scale = (
            max((high - low) / np.iinfo(dtype).max, float(np.finfo(np.float32).tiny))
            if high > low
            else 1.0
        )
        return cls(dtype=dtype, scale=scale, offset=low)

    def stored(self, embeddings: Single) -> npt.NDArray[Any]:
        """Return embeddings as numbers of the type, of the same shape."""
        if self.dtype.kind == "f":
            return embeddings.astype(self.dtype)
        return np.asarray(
            np.rint(embeddings / self.scale - self.offset / self.scale).astype(self.dtype)
        )

    @property
    def attributes(self) -> dict[str, float]:
        """The attributes by which a reader finds the embeddings again."""
        return {"offset": self.offset, "scale": self.scale} if self.dtype.kind == "u" else {}
