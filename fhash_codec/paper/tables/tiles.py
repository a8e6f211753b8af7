"""A trained table as coded tiles, and the embeddings that they decode to.

The decoded embeddings are those that a reader of the file will get, known before it is written.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import product
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.tiles.tiling import even_tile
from fhash_codec.paper.network import Floats
from fhash_codec.paper.storage import mix_components
from fhash_codec.paper.tables.trained_tables import Mask, Region, TrainedTable
from fhash_formats.container import shard_shape
from fhash_formats.container.stored import ChunkCache
from fhash_formats.support.slabs import chunk_region
from fhash_formats.transform.tile.decoding import decode_tile
from fhash_formats.transform.tile.encoding import Coding, encode_tile
from fhash_formats.transform.tile.integers import WEIGHT
from fhash_formats.transform.tile.sections import Shape
from fhash_formats.transform.tile.settings import TileSettings

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
"""Projections by which the coder fills vertices that are not needed."""


@dataclass(frozen=True, kw_only=True)
class LevelCoding:
    """The coding of the table of a level.

    Attributes:
        tile: vertices (t, z, y, x) of a tile.
        mixing: float32 (E, E), the embeddings that 1 of each component adds
            (`storage.mix_components`).
        unmixing: float64 (E, E); components = unmixing @ embedding.
        settings: settings of each component. Their quantiser steps are all the same.
    """

    tile: Shape
    mixing: Floats
    unmixing: npt.NDArray[np.float64]
    settings: tuple[TileSettings, ...]

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

    def read(self, region: Region) -> Floats:
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

    def _tiles(self, indices: Sequence[Index]) -> Iterator[tuple[Index, Floats]]:
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

    def _begin(self, index: Index) -> Future[tuple[list[bytes], Floats]]:
        """Start the work on a tile; its result is the stream of each component, and the tile."""
        if index in self._streams:
            return self._workers.submit(self._decode, self._streams[index])
        region = tile_region(index, self.coding.tile, self.shape)
        return self._workers.submit(self._code, *components_of(self.table, self.coding, region))

    def _code(self, components: list[Floats], needed: Mask) -> tuple[list[bytes], Floats]:
        coded = [
            code_tile(component, needed, settings)
            for component, settings in zip(components, self.coding.settings, strict=True)
        ]
        return [data for data, _ in coded], mix_components(
            [decoded for _, decoded in coded], self.coding.mixing
        )

    def _decode(self, streams: list[bytes]) -> tuple[list[bytes], Floats]:
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
) -> tuple[list[Floats], Mask]:
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


def code_tile(
    component: Floats, needed: Mask, settings: TileSettings
) -> tuple[bytes, npt.NDArray[Any]]:
    """Return the stream of one component of a tile, and the values that it decodes to."""
    complete = bool(needed.all())
    coded = encode_tile(
        component,
        settings,
        Coding(weight=WEIGHT, rounds=0 if complete else ROUNDS),
        in_coreset=None if complete else needed,
    )
    return coded.data, coded.decoded
