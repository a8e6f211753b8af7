"""What a network decodes the coreset to, compared with the samples it was trained on; and how much each embedding matters to it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from math import fsum

import numpy as np

from fhash_codec.compact.tiles.sample import spread_order
from fhash_codec.coreset.boxes import box_size
from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.network import Floats, Network
from fhash_codec.paper.points import feature_slopes
from fhash_codec.paper.regions import Box, decode_region
from fhash_codec.paper.tables.bricks import Bricks
from fhash_codec.paper.tables.tiles import Index
from fhash_formats.transform.tile.encoding import Shape

SLOPE_TILES, SLOPE_POINTS = 16, 1024
"""Tiles, and samples of each, at which derivatives are taken, about."""


class Samples:
    """The coreset at the key frames, tile by tile of the finest level.

    Attributes:
        counts: samples of each tile that holds any, by its index, in C order. tile, sizes: vertices (t, z, y, x) of a tile and in all.
    """

    def __init__(self, coreset: Coreset, bricks: Bricks, tile: Shape) -> None:
        self._bricks = bricks
        self.tile, self.sizes = tile, (len(coreset.key_frames), *box_size(coreset.box))
        corners = coreset.bricks[:, 1:].astype(np.int64) * np.array(coreset.brick_shape)
        touched: set[Index] = set()
        for (key, *_), corner in zip(coreset.bricks.tolist(), corners.tolist(), strict=True):
            ends = [
                min(low + n, size) - 1
                for low, n, size in zip(corner, coreset.brick_shape, self.sizes[1:], strict=True)
            ]
            z, y, x = (
                range(low // n, end // n + 1)
                for low, end, n in zip(corner, ends, tile[1:], strict=True)
            )
            touched.update(product((key // tile[0],), z, y, x))
        counts = {
            index: sum(int(np.count_nonzero(bricks.mask(key, box))) for key in keys)
            for index, keys, box in map(self._at, sorted(touched))
        }
        self.counts = {index: count for index, count in counts.items() if count}

    def chosen(self, most: int) -> list[Index]:
        """Evenly spread tiles of about so many samples together, at least one; in C order."""
        indices = list(self.counts)
        taken: list[Index] = []
        for number in spread_order(len(indices)):
            if not taken or most >= self.counts[indices[number]]:
                taken.append(indices[number])
                most -= self.counts[indices[number]]
        return sorted(taken)

    def squares(self, network: Network, tiles: Sequence[Index]) -> tuple[float, int]:
        """Sum of the squared errors of normalised values, as a reader decodes and clips them, and number of the samples in some tiles."""
        total, count = [], 0
        for index in tiles:
            _, keys, box = self._at(index)
            for key in keys:
                wanted = self._bricks.mask(key, box)
                if wanted.any():
                    decoded = decode_region(network, key, box, wanted=wanted)[wanted].astype(
                        np.float64
                    )
                    total.append(
                        float(
                            np.square(
                                np.clip(decoded, 0.0, 1.0) - self._bricks.samples(key, box)[wanted]
                            ).sum()
                        )
                    )
                    count += len(decoded)
        return fsum(total), count

    def slopes(self, network: Network, tiles: Sequence[Index]) -> Floats:
        """Derivatives (features, n) by each interpolated embedding at evenly spread samples of some of the tiles."""
        found = []
        for index in tiles[:: -(-len(tiles) // SLOPE_TILES)]:
            _, keys, box = self._at(index)
            places = np.argwhere(np.stack([self._bricks.mask(key, box) for key in keys]))
            places = places[:: -(-len(places) // SLOPE_POINTS)] + np.array(
                [keys[0], *(low for low, _ in box)]
            )
            found.append(feature_slopes(network, places.T.astype(np.float64)))
        return np.concatenate(found, axis=1)

    def _at(self, index: Index) -> tuple[Index, range, Box]:
        """A tile, its key frames and its vertices of the box."""
        spans = [
            (i * n, min((i + 1) * n, size))
            for i, n, size in zip(index, self.tile, self.sizes, strict=True)
        ]
        return index, range(*spans[0]), (spans[1], spans[2], spans[3])
