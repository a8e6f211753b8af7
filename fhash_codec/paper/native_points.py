"""Points evaluated by the native library: `fhash_codec/native/network/points.hpp`.

Every point has the same bits whatever points are given with it. They may differ between machines,
since each uses the widest vectors that it has, and rounds with fused multiply-adds where it can.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from fhash_codec.native.network import best_path
from fhash_codec.paper.network import Floats
from fhash_codec.paper.point_tables import Patch, PointTables, SparsePatch

__all__ = ["NativePoints"]


class NativePoints:
    """Tables and layers in memory as the native functions read them.

    Objects may be used by several threads at once.
    """

    def __init__(self, library: ctypes.CDLL, tables: PointTables, path: int | None = None) -> None:
        """Take over tables.

        Args:
            library: the native library of the network.
            tables: parts of the tables around the points to come.
            path: the path of the machine; None for the best.
        """
        network = tables.network
        self._library, self._path = library, best_path(library) if path is None else path
        patches = [_float32(patch) for patch in tables.patches]
        self._tables = replace(tables, patches=tuple(patches))
        self._matrices = network.matrices
        self._sizes = np.array(
            [
                *tables.sizes,
                len(tables.levels),
                len(self._matrices),
                network.embedding_size,
                not tables.still,
            ],
            np.int64,
        )
        self._levels = np.array(
            [_facts(patch, level) for patch, level in zip(patches, tables.levels, strict=True)],
            np.int64,
        )
        self._layers = np.array(
            [
                (matrix.ctypes.data, matrix.shape[0] - 1, matrix.shape[1] - 1)
                for matrix in self._matrices
            ],
            np.int64,
        )

    def at(self, key_index: float) -> NativePoints:
        """Return the points' tables at one time, interpolated once.

        The values have the bits of those that are interpolated point by point.
        """
        if self._tables.still:
            return self
        patches = []
        for patch, facts in zip(self._tables.patches, self._levels, strict=True):
            values = np.empty((1, *patch.values.shape[1:]), np.float32)
            status = self._library.fhash_network_still(
                self._sizes.ctypes.data,
                facts.ctypes.data,
                float(key_index),
                self._path,
                values.ctypes.data,
            )
            _check(status)
            patches.append(patch.at_one_time(values))
        return NativePoints(self._library, self._tables.with_one_time(patches), self._path)

    def evaluate(
        self, columns: Sequence[npt.NDArray[np.float64]], values: Floats, slopes: Floats | None
    ) -> None:
        """Write the values, and the derivatives where they are asked for, at points.

        Args:
            columns: key index, z, y and x of the points, each (n,) or (1,) for all.
            values: float32 (n,), to be written.
            slopes: float32 (n, 4), to be written; None for none.
        """
        assert values.flags.c_contiguous
        assert self._tables.readable, "some vertices are held at several times"
        assert slopes is None or slopes.flags.c_contiguous
        places = np.array(
            [
                (column.ctypes.data, 0 if len(column) == 1 else column.strides[0] // 8)
                for column in columns
            ],
            np.int64,
        )
        status = self._library.fhash_network_points(
            self._sizes.ctypes.data,
            self._levels.ctypes.data,
            self._layers.ctypes.data,
            places.ctypes.data,
            len(values),
            self._path,
            values.ctypes.data,
            None if slopes is None else slopes.ctypes.data,
        )
        _check(status)


def _float32(patch: Patch) -> Patch:
    """Return a part in float32 with two vertices along x at least: corners are read in pairs."""
    values = np.ascontiguousarray(patch.values, np.float32)
    if isinstance(patch, SparsePatch):
        return replace(patch, values=values)
    return replace(patch, values=values if values.shape[3] > 1 else np.repeat(values, 2, axis=3))


def _facts(patch: Patch, resolution: Sequence[int]) -> list[int]:
    """Return what the native functions need to know of a part."""
    still = len(patch.values) == 1
    held = [0, 0, 0, 0]
    if isinstance(patch, SparsePatch) and still:
        bits, strides = patch.bits, patch.strides
        arrays = (bits.words, bits.blocks, bits.within)
        held = [*(array.ctypes.data for array in arrays), bits.count]
    else:
        strides = tuple(stride // 4 for stride in patch.values.strides[:4])
    facts = [patch.values.ctypes.data, patch.values.size]
    for vertices, first, stride in zip(resolution, patch.first, strides, strict=True):
        # An axis of one vertex has no corner after it: both corners are the same.
        facts += [vertices, first, stride if vertices > 1 else 0]
    return [*facts, *held]


def _check(status: int) -> None:
    if status < 0:
        raise MemoryError("not enough memory to evaluate points")
