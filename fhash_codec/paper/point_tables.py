"""Parts of a network's tables in memory, as points are interpolated in them.

This module is the only place where points read tables.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.paper.levels import Resolution
from fhash_codec.paper.network import Floats, Network
from fhash_codec.paper.tables.ranked import RankedBits, SparseFrame, row_bits

__all__ = ["Patch", "PointTables", "SparsePatch", "locate"]


@dataclass(frozen=True)
class Patch:
    """A part of one level's table in memory.

    Attributes:
        values: embeddings (t, z, y, x, E), contiguous.
        first: vertex (t, z, y, x) of the level at which the part begins.
    """

    values: npt.NDArray[Any]
    first: tuple[int, ...]

    @property
    def strides(self) -> tuple[int, ...]:
        """Numbers of `embeddings` from one vertex to the next along t, z, y and x."""
        _, z, y, x, _ = self.values.shape
        return z * y * x, y * x, x, 1

    def embeddings(self, numbers: npt.NDArray[np.int64]) -> npt.NDArray[Any]:
        """Return the embeddings (..., E) of vertices (...) by their numbers in C order."""
        return self.values.reshape(-1, self.values.shape[4]).take(numbers, axis=0, mode="clip")

    def at_one_time(self, values: npt.NDArray[Any]) -> Patch:
        """Return the same part with other values (1, z, y, x, E), those of one time."""
        return replace(self, values=values, first=(0, *self.first[1:]))


@dataclass(frozen=True)
class SparsePatch(Patch):
    """A whole level in memory that holds some vertices only.

    Attributes:
        values: embeddings (t, 1, 1, held + 1, E) of the held vertices. The last of each time is 0.
        bits: which vertices are held at any of these times. Numbers are those of its bits.
        vertices: vertices (z, y, x) of the level.
    """

    bits: RankedBits
    vertices: tuple[int, int, int]

    @classmethod
    def of(cls, frames: Sequence[SparseFrame], node: int) -> SparsePatch:
        """Return the part of one or two neighbouring time nodes, of which `node` is the first."""
        bits = RankedBits.of_words(np.bitwise_or.reduce([frame.bits.words for frame in frames]))
        held = bits.positions()
        size = frames[0].values.shape[1]
        values = np.zeros((len(frames), 1, 1, len(held) + 1, size), frames[0].values.dtype)
        for number, frame in enumerate(frames):
            values[number, 0, 0, :-1] = frame.values[frame.bits.lookup(held)]
        return cls(values, (node, 0, 0, 0), bits, frames[0].shape)

    @property
    def strides(self) -> tuple[int, ...]:
        """Bits from one vertex to the next; the tables must be those of one time."""
        row = row_bits(self.vertices[2])
        return 0, self.vertices[1] * row, row, 1

    def embeddings(self, numbers: npt.NDArray[np.int64]) -> npt.NDArray[Any]:
        """Return the embeddings (..., E) of vertices (...) by the numbers of their bits."""
        assert len(self.values) == 1, "the places of vertices are those at one time"
        taken: npt.NDArray[Any] = self.values[0, 0, 0].take(self.bits.lookup(numbers), axis=0)
        return taken


@dataclass(frozen=True)
class PointTables:
    """The parts of all levels that surround some points.

    Attributes:
        network: the network, whose layers are used.
        sizes: key frames and vertices (t, z, y, x) that the points' positions count in.
        levels: resolution (t, z, y, x) of each level, finest first.
        patches: a part of each level's table.
    """

    network: Network
    sizes: Resolution
    levels: tuple[Resolution, ...]
    patches: tuple[Patch, ...]

    @classmethod
    def read(cls, network: Network, low: Sequence[float], high: Sequence[float]) -> PointTables:
        """Read the parts that surround all points between two positions (t, z, y, x)."""
        sizes = (network.key_frames, *network.box_size)
        span = np.array([low, high], np.float64).T
        patches = []
        for level, resolution in enumerate(network.levels):
            first, last = locate(sizes, resolution, span)[0].T.tolist()
            region = tuple(
                slice(start, min(stop + 2, length))
                for start, stop, length in zip(first, last, resolution, strict=True)
            )
            values = np.ascontiguousarray(network.read(level, region))
            patches.append(Patch(values, tuple(first)))
        return cls(network, sizes, network.levels, tuple(patches))

    @classmethod
    def of_box(cls, network: Network, key_index: float) -> PointTables:
        """Read the time nodes of the whole box around one time, for `at` this time.

        Levels that hold some vertices only stay so.
        """
        high = [size - 1 for size in network.box_size]
        if not network.sparse:
            return cls.read(network, (key_index, 0, 0, 0), (key_index, *high))
        sizes = (network.key_frames, *network.box_size)
        patches = []
        for level, resolution in enumerate(network.levels):
            point = np.array([[key_index], [0], [0], [0]], np.float64)
            node = int(locate(sizes, resolution, point)[0][0, 0])
            nodes = range(node, min(node + 2, resolution[0]))
            frames = [network.sparse_frame(level, number) for number in nodes]
            patches.append(SparsePatch.of([frame for frame in frames if frame is not None], node))
        return cls(network, sizes, network.levels, tuple(patches))

    @property
    def vertices(self) -> int:
        """Number of vertices of the finest level's part."""
        return math.prod(self.patches[0].values.shape[:4])

    @property
    def still(self) -> bool:
        """Whether the tables are those of one time."""
        return self.sizes[0] == 1

    @property
    def readable(self) -> bool:
        """Whether points can be interpolated before `at`: sparse parts know places at one time."""
        return all(
            len(patch.values) == 1 for patch in self.patches if isinstance(patch, SparsePatch)
        )

    def at(self, key_index: float) -> PointTables:
        """Return the tables at one time, interpolated once. Time 0 is then the only one."""
        if self.still:
            return self
        patches = [
            patch.at_one_time(self._at(level, key_index))
            for level, patch in enumerate(self.patches)
        ]
        return self.with_one_time(patches)

    def _at(self, level: int, key_index: float) -> npt.NDArray[Any]:
        """Return the values float32 (1, z, y, x, E) of a level at one time."""
        patch = self.patches[level]
        before, after_weight, _ = locate(
            self.sizes, self.levels[level], np.array([[key_index], [0], [0], [0]], np.float64)
        )
        node, weight = int(before[0, 0]) - patch.first[0], after_weight[0, 0]
        low = patch.values[node].astype(np.float32)
        if self.levels[level][0] > 1:
            # The same operations, in the same order, as `interpolate` does them point by point.
            low = low * (1 - weight) + patch.values[node + 1].astype(np.float32) * weight
        return np.ascontiguousarray(low[None])

    def with_one_time(self, patches: Sequence[Patch]) -> PointTables:
        """Return tables of one time with other parts, of one time node each."""
        return replace(
            self,
            sizes=(1, *self.sizes[1:]),
            levels=tuple((1, *level[1:]) for level in self.levels),
            patches=tuple(patches),
        )


def locate(
    sizes: Sequence[int], resolution: Sequence[int], points: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.int64], Floats, npt.NDArray[np.float64]]:
    """Find the cells of a level around points.

    Args:
        sizes: key frames and vertices of the box (t, z, y, x).
        resolution: vertices (t, z, y, x) of the level.
        points: positions (4, n), key index, z, y and x.

    Returns:
        The corner before each point (4, n), the weight in [0, 1] of the corner after it (4, n), and
        the corners per vertex of the box along each axis (4,).
    """
    corners = np.array(resolution)[:, None]
    span = np.array([max(size - 1, 1) for size in sizes])[:, None]
    position = points * (corners - 1) / span
    before = np.minimum(position.astype(np.int64), np.maximum(corners - 2, 0))
    return before, (position - before).astype(np.float32), ((corners - 1) / span)[:, 0]
