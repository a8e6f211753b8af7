"""Comparison of decoded networks with the samples of the coreset that they were trained on.

It tells the error that coding the tables makes, and how much each embedding matters.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import product
from math import fsum

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.tiles.sample import spread_order
from fhash_codec.coreset.boxes import Box
from fhash_codec.coreset.bricks import Coreset
from fhash_codec.coreset.occupancy import unpack
from fhash_codec.paper.network import Floats, Network
from fhash_codec.paper.points import decode_region, input_slopes
from fhash_codec.paper.tables.bricks import Bricks
from fhash_codec.paper.tables.tiles import Index
from fhash_formats.transform.tile.sections import Shape

MAX_FRAMES = 8
"""Unpacked masks of key frames that are kept."""
SLOPE_TILES = 16
"""About the number of tiles at which derivatives are taken."""
SLOPE_POINTS = 1024
"""About the number of samples of each of them."""


class Samples:
    """The coreset at the key frames, tile by tile of the finest level.

    Attributes:
        counts: number of samples of each tile that holds any, by its place, in C order.
        tile: vertices (t, z, y, x) of a tile.
        total: number of samples of all tiles.
        sizes: vertices (t, z, y, x) of the finest level.
    """

    def __init__(self, coreset: Coreset, bricks: Bricks, tile: Shape) -> None:
        self._bricks, self._coreset = bricks, coreset
        self._occupied = lru_cache(maxsize=MAX_FRAMES)(self._unpacked)
        self.tile, self.sizes = tile, (len(coreset.key_frames), *coreset.box.shape)
        counts = {
            index: sum(int(np.count_nonzero(self._mask(key, box))) for key in keys)
            for index in sorted(self._touched(coreset))
            for keys, box in [self._keys_and_box(index)]
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
            keys, box = self._keys_and_box(index)
            for key in keys:
                in_coreset = self._mask(key, box)
                if in_coreset.any():
                    frame = decode_region(network, key, box, requested=in_coreset)
                    decoded = np.clip(frame[in_coreset].astype(np.float64), 0.0, 1.0)
                    samples = self._bricks.samples(key, box)[in_coreset]
                    squares.append(float(np.square(decoded - samples).sum()))
                    count += len(decoded)
        return fsum(squares), count

    def slopes(self, network: Network, tiles: Sequence[Index]) -> Floats:
        """Return the derivatives (inputs, n) of the value by each input of the network.

        They are taken at evenly spread samples of some of the tiles.
        """
        slopes = []
        for index in tiles[:: -(-len(tiles) // SLOPE_TILES)]:
            keys, box = self._keys_and_box(index)
            points = np.argwhere(np.stack([self._mask(key, box) for key in keys]))
            points = points[:: -(-len(points) // SLOPE_POINTS)] + np.array(
                [keys[0], *(low for low, _ in box)]
            )
            slopes.append(input_slopes(network, points.T.astype(np.float64)))
        return np.concatenate(slopes, axis=1)

    def _mask(self, key: int, box: Box) -> npt.NDArray[np.bool_]:
        """Return which vertices of a region are in the coreset of a key frame, without fringe."""
        return self._bricks.mask(key, box) & self._occupied(key)[box.slices()]

    def _unpacked(self, key: int) -> npt.NDArray[np.bool_]:
        return unpack(self._coreset.occupancy[key], self._coreset.box.shape)

    def _touched(self, coreset: Coreset) -> set[Index]:
        """Return the places of the tiles that some brick of the coreset touches."""
        corners = coreset.bricks[:, 1:].astype(np.int64) * np.array(coreset.brick_shape)
        touched: set[Index] = set()
        for (key, *_), corner in zip(coreset.bricks.tolist(), corners.tolist(), strict=True):
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

    def _keys_and_box(self, index: Index) -> tuple[range, Box]:
        """Return the key frames and the vertices of the box that a tile covers."""
        spans = [
            (i * n, min((i + 1) * n, size))
            for i, n, size in zip(index, self.tile, self.sizes, strict=True)
        ]
        return range(*spans[0]), Box.of(spans[1:])
