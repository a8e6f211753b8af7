"""Trained tables as tiles, the loss that their coding leaves, and the small parts of a model."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import product
from math import fsum, prod
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from fhash_codec.boxes import Box
from fhash_codec.compact.attempt import even_tile
from fhash_codec.compact.sample import fill, spread_order
from fhash_codec.compact.tiles import Tile
from fhash_codec.features import occupancy
from fhash_codec.features.bricks import Coreset
from fhash_codec.features.occupancy import unpack
from fhash_codec.paper.model import decode_region, input_slopes
from fhash_codec.paper.network import Architecture, Layer, Network
from fhash_codec.paper.storage import Bricks, mix_components, needed_by, write_occupancy
from fhash_formats.container import ContainerWriter, shard_shape
from fhash_formats.container.array import transform_codecs
from fhash_formats.container.header import LAYERS, MASK_ARRAY, MASK_FEATURES
from fhash_formats.container.stored import ChunkCache
from fhash_formats.support.threads import chunk_region
from fhash_formats.support.values import Mask, Single
from fhash_formats.transform.spec import TransformSpec
from fhash_formats.transform.tile import WEIGHT, Coding, decode_tile, encode_tile
from fhash_formats.transform.tile_format import Shape, TileSettings

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


Index = tuple[int, int, int, int]
"""Place (t, z, y, x) of a tile in the grid of tiles."""
TILE_VERTICES = 1 << 21
"""About the largest number of vertices in a tile: with more tiles, their borders cost bytes."""
FEW_TILES = 16
"""Number of tiles from which on a tile has fewer time nodes, so that a frame is read in time."""
TILE_STEPS = (32, 8)
"""Largest numbers of time nodes in a tile, of few tiles and of many."""
CACHE_BYTES = 64 << 20
"""Bytes of decoded tiles of one table that stay in memory."""
BATCH = 8
"""Tiles that are worked on at a time."""
ROUNDS = 2
"""Projections by which the coder fills vertices that are not needed once more."""
DENSITY = 8
"""Thoroughness of their filling; see `compact.sample.fill`."""
FILLINGS_BYTES = 512 << 20
"""Bytes of the filled tiles of one table that are kept from one step to the next, at most."""


@dataclass(frozen=True, kw_only=True)
class LevelCoding:
    """The coding of the table of a level.

    Attributes:
        tile: vertices (t, z, y, x) of a tile.
        mixing: float32 (E, E), the embeddings that 1 of each component adds
            (`storage.mix_components`).
        unmixing: float64 (E, E); components = unmixing @ embedding.
        settings: settings of each component. Their quantiser steps are all the same.
        fillings: components of tiles whose vertices are not all needed, filled at the first step
            that is tried; all steps share them.
    """

    tile: Shape
    mixing: Single
    unmixing: npt.NDArray[np.float64]
    settings: tuple[TileSettings, ...]
    fillings: dict[Index, list[Tile]] = field(default_factory=dict)

    def with_step(self, quantiser_step: float) -> LevelCoding:
        """Return the same coding with another quantiser step."""
        return replace(
            self,
            settings=tuple(replace(settings, step=quantiser_step) for settings in self.settings),
        )


class TiledTable:
    """A `TableSource` of the embeddings that the tiles of a table decode to.

    A tile is coded when it is first read. One thread at a time may use the table.
    """

    def __init__(
        self, table: TrainedTable, coding: LevelCoding, workers: ThreadPoolExecutor
    ) -> None:
        self.table, self.coding = table, coding
        self.shape = table.shape
        self.grid: Index = tuple(
            -(-length // n) for length, n in zip(self.shape[:4], coding.tile, strict=True)
        )  # type: ignore[assignment]
        self._workers = workers
        self._streams: dict[Index, list[bytes]] = {}
        self._decoded = ChunkCache(CACHE_BYTES)

    def read(self, region: Region) -> Single:
        """Return the embeddings (t, z, y, x, E) of a region of 5 slices, as the file has them."""
        tile = self.coding.tile
        spans = [
            range(axis.start // n, -(-axis.stop // n))
            for axis, n in zip(region, tile, strict=False)
        ]
        result = np.empty([axis.stop - axis.start for axis in region], np.float32)
        for index, values in self._tiles(list(product(*spans))):  # type: ignore[arg-type]
            target, source = [], []
            for i, n, axis in zip(index, tile, region, strict=False):
                low, high = max(axis.start, i * n), min(axis.stop, (i + 1) * n)
                target.append(slice(low - axis.start, high - axis.start))
                source.append(slice(low - i * n, high - i * n))
            result[tuple(target)] = values[(*source, region[4])]
        return result

    @property
    def step(self) -> float:
        """The quantiser step of all components."""
        return self.coding.settings[0].step

    @property
    def shard(self) -> tuple[int, ...]:
        """Vertices (t, z, y, x) of a shard."""
        return shard_shape(self.coding.tile, self.grid)

    def streams(self, component: int) -> Iterator[bytes]:
        """Return the coded tiles of a component, in C order."""
        indices: list[Index] = list(product(*(range(n) for n in self.grid)))  # type: ignore[arg-type]
        for _ in self._tiles([index for index in indices if index not in self._streams]):
            pass
        return (self._streams[index][component] for index in indices)

    def _tiles(self, indices: Sequence[Index]) -> Iterator[tuple[Index, Single]]:
        """Yield decoded tiles (t, z, y, x, E), all of full size; a few are worked on at a time."""
        for start in range(0, len(indices), BATCH):
            batch = indices[start : start + BATCH]
            # This thread alone uses the cache and reads the table; all threads code.
            cached = {index: self._decoded.get(("", index, 0)) for index in batch}
            pending = {index: self._begin(index) for index, tile in cached.items() if tile is None}
            for index, tile in cached.items():
                if tile is None:
                    self._streams[index], tile = pending[index].result()
                    self._decoded.put(("", index, 0), tile)
                yield index, tile

    def _begin(self, index: Index) -> Future[tuple[list[bytes], Single]]:
        """Start the work on a tile; its result is the stream of each component, and the tile."""
        if index in self._streams:
            return self._workers.submit(self._decode, self._streams[index])
        tiles = self.coding.fillings.get(index)
        if tiles is None:
            region = tile_region(index, self.coding.tile, self.shape)
            components, needed = components_of(self.table, self.coding, region)
            counted = None if needed.all() else needed
            tiles = [Tile(component, counted) for component in components]
            if counted is not None:
                return self._workers.submit(self._fill_and_code, index, tiles)
        return self._workers.submit(self._code, tiles)

    def _fill_and_code(self, index: Index, tiles: list[Tile]) -> tuple[list[bytes], Single]:
        """Fill a tile, for this step and, where there is memory, for those that are still tried."""
        tiles = [
            fill(tile, settings, DENSITY)
            for tile, settings in zip(tiles, self.coding.settings, strict=True)
        ]
        own = sum(tile.values.nbytes for tile in tiles)
        if own * (len(self.coding.fillings) + 1) <= FILLINGS_BYTES:
            self.coding.fillings[index] = tiles
        return self._code(tiles)

    def _code(self, tiles: list[Tile]) -> tuple[list[bytes], Single]:
        coded = [
            code_tile(tile, settings)
            for tile, settings in zip(tiles, self.coding.settings, strict=True)
        ]
        return [data for data, _ in coded], mix_components(
            [decoded for _, decoded in coded], self.coding.mixing
        )

    def _decode(self, streams: list[bytes]) -> tuple[list[bytes], Single]:
        components = [
            decode_tile(data, self.coding.tile, np.float32, settings)
            for data, settings in zip(streams, self.coding.settings, strict=True)
        ]
        return streams, mix_components(components, self.coding.mixing)


def tile_shape(resolution: Shape) -> Shape:
    """Return the tile (t, z, y, x) of a level of a resolution (t, z, y, x).

    The level is cut evenly into tiles of about TILE_VERTICES vertices.
    """
    tiles = -(-prod(resolution) // TILE_VERTICES)
    steps = TILE_STEPS[tiles >= FEW_TILES]
    return even_tile(resolution, tiles, min(steps, resolution[0]))


def tile_region(index: Index, tile: Shape, shape: Sequence[int]) -> Region:
    """Return the part (t, z, y, x) of a table that a tile covers.

    Args:
        index: place of the tile in the grid of tiles.
        tile: vertices of a tile.
        shape: lengths of the axes of the table; those after x are ignored.
    """
    return chunk_region(index, tile, shape[: len(tile)])


def components_of(
    table: TrainedTable, coding: LevelCoding, region: Region
) -> tuple[list[Single], Mask]:
    """Return the components of a region, padded to a whole tile, and the needed vertices.

    The components repeat their border values beyond the table; vertices there are not needed.
    """
    embeddings, needed = table.read((*region, slice(0, table.shape[4]))), table.needed(region)
    padding = [(0, n - m) for n, m in zip(coding.tile, needed.shape, strict=True)]
    components = [
        np.pad((embeddings @ row).astype(np.float32), padding, mode="edge")
        for row in coding.unmixing
    ]
    return components, np.pad(needed, padding)


def code_tile(tile: Tile, settings: TileSettings) -> tuple[bytes, npt.NDArray[Any]]:
    """Return the stream of one component of a filled tile, and the values that it decodes to."""
    rounds = 0 if tile.counted is None else ROUNDS
    coding = Coding(weight=WEIGHT, rounds=rounds, filled=True)
    coded = encode_tile(tile.values, settings, coding, in_coreset=tile.counted)
    return coded.data, coded.decoded


MAX_FRAMES = 8
"""Unpacked masks of key frames that are kept."""
SLOPE_TILES = 16
"""About the number of tiles at which derivatives are taken."""
SLOPE_POINTS = 1024
"""About the number of samples of each of them."""


class Samples:
    """The coreset at the key frames and the steps between, tile by tile of the finest level.

    Attributes:
        counts: number of samples of each tile that holds any, by its place, in C order.
        tile: vertices (t, z, y, x) of a tile; the steps after a key frame belong to it.
        total: number of samples of all tiles.
        sizes: vertices (t, z, y, x) of the finest level.
    """

    def __init__(self, coreset: Coreset, tile: Shape) -> None:
        self._bricks, self._coreset = Bricks(coreset), coreset
        self._occupied = lru_cache(maxsize=MAX_FRAMES)(self._unpacked)
        self._in_order = np.argsort(coreset.key_places, kind="stable")
        self.tile, self.sizes = tile, (len(coreset.key_frames), *coreset.box.shape)
        counts = {
            index: sum(int(np.count_nonzero(self._mask(step, box))) for step in steps)
            for index in sorted(self._touched(coreset))
            for steps, box in [self._steps_and_box(index)]
        }
        self.counts = {index: count for index, count in counts.items() if count}
        self.total = sum(self.counts.values())

    def choose(self, samples: int) -> list[Index]:
        """Return evenly spread tiles, at least one, in C order.

        They hold at most so many samples together, unless a single tile holds more.
        """
        indices = list(self.counts)
        chosen: list[Index] = []
        for number in spread_order(len(indices)):
            if not chosen or samples >= self.counts[indices[number]]:
                chosen.append(indices[number])
                samples -= self.counts[indices[number]]
        return sorted(chosen)

    def squares(self, network: Network, tiles: Sequence[Index]) -> tuple[float, int]:
        """Return the sum of squared errors at the samples of some tiles, and their number.

        The errors are of normalised values, which a reader decodes and clips to their range.
        """
        squares, count = [], 0
        for index in tiles:
            steps, box = self._steps_and_box(index)
            for step in steps:
                in_coreset = self._mask(step, box)
                if in_coreset.any():
                    place = float(self._coreset.key_places[step])
                    frame = decode_region(network, place, box, requested=in_coreset)
                    decoded = np.clip(frame[in_coreset].astype(np.float64), 0.0, 1.0)
                    samples = self._bricks.samples(step, box)[in_coreset]
                    squares.append(float(np.square(decoded - samples).sum()))
                    count += len(decoded)
        return fsum(squares), count

    def slopes(self, network: Network, tiles: Sequence[Index]) -> Single:
        """Return the derivatives (inputs, n) of the value by each input of the network.

        They are taken at evenly spread samples of some of the tiles.
        """
        slopes = []
        for index in tiles[:: -(-len(tiles) // SLOPE_TILES)]:
            steps, box = self._steps_and_box(index)
            points = np.argwhere(np.stack([self._mask(step, box) for step in steps]))
            points = points[:: -(-len(points) // SLOPE_POINTS)]
            places = self._coreset.key_places[np.array(steps)[points[:, 0]]]
            inside = (points[:, 1:] + np.array([low for low, _ in box])).T.astype(np.float64)
            slopes.append(input_slopes(network, np.concatenate([places[None], inside])))
        return np.concatenate(slopes, axis=1)

    def _mask(self, step: int, box: Box) -> npt.NDArray[np.bool_]:
        """Return which vertices of a region are samples of a step, without fringe."""
        mask = self._bricks.mask(step, box)
        between = step >= len(self._coreset.key_frames)
        return mask if between else mask & self._occupied(step)[box.slices()]

    def _unpacked(self, key: int) -> npt.NDArray[np.bool_]:
        return unpack(self._coreset.occupancy[key], self._coreset.box.shape)

    def _touched(self, coreset: Coreset) -> set[Index]:
        """Return the places of the tiles that some brick of the coreset touches."""
        corners = coreset.bricks[:, 1:].astype(np.int64) * np.array(coreset.brick_shape)
        touched: set[Index] = set()
        keys = coreset.key_places[coreset.bricks[:, 0]].astype(np.int64)
        for key, corner in zip(keys.tolist(), corners.tolist(), strict=True):
            ends = [
                min(low + n, size) - 1
                for low, n, size in zip(corner, coreset.brick_shape, self.sizes[1:], strict=True)
            ]
            z, y, x = (
                range(low // n, end // n + 1)
                for low, end, n in zip(corner, ends, self.tile[1:], strict=True)
            )
            touched.update(product((key // self.tile[0],), z, y, x))
        return touched

    def _steps_and_box(self, index: Index) -> tuple[list[int], Box]:
        """Return the steps of the samples and the vertices of the box that a tile covers."""
        spans = [
            (i * n, min((i + 1) * n, size))
            for i, n, size in zip(index, self.tile, self.sizes, strict=True)
        ]
        first, end = np.searchsorted(self._coreset.key_places[self._in_order], spans[0])
        return np.sort(self._in_order[first:end]).tolist(), Box.of(spans[1:])


MIN_WEIGHTS = 512
"""Smallest matrix that is quantised: the description of its coding takes some 200 bytes."""
WEIGHT_STEPS = tuple(2.0**-power for power in range(2, 13))
"""Quantiser steps tried for the weights of a matrix, as shares of their root mean square."""
MASK_VERTICES = 4 << 20
"""Vertices of a chunk of the occupancy; a frame is read by decoding one chunk."""

_PLAIN = TransformSpec.from_dict(dict.fromkeys("tzyx", "none"))


def quantised_layers(
    layers: Sequence[Layer], error: Callable[[Sequence[Layer]], float], allowed: float
) -> tuple[list[Layer], list[TileSettings | None]]:
    """Return layers with quantised weights, and how each matrix is coded.

    The step is the largest at which the error of the model stays allowed.

    Args:
        layers: weight and bias of each layer.
        error: mean squared error of the model with some layers.
        allowed: largest error.

    Returns:
        The layers as the file will have them, and the settings of each matrix; None for a matrix
        that is not quantised.
    """
    for share in WEIGHT_STEPS:
        settings = [_weight_settings(weight, share) for weight, _ in layers]
        quantised = [
            (weight if how is None else _decoded(weight, how), bias)
            for (weight, bias), how in zip(layers, settings, strict=True)
        ]
        if error(quantised) <= allowed:
            return quantised, settings
    return list(layers), [None] * len(layers)


def write_layers(
    writer: ContainerWriter, layers: Sequence[Layer], settings: Sequence[TileSettings | None]
) -> None:
    """Write the layers of `quantised_layers`: as one array, unless some are coded.

    An array takes some 500 bytes beside its numbers.
    """
    if not any(settings):
        numbers = [part.ravel() for layer in layers for part in layer]
        writer.add_whole(LAYERS, np.concatenate(numbers))
        return
    for number, ((weight, bias), how) in enumerate(zip(layers, settings, strict=True), start=1):
        codecs = None if how is None else transform_codecs(how)
        writer.add_whole(f"mlp/weight_{number}", weight, codecs=codecs)
        writer.add_whole(f"mlp/bias_{number}", bias)


def write_mask(writer: ContainerWriter, coreset: Coreset) -> None:
    """Write the occupancy of a coreset as `occupancy/mask`, coded as labels.

    A number has one bit for each feature. More than MASK_FEATURES are written as bits.
    """
    box, grids = coreset.box.shape, coreset.grids
    keys = len(coreset.occupancy)
    steps = max(1, min(keys, MASK_VERTICES // prod(box)))
    if len(grids) > MASK_FEATURES:
        write_occupancy(writer, coreset)
        return

    def numbers(key: int) -> npt.NDArray[np.uint8]:
        result = np.zeros(box, np.uint8)
        for bit, packed in enumerate(grids):
            result |= occupancy.unpack(packed[key], box).view(np.uint8) << np.uint8(bit)
        return result

    writer.add_array(
        MASK_ARRAY,
        shape=(keys, *box),
        dtype=np.uint8,
        chunk_shape=(steps, *box),
        chunks=(
            np.stack([numbers(key) for key in range(first, min(first + steps, keys))])
            for first in range(0, keys, steps)
        ),
        dimension_names=("t", "z", "y", "x"),
        codecs=transform_codecs(
            TileSettings(
                transform=_PLAIN,
                step=1.0,
                center=0.0,
                low=0.0,
                high=float((1 << len(grids)) - 1),
                labels=True,
            )
        ),
    )


def _weight_settings(weight: Single, share: float) -> TileSettings | None:
    """Return the settings of a matrix for a step, as a share of the root mean square."""
    size = float(np.sqrt(np.square(weight, dtype=np.float64).mean()))
    if weight.size < MIN_WEIGHTS or not size > 0:
        return None
    return TileSettings(
        transform=_PLAIN,
        step=float(str(np.float32(share * size))),
        center=0.0,
        low=float(str(weight.min())),
        high=float(str(weight.max())),
    )


def _decoded(weight: Single, settings: TileSettings) -> Single:
    """Return a matrix as a reader of the file gets it."""
    shape = weight.shape
    tile = encode_tile(weight.reshape(1, 1, *shape), settings, Coding())
    return np.ascontiguousarray(tile.decoded.reshape(shape))
