"""A trained table as coded tiles, and what they decode to: what the reader of the file will get, before it is written."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import product
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.tiles.coding import WEIGHT
from fhash_codec.compact.tiles.sample import MAX_TILES_AHEAD
from fhash_codec.compact.tiles.tiling import shard_shape
from fhash_codec.paper.network import Floats
from fhash_codec.paper.regions import block_shape
from fhash_codec.paper.storage import mixed
from fhash_codec.paper.tables.trained_tables import Region, TrainedTable
from fhash_formats.container.cache import ChunkCache
from fhash_formats.transform.tile.encoding import Shape, decode_tile, encode_tile
from fhash_formats.transform.tile.settings import TileSettings

Index = tuple[int, int, int, int]
TILE_STEPS, TILE_VERTICES = 8, 1 << 16
"""Time nodes of a tile, and about how many vertices of each."""
CACHE_BYTES = 64 << 20
ROUNDS = 2
"""Projections of what does not count."""


@dataclass(frozen=True, kw_only=True)
class Coding:
    """How a level is coded.

    Attributes:
        tile: vertices (t, z, y, x) of a tile. mixing: float32 (E, E), the embeddings that 1 of each component adds (`storage.mixed`).
        unmixing: float64 (E, E), components = unmixing @ embedding. settings: of each component; their steps are all the same.
    """

    tile: Shape
    mixing: Floats
    unmixing: npt.NDArray[np.float64]
    settings: tuple[TileSettings, ...]

    def with_step(self, step: float) -> Coding:
        """The same with another quantiser step."""
        return replace(
            self, settings=tuple(replace(settings, step=step) for settings in self.settings)
        )


class TiledTable:
    """A `TableSource` of what the tiles of a table decode to; each is coded when it is first asked for. One thread at a time."""

    def __init__(self, table: TrainedTable, coding: Coding, workers: ThreadPoolExecutor) -> None:
        self.table, self.coding = table, coding
        self.shape = table.shape
        self.grid: Index = tuple(
            -(-n // part) for n, part in zip(self.shape[:4], coding.tile, strict=True)
        )  # type: ignore[assignment]
        self._workers = workers
        self._streams: dict[Index, list[bytes]] = {}
        self._decoded = ChunkCache(CACHE_BYTES)

    def read(self, region: Region) -> Floats:
        """Embeddings (t, z, y, x, E) of a region of 5 slices, float32, as the file will have them."""
        tile = self.coding.tile
        spans = [
            range(part.start // n, -(-part.stop // n))
            for part, n in zip(region, tile, strict=False)
        ]
        result = np.empty([part.stop - part.start for part in region], np.float32)
        for index, values in self._tiles(list(product(*spans))):  # type: ignore[arg-type]
            target, source = [], []
            for i, n, part in zip(index, tile, region, strict=False):
                low, high = max(part.start, i * n), min(part.stop, (i + 1) * n)
                target.append(slice(low - part.start, high - part.start))
                source.append(slice(low - i * n, high - i * n))
            result[tuple(target)] = values[(*source, region[4])]
        return result

    @property
    def shard(self) -> tuple[int, ...]:
        """Vertices (t, z, y, x) of a shard: everything, or one layer of tiles in time where there are many."""
        return shard_shape(self.coding.tile, self.grid)

    def streams(self, component: int) -> Iterator[bytes]:
        """The coded tiles of a component, in C order."""
        indices: list[Index] = list(product(*(range(n) for n in self.grid)))  # type: ignore[arg-type]
        for _ in self._tiles([index for index in indices if index not in self._streams]):
            pass
        return (self._streams[index][component] for index in indices)

    def region(self, index: Index) -> Region:
        """The part of the table that a tile holds."""
        return tuple(
            slice(i * n, min((i + 1) * n, length))
            for i, n, length in zip(index, self.coding.tile, self.shape, strict=False)
        )

    def _tiles(self, indices: Sequence[Index]) -> Iterator[tuple[Index, Floats]]:
        """Decoded tiles (t, z, y, x, E), full ones; a few are worked on at a time."""
        for start in range(0, len(indices), MAX_TILES_AHEAD):
            batch = indices[start : start + MAX_TILES_AHEAD]
            # What is cached, and what is read, is asked of one thread; coding is done by all.
            known = {index: self._decoded.get(("", index, 0)) for index in batch}
            pending = {index: self._begin(index) for index, found in known.items() if found is None}
            for index, found in known.items():
                if found is None:
                    self._streams[index], found = pending[index].result()
                    self._decoded.put(("", index, 0), found)
                yield index, found

    def _begin(self, index: Index) -> Future[tuple[list[bytes], Floats]]:
        if index in self._streams:
            return self._workers.submit(self._decode, self._streams[index])
        return self._workers.submit(
            self._code, *components_of(self.table, self.coding, self.region(index))
        )

    def _code(
        self, components: list[Floats], care: npt.NDArray[np.bool_]
    ) -> tuple[list[bytes], Floats]:
        coded = [
            code_tile(part, care, settings)
            for part, settings in zip(components, self.coding.settings, strict=True)
        ]
        return [data for data, _ in coded], mixed(
            [decoded for _, decoded in coded], self.coding.mixing
        )

    def _decode(self, streams: list[bytes]) -> tuple[list[bytes], Floats]:
        parts = [
            decode_tile(data, self.coding.tile, np.float32, settings)
            for data, settings in zip(streams, self.coding.settings, strict=True)
        ]
        return streams, mixed(parts, self.coding.mixing)


def tile_shape(resolution: Shape) -> Shape:
    """A tile of a level: whole blocks of the decoder, about TILE_VERTICES of them, of TILE_STEPS time nodes."""
    box = resolution[1:]
    shape = list(block_shape(box))
    while (growing := [axis for axis in range(3) if shape[axis] < box[axis]]) and 2 * prod(
        shape
    ) <= TILE_VERTICES:
        axis = min(growing, key=lambda axis: shape[axis])
        shape[axis] = 2 * shape[axis]
    z, y, x = (min(n, length) for n, length in zip(shape, box, strict=True))
    return -(-resolution[0] // -(-resolution[0] // TILE_STEPS)), z, y, x


def components_of(
    table: TrainedTable, coding: Coding, region: Region
) -> tuple[list[Floats], npt.NDArray[np.bool_]]:
    """The components of a region of a table, filled up to a whole tile, and what of them counts (t, z, y, x)."""
    embeddings, care = table.read((*region, slice(0, table.shape[4]))), table.cares(region)
    beyond = [(0, n - m) for n, m in zip(coding.tile, care.shape, strict=True)]
    parts = [
        np.pad((embeddings @ row).astype(np.float32), beyond, mode="edge")
        for row in coding.unmixing
    ]
    return parts, np.pad(care, beyond)


def code_tile(
    values: Floats, care: npt.NDArray[np.bool_], settings: TileSettings
) -> tuple[bytes, npt.NDArray[Any]]:
    """The stream of one component of a tile, and what it decodes to."""
    whole = bool(care.all())
    coded = encode_tile(
        values, settings, care=None if whole else care, weight=WEIGHT, rounds=0 if whole else ROUNDS
    )
    return coded.data, coded.decoded
