"""Regions of the feature bounding box out of a coreset's bricks, without a dense frame."""

from __future__ import annotations

from dataclasses import dataclass
from math import prod
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.boxes import Box, Sizes
from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.network import Floats

Scalar = TypeVar("Scalar", bound=np.generic)
Mask = npt.NDArray[np.bool_]
Integers = npt.NDArray[np.int64]


@dataclass(frozen=True)
class _Window:
    """The part of the brick grid that a region touches.

    Attributes:
        first: place (z, y, x) in the grid at which the window begins.
        stored: places (z, y, x) of the window at which the coreset has a brick.
        numbers: numbers of these bricks in the coreset.
    """

    first: Sizes
    stored: Mask
    numbers: npt.NDArray[np.intp]


class Bricks:
    """The bricks of a coreset, looked up by their place.

    Regions are in vertices of the feature bounding box. Vertices in no brick are 0 or False.
    """

    def __init__(self, coreset: Coreset) -> None:
        self._coreset = coreset
        key, z, y, x = coreset.bricks.T.astype(np.int64)
        # The coreset has its bricks in ascending order, so that bisection finds a place.
        self._places = self._place(key, z, y, x)

    def mask(self, key: int, box: Box) -> Mask:
        """Return which vertices (z, y, x) of a region are samples at a key frame."""
        window = self._window(key, box)
        return self._region(self._in_coreset(window.numbers), window, box)

    def samples(self, key: int, box: Box) -> Floats:
        """Return the normalised values (z, y, x) of a region at a key frame."""
        return self.embeddings(self._coreset.values[None], key, box)[..., 0]

    def embeddings(self, fine: Floats, key: int, box: Box) -> Floats:
        """Return the finest embeddings (z, y, x, E) of a region at a key frame.

        Args:
            fine: embeddings of all samples (E, samples), in the order of `Coreset.values`.
            key: index of the key frame.
            box: the region.
        """
        window = self._window(key, box)
        in_coreset = self._in_coreset(window.numbers)
        places = self._coreset.places(window.numbers)
        regions = []
        for numbers in fine:
            contents = np.zeros(in_coreset.shape, np.float32)
            contents[in_coreset] = numbers[places]
            regions.append(self._region(contents, window, box))
        return np.stack(regions, axis=-1)

    def _place(self, key: Integers, z: Integers, y: Integers, x: Integers) -> Integers:
        """Return the place of bricks in the grids of all key frames, in C order."""
        grid = self._coreset.brick_grid
        return ((key * grid[0] + z) * grid[1] + y) * grid[2] + x

    def _window(self, key: int, box: Box) -> _Window:
        """Return the part of the brick grid of a key frame that a region touches."""
        z, y, x = (
            np.arange(low // n, -(-high // n))
            for (low, high), n in zip(box, self._coreset.brick_shape, strict=True)
        )
        places = self._place(np.array(key), z[:, None, None], y[:, None], x)
        numbers = np.searchsorted(self._places, places)
        stored = np.zeros(places.shape, bool)
        inside = numbers < len(self._places)
        stored[inside] = self._places[numbers[inside]] == places[inside]
        return _Window((int(z[0]), int(y[0]), int(x[0])), stored, numbers[stored])

    def _in_coreset(self, numbers: npt.NDArray[np.intp]) -> Mask:
        """Return which vertices (bricks, vertices of a brick) of some bricks are samples."""
        bits = np.unpackbits(
            self._coreset.mask_bits[numbers], axis=1, count=prod(self._coreset.brick_shape)
        )
        return bits.view(np.bool_)

    def _region(
        self, contents: npt.NDArray[Scalar], window: _Window, box: Box
    ) -> npt.NDArray[Scalar]:
        """Return a region out of the contents (bricks, vertices of a brick) of a window."""
        shape = self._coreset.brick_shape
        blocks = np.zeros((*window.stored.shape, *shape), contents.dtype)
        blocks[window.stored] = contents.reshape(-1, *shape)
        joined = blocks.transpose(0, 3, 1, 4, 2, 5).reshape(
            [count * n for count, n in zip(window.stored.shape, shape, strict=True)]
        )
        return joined[
            tuple(
                slice(low - first * n, high - first * n)
                for (low, high), first, n in zip(box, window.first, shape, strict=True)
            )
        ]
