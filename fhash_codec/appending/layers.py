"""Coding of one layer of tiles: some steps of the whole domain."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.appending.figures import Figures, StepErrors
from fhash_codec.compact.tiles.blocks import Tile
from fhash_codec.compact.tiles.coding import Coding, code
from fhash_codec.measure.value_range import ValueRange
from fhash_formats.support.number_types import exact_number, is_within
from fhash_formats.support.slabs import chunk_region
from fhash_formats.support.threads import map_ahead, usable_threads
from fhash_formats.transform.tile.decoding import decode_tile
from fhash_formats.transform.tile.encoding import CodedTile
from fhash_formats.transform.tile.settings import TileSettings

__all__ = ["CodedLayer", "LayerCoder"]

DECODED_AGAIN = 8
"""Tiles of which one is decoded from its bytes, as a reader does it."""
Index = tuple[int, int, int]


@dataclass(frozen=True, kw_only=True)
class CodedLayer:
    """A layer of tiles, coded.

    Attributes:
        streams: bytes of each tile, in C order.
        errors: of each step.
        nonzero: number of coefficients that are not 0.
        value_range: of the values, in data units.
    """

    streams: list[bytes]
    errors: list[StepErrors]
    nonzero: int
    value_range: ValueRange


@dataclass(frozen=True, kw_only=True)
class LayerCoder:
    """Coder of the layers of a file; its tiles keep a strict bound of the error.

    Attributes:
        tile: shape (t, z, y, x) of a tile.
        settings: that all tiles share.
        coding: options of the encoder, the bound among them.
        dtype: number type of the values.
    """

    tile: tuple[int, int, int, int]
    settings: TileSettings
    coding: Coding
    dtype: np.dtype[Any]

    def code(
        self, frames: Sequence[npt.NDArray[Any]], figures: Figures, workers: ThreadPoolExecutor
    ) -> CodedLayer:
        """Code some steps, at most those of a tile; a shorter layer is padded by its last step.

        frames: finite values (z, y, x) of each step. figures: measures the errors.
        """
        values = np.stack(frames)
        decoded = np.empty_like(values)
        grid = [-(-n // length) for n, length in zip(values.shape[1:], self.tile[1:], strict=True)]
        streams, nonzero = [], 0
        indices: list[Index] = [(z, y, x) for z, y, x in product(*map(range, grid))]
        tiles = (self._tile(values, index) for index in indices)
        coded = map_ahead(workers, self._code, enumerate(tiles), 2 * usable_threads())
        for index, tile in zip(indices, coded, strict=True):
            region = chunk_region(index, self.tile[1:], values.shape[1:])
            part = decoded[(slice(None), *region)]
            part[...] = tile.decoded[tuple(slice(0, n) for n in part.shape)]
            streams.append(tile.data)
            nonzero += tile.nonzero
        errors = [figures.measure(*pair) for pair in zip(values, decoded, strict=True)]
        value_range = ValueRange(*_ends(values))
        return CodedLayer(streams=streams, errors=errors, nonzero=nonzero, value_range=value_range)

    def _tile(self, values: npt.NDArray[Any], index: Index) -> Tile:
        """A tile of a layer; beyond the end of an axis border values are repeated and not counted.

        As `Blocks.read` makes it.
        """
        region = (slice(None), *chunk_region(index, self.tile[1:], values.shape[1:]))
        part = values[region]
        padding = [(0, n - m) for n, m in zip(self.tile, part.shape, strict=True)]
        if not any(after for _, after in padding):
            return Tile(np.ascontiguousarray(part), None)
        counted = np.pad(np.ones(part.shape, bool), padding)
        return Tile(np.pad(part, padding, mode="edge"), counted)

    def _code(self, job: tuple[int, Tile]) -> CodedTile:
        """Code a tile, by settings of its own where its values leave the range of the shared ones.

        The bound holds either way. The shared ones clip such values, and the residual then has to
        bring them back; of the two codings the one with fewer bytes is taken.
        """
        number, tile = job
        own = replace(self.coding, own_settings=True)
        trials = [(code(tile, other, own)[0], other) for other in self._wider(tile)]
        if not self._is_far(tile):
            trials.insert(0, (code(tile, self.settings, self.coding)[0], self.settings))
        coded, settings = min(trials, key=lambda trial: len(trial[0].data))
        if number % DECODED_AGAIN == 0:
            again = decode_tile(coded.data, self.tile, self.dtype, settings)
            if not np.array_equal(again, coded.decoded):
                raise RuntimeError(f"tile {number} decodes to other values than its encoder found")
        return coded

    def _is_far(self, tile: Tile) -> bool:
        """Whether the differences from the origin that tiles share are beyond int64."""
        origin = self.settings.origin
        return origin != 0 and not all(
            is_within(int(end) - origin, np.dtype(np.int64)) for end in _ends(tile.values)
        )

    def _wider(self, tile: Tile) -> Iterator[TileSettings]:
        """Yield settings with a wider range for a tile whose values leave that of the file."""
        shared = self.settings
        ends = ValueRange(*_ends(tile.values))
        low, high = ends.moved(-shared.origin).ends
        if self._is_far(tile):
            origin = ends.origin(self.dtype)
            low, high = ends.moved(-origin).ends
            wider = replace(shared, origin=origin, center=0.0, low=low, high=high)
            yield replace(wider, double=True, head=None, predictor=None)
            return
        if self.coding.exact or (shared.low <= low and high <= shared.high):
            return
        yield replace(
            shared,
            low=min(low, shared.low),
            high=max(high, shared.high),
            head=None,
            predictor=None,
            clip=False,
        )


def _ends(values: npt.NDArray[Any]) -> tuple[float, float]:
    """The least and the greatest of finite values, exactly."""
    return exact_number(values.min().item()), exact_number(values.max().item())
