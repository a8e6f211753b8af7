"""Trained tables, errors of a model at its samples, and the small parts of a file."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from math import fsum, prod
from typing import Protocol

import numpy as np

from fhash_codec.boxes import Box
from fhash_codec.features import occupancy
from fhash_codec.features.bricks import Coreset
from fhash_codec.paper.model import input_slopes, sample_points
from fhash_codec.paper.network import Architecture, Layer, Network
from fhash_codec.paper.storage import Bricks, needed_by, write_occupancy
from fhash_formats.container import ContainerWriter
from fhash_formats.container.array import transform_codecs
from fhash_formats.container.header import CORESET_ARRAY, LAYERS, MASK_FEATURES, SCALES
from fhash_formats.support.values import Double, Longs, Mask, Single
from fhash_formats.transform.spec import TransformSpec
from fhash_formats.transform.tile_format import TileSettings

Region = tuple[slice, ...]


class TrainedTable(Protocol):
    """A `TableSource` of a level's trained table that also knows which vertices are needed."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Lengths of the axes (t, z, y, x, E)."""
        ...

    def read(self, region: Region) -> Single:
        """Return the embeddings (t, z, y, x, E) of a region of 5 slices."""
        ...

    def needed(self, region: Region) -> Mask:
        """Return which vertices (t, z, y, x) of a region some vertex of the coreset depends on.

        The region has at least 4 slices; more are ignored.
        """
        ...


class FinestTable:
    """A `TrainedTable` of the finest level, out of its samples."""

    def __init__(self, coreset: Coreset, bricks: Bricks, fine: Single) -> None:
        """Take the embeddings (E, samples), in the order of `Coreset.values`."""
        self._bricks, self._fine = bricks, fine
        self.shape: tuple[int, ...] = (
            len(coreset.key_frames),
            *coreset.box.shape,
            len(fine),
        )

    def read(self, region: Region) -> Single:
        """Return the embeddings of a region."""
        keys, box = _keys_and_box(region)
        return np.stack([self._bricks.embeddings(self._fine, key, box) for key in keys])[
            ..., region[4]
        ]

    def needed(self, region: Region) -> Mask:
        """Return which vertices of a region are in the coreset."""
        keys, box = _keys_and_box(region)
        return np.stack([self._bricks.mask(key, box) for key in keys])


class CoarseTable:
    """A `TrainedTable` of a coarser level, in memory."""

    def __init__(self, values: Single, needed: Mask) -> None:
        """Take embeddings (t, z, y, x, E) and the mask (t, z, y, x) of the needed vertices."""
        self._values, self._needed = values, needed
        self.shape: tuple[int, ...] = values.shape

    def read(self, region: Region) -> Single:
        """Return the embeddings of a region."""
        return self._values[region]

    def needed(self, region: Region) -> Mask:
        """Return which vertices of a region surround a vertex of the coreset."""
        return self._needed[region[:4]]


def trained_tables(
    architecture: Architecture, coreset: Coreset, bricks: Bricks, fine: Single, tables: list[Single]
) -> list[TrainedTable]:
    """Return the tables of all levels, finest first.

    Args:
        architecture: the sizes of the tables.
        coreset: the training samples.
        bricks: the bricks of the coreset.
        fine: finest embeddings (E, samples), in the order of `Coreset.values`.
        tables: the coarser tables, each (buckets, E).
    """
    size, levels = architecture.embedding_size, architecture.levels
    needed = needed_by(architecture, coreset)
    coarse = [
        CoarseTable(
            table.reshape(*level, size),
            np.stack([needed.mask(number, node) for node in range(level[0])]),
        )
        for number, (table, level) in enumerate(zip(tables, levels[1:], strict=True), start=1)
    ]
    return [FinestTable(coreset, bricks, fine), *coarse]


def _keys_and_box(region: Region) -> tuple[range, Box]:
    """Return the key frames and the box of a region of the finest level."""
    t, z, y, x = ((axis.start, axis.stop) for axis in region[:4])
    return range(*t), Box(z, y, x)


FEW_BRICKS = 128
"""Bricks of some 1024 samples each that stand for all."""
Points = tuple[list[Double], Single]
"""Key indices, z, y and x of some samples, and their values."""


