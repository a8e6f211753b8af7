"""The task of the native engine: the C++ structures of a model in training, and their tables.

The structures mirror those of fhash_codec/native/network/bricks.hpp field by field. A structure
holds addresses alone: whoever fills it keeps the arrays.
"""

from __future__ import annotations

import ctypes
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.engines.upsampling import axis_matrices

GROUP = 16
"""Vertices along x that are interpolated together; FHASH_GROUP in bricks.hpp."""
REACH = 32
"""Corners that they need at most, rounded up to whole vectors; FHASH_REACH in bricks.hpp."""
BLOCK = 32
"""Numbers of the largest coarse table that Adam moves together; FHASH_BLOCK in bricks.hpp."""
WIDEST = 128
"""Neurons of a hidden layer at most; FHASH_WIDEST in bricks.hpp."""
MOST_HIDDEN = 2
"""Hidden layers at most."""
CATCH_UP, TRAIN, ADAM, INFER = range(4)
"""Parts of a step, and an evaluation, as train_bricks.cpp numbers them."""

_POINTER = ctypes.c_void_p
_INTEGER = ctypes.c_int64
_REAL = ctypes.c_double


class Level(ctypes.Structure):
    """`FhashLevel`: where a brick's sub-lattice lies in a coarse table, and its weights."""

    _fields_ = (
        ("corners", _INTEGER * 4),
        ("stride", _INTEGER * 4),
        ("start", _POINTER * 4),
        ("time", _POINTER),
        ("first", _POINTER * 2),
        ("weight", _POINTER * 2),
        ("reach", _POINTER),
        ("spread", _POINTER),
        ("gathered", _POINTER),
    )


class Gaps(ctypes.Structure):
    """`FhashGaps`: the closed form of Adam's steps without a gradient."""

    _fields_ = tuple(
        (name, _POINTER)
        for name in (
            "weight",
            "inverse",
            "weight_sum",
            "inverse_sum",
            "factor",
            "epsilon",
            "mean_decay",
            "square_decay",
        )
    )


class Bricks(ctypes.Structure):
    """`FhashBricks`: a model in training on a coreset."""

    _fields_ = (
        *((name, _INTEGER) for name in ("path", "embedding", "levels", "hidden", "width")),
        ("shape", _INTEGER * 3),
        ("threads", _INTEGER),
        ("bricks", _POINTER),
        ("mask", _POINTER),
        ("mask_bytes", _INTEGER),
        ("values", _POINTER),
        ("offsets", _POINTER),
        ("samples", _INTEGER),
        ("fine", _POINTER),
        ("fine_mean", _POINTER),
        ("fine_square", _POINTER),
        ("visited", _POINTER),
        ("flat", _POINTER),
        ("flat_mean", _POINTER),
        ("flat_square", _POINTER),
        ("coarse", _INTEGER),
        ("numbers", _INTEGER),
        ("lazy", _INTEGER),
        ("blocks", _POINTER),
        ("rank", _POINTER),
        ("level", ctypes.POINTER(Level)),
        ("current", _POINTER),
        ("gaps", Gaps),
        ("step", _INTEGER),
        ("rate", _REAL),
        ("scale", _REAL),
        ("chosen", _POINTER),
        ("count", _INTEGER),
        ("stamps", _POINTER),
        ("touched", _POINTER),
        ("touches", _INTEGER),
        ("gradient", _POINTER),
        ("work", _POINTER),
        ("work_size", _INTEGER),
        ("error", _POINTER),
        ("out", _POINTER),
        ("places", _POINTER),
    )


class LevelTables:
    """The tables of the coarse levels, and the structures that point to them.

    Attributes:
        levels: one structure a level, an array of ctypes.
        arrays: everything that the structures point to.
    """

    def __init__(self, architecture: Architecture, coreset: Coreset) -> None:
        """Make the tables for every coordinate of a brick, axis by axis."""
        self.arrays: list[npt.NDArray[Any]] = []
        coarse = architecture.levels[1:]
        self.levels = (Level * max(len(coarse), 1))()
        numbers = 0
        for level, resolution in zip(self.levels, coarse, strict=False):
            self._fill(level, architecture, coreset, resolution, numbers)
            numbers += prod(resolution) * architecture.embedding_size

    def _fill(
        self,
        level: Level,
        architecture: Architecture,
        coreset: Coreset,
        resolution: tuple[int, ...],
        numbers: int,
    ) -> None:
        """Fill the structure of a level, whose table begins behind some numbers."""
        lengths, counts = (1, *coreset.brick_shape), (architecture.key_frames, *coreset.brick_grid)
        stride = [prod(resolution[axis + 1 :]) * architecture.embedding_size for axis in range(4)]
        weights = []
        for axis, along in enumerate(
            zip(architecture.sizes, resolution, lengths, counts, strict=True)
        ):
            start, weight = axis_matrices(*along)
            weights.append(weight)
            level.corners[axis], level.stride[axis] = weight.shape[2], stride[axis]
            level.start[axis] = self._address(start * stride[axis] + (numbers if axis == 0 else 0))
        of_time = np.zeros((counts[0], 2), np.float32)
        of_time[:, : weights[0].shape[2]] = weights[0][:, 0]
        level.time = self._address(of_time)
        for number, weight in enumerate(weights[1:3]):
            first, two = two_corners(weight)
            level.first[number] = self._address(first)
            level.weight[number] = self._address(two)
        reach, spread = groups_of_corners(weights[3])
        level.reach = self._address(reach)
        level.spread = self._address(spread)
        level.gathered = self._address(np.ascontiguousarray(spread.swapaxes(2, 3)))

    def _address(self, array: npt.NDArray[Any]) -> int:
        """Keep an array and return its address."""
        self.arrays.append(array)
        return array.ctypes.data


def two_corners(
    weights: npt.NDArray[np.float64],
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
    """Return the two corners between which each vertex lies.

    Args:
        weights: weights (coordinates, vertices, corners), not 0 at two neighbours at most.

    Returns:
        The first of the two (coordinates, vertices), and the weights of both (coordinates,
        vertices, 2).
    """
    first = (weights != 0).argmax(axis=2)
    padded = np.concatenate([weights, np.zeros((*weights.shape[:2], 1))], axis=2)
    places = first[..., None] + np.arange(2)
    return first.astype(np.int32), np.take_along_axis(padded, places, axis=2).astype(np.float32)


def groups_of_corners(
    weights: npt.NDArray[np.float64],
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
    """Return the weights of every GROUP vertices that follow each other, by the corners they need.

    Args:
        weights: weights (coordinates, vertices, corners), not 0 at two neighbours at most.

    Returns:
        The first corner and the number of corners of each group (coordinates, groups, 2), and the
        weights (coordinates, groups, REACH, GROUP), 0 where there is no corner or vertex.
    """
    coordinates, vertices, corners = weights.shape
    groups = -(-vertices // GROUP)
    reach = np.zeros((coordinates, groups, 2), np.int32)
    spread = np.zeros((coordinates, groups, REACH, GROUP), np.float32)
    for group in range(groups):
        part = weights[:, group * GROUP : (group + 1) * GROUP]
        needed = (part != 0).any(axis=1)
        first = needed.argmax(axis=1)
        count = corners - needed[:, ::-1].argmax(axis=1) - first
        reach[:, group, 0], reach[:, group, 1] = first, count
        for corner in range(int(count.max())):
            rows = np.flatnonzero(corner < count)
            spread[rows, group, corner, : part.shape[1]] = part[rows, :, first[rows] + corner]
    return reach, spread
