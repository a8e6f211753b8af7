"""Vertices of a level that some vertex of the coreset depends on, from the occupancy alone.

A value at a vertex of the box depends on the corners of the cell around it in every level. So a
vertex of a level is needed where one of these corners, with a weight above 0, belongs to a vertex
of the coreset. Integers decide that, so that encoder and reader find the same vertices on every
machine, and a file need not store them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset import occupancy
from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.architecture import Architecture, Resolution

Mask = npt.NDArray[np.bool_]
Integers = npt.NDArray[np.int64]


class Needed:
    """The needed vertices of all levels.

    With `fringe`, the samples at a key frame are the vertices of its coreset and of its neighbours'
    (`Extent.with_fringe`), otherwise those of its coreset.
    """

    def __init__(
        self,
        levels: Sequence[Resolution],
        grids: Callable[[int], occupancy.Bits],
        *,
        fringe: bool,
    ) -> None:
        """Take the occupancy of the box.

        Args:
            levels: vertices (t, z, y, x) of each level, finest first.
            grids: key frame -> its packed occupancy (`occupancy.pack`).
            fringe: whether samples are also those of the neighbouring key frames.
        """
        self._levels, self._grids, self._fringe = levels, grids, fringe
        self._keys, *box = levels[0]
        self._box: occupancy.Shape = (box[0], box[1], box[2])

    def mask(self, level: int, node: int) -> Mask:
        """Return which vertices (z, y, x) of a level are needed at a time node.

        Args:
            level: index of the level, 0 for the finest.
            node: index of the time node.
        """
        nodes, *resolution = self._levels[level]
        keys = self._dependent_keys(nodes, node)
        merged = np.zeros(occupancy.packed_bytes(self._box), np.uint8)
        for key in keys:
            merged = occupancy.between(merged, self._grids(key))
        mask = occupancy.unpack(merged, self._box)
        for axis, length in enumerate(resolution):
            mask = spread(mask, axis, length)
        return mask

    def counts(self, level: int) -> list[int]:
        """Return the number of needed vertices of a level at each of its time nodes."""
        nodes = range(self._levels[level][0])
        return [int(np.count_nonzero(self.mask(level, node))) for node in nodes]

    def _dependent_keys(self, nodes: int, node: int) -> list[int]:
        """Return the key frames whose occupancy decides what is needed at a time node.

        Args:
            nodes: time nodes of the level.
            node: index of the time node.
        """
        first, last = corners(self._keys, nodes)
        keys = (first == node) | (last == node)
        if self._fringe:
            before, after = keys[:-1].copy(), keys[1:].copy()
            keys[1:] |= before
            keys[:-1] |= after
        return [int(key) for key in np.flatnonzero(keys)]


def needed_by(architecture: Architecture, coreset: Coreset) -> Needed:
    """Return the vertices that the samples of a coreset need, those of its fringe included."""
    return Needed(
        architecture.levels, coreset.occupancy.__getitem__, fringe=coreset.fringe is not None
    )


def corners(length: int, resolution: int) -> tuple[Integers, Integers]:
    """Return the vertices of a level before and after each vertex of the box, along one axis.

    They are the same where a vertex of the box lies on a vertex of the level.

    Args:
        length: vertices of the box along the axis.
        resolution: vertices of the level along the axis.
    """
    before, rest = np.divmod(np.arange(length) * (resolution - 1), max(length - 1, 1))
    return before, before + (rest > 0)


def spread(mask: Mask, axis: int, resolution: int) -> Mask:
    """Return which vertices of a level surround some vertex of a mask, along one axis.

    Args:
        mask: vertices of the box along that axis.
        axis: the axis.
        resolution: vertices of the level along it.
    """
    if mask.shape[axis] == resolution:
        return mask
    layers = np.moveaxis(mask, axis, 0)
    result = np.zeros((resolution, *layers.shape[1:]), bool)
    for layer, first, last in zip(layers, *corners(len(layers), resolution), strict=True):
        result[first] |= layer
        result[last] |= layer
    return np.moveaxis(result, 0, axis)
