"""Regions of the box out of a coreset's bricks, without a dense frame."""

from __future__ import annotations

from math import prod
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.boxes import Box, Sizes
from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.network import Floats

Scalar = TypeVar("Scalar", bound=np.generic)
Mask = npt.NDArray[np.bool_]
Whole = npt.NDArray[np.int64]


class Bricks:
    """The bricks of a coreset by their place. Regions are in vertices of the box; where no brick lies stands 0 or False."""

    def __init__(self, coreset: Coreset) -> None:
        self._coreset = coreset
        key, z, y, x = coreset.bricks.T.astype(np.int64)
        # They come in ascending order, so that a place is found by bisection.
        self._places = self._place(key, z, y, x)

    def mask(self, key: int, box: Box) -> Mask:
        """Which vertices (z, y, x) of a region are samples at a key frame."""
        where, found = self._in(key, box)
        return self._region(self._kept(found), where, box)

    def samples(self, key: int, box: Box) -> Floats:
        """The normalised values (z, y, x) of a region at a key frame."""
        where, found = self._in(key, box)
        first, last = self._coreset.offsets[found], self._coreset.offsets[found + 1]
        values = np.zeros((len(found), prod(self._coreset.brick_shape)), np.float32)
        parts = [
            self._coreset.values[low:high]
            for low, high in zip(first.tolist(), last.tolist(), strict=True)
        ]
        if parts:
            values[self._kept(found)] = np.concatenate(parts)
        return self._region(values, where, box)

    def embeddings(self, fine: Floats, key: int, box: Box) -> Floats:
        """Embeddings (z, y, x, E) of a region at a key frame out of those of all bricks, (bricks, E, vertices of a brick)."""
        where, found = self._in(key, box)
        return np.stack(
            [self._region(fine[found, number], where, box) for number in range(fine.shape[1])],
            axis=-1,
        )

    def _place(self, key: Whole, z: Whole, y: Whole, x: Whole) -> Whole:
        grid = self._coreset.brick_grid
        return ((key * grid[0] + z) * grid[1] + y) * grid[2] + x

    def _in(self, key: int, box: Box) -> tuple[tuple[Mask, Sizes], npt.NDArray[np.intp]]:
        """Where among the places of the grid that a region touches bricks lie, and the numbers of these bricks."""
        z, y, x = (
            np.arange(low // n, -(-high // n))
            for (low, high), n in zip(box, self._coreset.brick_shape, strict=True)
        )
        places = self._place(np.array(key), z[:, None, None], y[:, None], x)
        numbers = np.searchsorted(self._places, places)
        there = np.zeros(places.shape, bool)
        inside = numbers < len(self._places)
        there[inside] = self._places[numbers[inside]] == places[inside]
        return (there, (int(z[0]), int(y[0]), int(x[0]))), numbers[there]

    def _kept(self, found: npt.NDArray[np.intp]) -> Mask:
        """Which vertices (bricks, vertices of a brick) are samples."""
        bits = np.unpackbits(
            self._coreset.mask_bits[found], axis=1, count=prod(self._coreset.brick_shape)
        )
        return bits.view(np.bool_)

    def _region(
        self, blocks: npt.NDArray[Scalar], where: tuple[Mask, Sizes], box: Box
    ) -> npt.NDArray[Scalar]:
        """The region out of the contents (bricks, vertices of a brick) of the bricks that touch it."""
        (there, first), shape = where, self._coreset.brick_shape
        whole = np.zeros((*there.shape, *shape), blocks.dtype)
        whole[there] = blocks.reshape(-1, *shape)
        joined = whole.transpose(0, 3, 1, 4, 2, 5).reshape(
            [count * n for count, n in zip(there.shape, shape, strict=True)]
        )
        return joined[
            tuple(
                slice(low - at * n, high - at * n)
                for (low, high), at, n in zip(box, first, shape, strict=True)
            )
        ]