class Samples:
    """The coreset at the key frames and the steps between, and errors of networks there.

    The fringe does not count: the promise is about the coreset. Errors are of normalised values,
    which a reader decodes and clips to their range.

    Attributes:
        count: number of samples.
    """

    def __init__(self, coreset: Coreset) -> None:
        self._coreset, counts = coreset, coreset.counts
        self.count = int(counts.sum())
        held = np.flatnonzero(counts)
        self._steps = np.split(held, np.flatnonzero(np.diff(coreset.bricks[held, 0])) + 1)
        few = held[:: -(-len(held) // FEW_BRICKS)]
        self._few = [self._points(few[number : number + 1]) for number in range(len(few))]

    def error(self, network: Network) -> float:
        """Return the mean squared error at all samples, step by step."""
        return _error(network, map(self._points, self._steps))

    def error_of_few(self, network: Network) -> float:
        """Return the mean squared error at the samples of few bricks, evenly spread."""
        return _error(network, self._few)

    def slopes(self, network: Network) -> Single:
        """Return the derivatives (inputs, n) of the value by each input at few samples."""
        slopes = [input_slopes(network, np.stack(points)) for points, _ in self._few]
        return np.concatenate(slopes, axis=1)

    def _points(self, bricks: Longs) -> Points:
        """Return the samples of some bricks of a step."""
        coreset = self._coreset
        bits = np.unpackbits(coreset.mask_bits[bricks], axis=1, count=prod(coreset.brick_shape))
        brick, vertex = np.nonzero(bits)
        places = coreset.sample_indices(bricks)
        if coreset.fringe is not None:
            kept = ~coreset.fringe[places]
            brick, vertex, places = brick[kept], vertex[kept], places[kept]
        corners = coreset.bricks[bricks, 1:] * np.array(coreset.brick_shape)
        inside = np.unravel_index(vertex, coreset.brick_shape)
        space = [
            (corner[brick] + at).astype(np.float64)
            for corner, at in zip(corners.T, inside, strict=True)
        ]
        key = np.full(len(places), coreset.key_places[coreset.bricks[bricks[0], 0]])
        return [key, *space], coreset.values[places]


def _error(network: Network, groups: Iterable[Points]) -> float:
    """Return the mean squared error at the samples of all groups."""
    squares, count = [], 0
    for points, values in groups:
        decoded = np.clip(sample_points(network, *points).astype(np.float64), 0.0, 1.0)
        squares.append(float(np.square(decoded - values).sum()))
        count += len(values)
    return fsum(squares) / count


WEIGHT_STEPS = tuple(2.0**-power for power in range(2, 13))
"""Scales tried for the weights of a matrix, as shares of their root mean square."""
MOST = 32767
"""Largest whole number of a layer in a file: int16."""
MASK_VERTICES = 4 << 20
"""Vertices of a tile of masks; a frame is read by decoding one tile."""


def quantised_layers(
    layers: Sequence[Layer], error: Callable[[Sequence[Layer]], float], allowed: float
) -> tuple[list[Layer], list[float] | None, float]:
    """Return layers whose numbers are whole multiples of a scale, and the scales.

    Weights have the largest scale of those tried at which the error stays allowed.

    Args:
        layers: weight and bias of each layer.
        error: that some layers add to the mean squared error of the model.
        allowed: the most of it.

    Returns:
        The layers as the file will have them, the scales of weight and bias of each layer in turn,
        and the error that they add; the layers as they are, None and 0 where no scale is allowed.
    """
    for share in WEIGHT_STEPS:
        scales = [
            float(str(np.float32(scale)))
            for weight, bias in layers
            for scale in (share * _root_mean_square(weight), np.abs(bias).max() / MOST)
        ]
        numbers = _whole_numbers(layers, scales)
        if any(np.abs(each).max() > MOST for each in numbers):
            continue
        found = [
            (each * np.float32(k)).astype(np.float32)
            for each, k in zip(numbers, scales, strict=True)
        ]
        quantised = list(zip(found[::2], found[1::2], strict=True))
        more = error(quantised)
        if more <= allowed:
            return quantised, scales, more
    return list(layers), None, 0.0


def _root_mean_square(numbers: Single) -> float:
    return float(np.sqrt(np.square(numbers, dtype=np.float64).mean()))


def _whole_numbers(layers: Sequence[Layer], scales: Sequence[float]) -> list[Single]:
    """The numbers of weight and bias of each layer in turn, as multiples of its scale."""
    parts = [part for layer in layers for part in layer]
    return [
        np.rint(part / np.float32(scale or 1.0)) for part, scale in zip(parts, scales, strict=True)
    ]


def write_layers(
    writer: ContainerWriter, layers: Sequence[Layer], scales: Sequence[float] | None
) -> None:
    """Write the layers of `quantised_layers` as one array; one takes some 500 bytes by itself."""
    numbers = [part for layer in layers for part in layer]
    if scales is not None:
        numbers = _whole_numbers(layers, scales)
    together = np.concatenate([each.ravel() for each in numbers])
    if scales is None:
        writer.add_whole(LAYERS, together)
    else:
        writer.add_whole(LAYERS, together.astype(np.int16), attributes={SCALES: list(scales)})


def write_mask(writer: ContainerWriter, coreset: Coreset) -> None:
    """Write the masks of a coreset as tiles of labels, and the bits of blocks of vertices.

    A number has one bit for each feature. More than MASK_FEATURES are written as bits of vertices.
    """
    box, grids = coreset.box.shape, coreset.grids
    keys = len(coreset.occupancy)
    steps = max(1, min(keys, MASK_VERTICES // prod(box)))
    if len(grids) > MASK_FEATURES:
        write_occupancy(writer, coreset)
        return

    def numbers(key: int) -> occupancy.Bits:
        result = np.zeros(box, np.uint8)
        for bit, packed in enumerate(grids):
            result |= occupancy.unpack(packed[key], box).view(np.uint8) << np.uint8(bit)
        return result

    writer.add_array(
        CORESET_ARRAY,
        shape=(keys, *box),
        dtype=np.uint8,
        chunk_shape=(steps, *box),
        chunks=(
            np.stack([numbers(key) for key in range(first, min(first + steps, keys))])
            for first in range(0, keys, steps)
        ),
        codecs=transform_codecs(
            TileSettings(
                transform=TransformSpec.from_dict(dict.fromkeys("tzyx", "none")),
                step=1.0,
                center=0.0,
                low=0.0,
                high=float((1 << len(grids)) - 1),
                labels=True,
            )
        ),
    )
    occupancy.write_blocks(
        writer,
        lambda key: occupancy.unpack(coreset.occupancy[key], box),
        (keys, *box),
        writer.mark().position,  # all that the file has so far: tables, network and masks
    )
