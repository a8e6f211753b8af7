"""The compact profile's model: lattice values in a table, linear between vertices and between steps. numpy only."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.boxes import Box
from fhash_codec.coreset.occupancy import unpack
from fhash_formats.container import StoredArray

Positions = npt.NDArray[np.float64]


class CompactModel:
    """A `VolumeModel` (volume_model.py) of a compact file: values (t, z, y, x) at the vertices of the feature bounding box."""

    def __init__(self, arrays: Mapping[str, StoredArray]) -> None:
        self._arrays = arrays
        self._array = arrays["tables/level_1"]
        self.chunks = self._array.chunk_shape

    def occupied(self, first: int, last: int, region: Box) -> npt.NDArray[np.bool_]:
        """Which vertices (z, y, x) of a region of the box are in the coreset at step `first` and at step `last`."""
        # Between steps both count: a value is no better than the two it lies between.
        space = tuple(slice(low, high) for low, high in region)
        if "occupancy/mask" in self._arrays:
            mask = self._arrays["occupancy/mask"].read((slice(first, last + 1), *space))
            return np.asarray((mask[0] & mask[-1]) != 0)
        if "occupancy/bits" not in self._arrays:
            mask = self._array.read_mask((slice(first, last + 1), *space))
            return np.asarray(mask[0] & mask[-1])
        stored = self._arrays["occupancy/bits"]
        bits = stored.read((slice(first, last + 1), slice(0, stored.shape[1])))
        z, y, x = self._array.shape[1:]
        return unpack(bits[0] & bits[-1], (z, y, x))[space]

    def region(self, step: float, region: Box, wanted: npt.NDArray[np.bool_]) -> npt.NDArray[Any]:
        """Values (z, y, x) of a region of the box at a step, as they are stored; between steps, linear in the step, float64."""
        first = int(np.floor(step))
        weight = step - first
        space = tuple(slice(low, high) for low, high in region)
        steps = self._array.read((slice(first, first + (2 if weight else 1)), *space))
        values: npt.NDArray[Any] = steps[0]
        if weight:
            values = values.astype(np.float64) * (1 - weight) + steps[1].astype(np.float64) * weight
        return values

    def coarse(self, step: int, lod: int, region: Box) -> npt.NDArray[Any]:
        """Every 2^lod-th vertex (z, y, x) of the box at a step, low-passed by each tile on its own; a region of them in coarse vertices."""
        tile, stride = self._array.chunk_shape, 1 << lod
        result = np.empty([high - low for low, high in region], dtype=self._array.dtype)
        grid = [
            range(low * stride // n, (high - 1) * stride // n + 1)
            for (low, high), n in zip(region, tile[1:], strict=True)
        ]
        for index in product(*grid):
            # A tile that begins between two coarse vertices gives its own lattice; the nearest of its vertices stand for those.
            ends = [
                (max(-(-i * n // stride), a), min(-(-(i + 1) * n // stride), b))
                for i, n, (a, b) in zip(index, tile[1:], region, strict=True)
            ]
            if any(first >= stop for first, stop in ends):
                continue
            part = self._array.decode_chunk((step // tile[0], *index), lod)[step % tile[0]]
            target, source = [], []
            for i, n, (first, stop), (low, _), size in zip(
                index, tile[1:], ends, region, part.shape, strict=True
            ):
                target.append(slice(first - low, stop - low))
                source.append(
                    np.minimum(
                        (np.arange(first, stop) * stride - i * n + stride // 2) // stride, size - 1
                    )
                )
            result[tuple(target)] = part[np.ix_(*source)]
        return result

    def points(self, steps: Positions, space: list[Positions]) -> npt.NDArray[np.float64]:
        """Values at points, quadrilinear: steps and (z, y, x) in vertices of the box, all inside."""
        return self._interpolated(steps, space)[0]

    def slopes(
        self, steps: Positions, space: list[Positions]
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Values, and derivatives (points, 4) by step, z, y and x; on the border of two cells those of the cell after it."""
        values, corners, weights = self._interpolated(steps, space)
        slopes = np.empty((values.size, 4))
        for axis in range(4):
            others = [a for a in range(4) if a != axis]
            factor = np.ones((2, 2, 2, 2, values.size))
            for other in others:
                shape = [1, 1, 1, 1, values.size]
                shape[other] = 2
                factor = factor * np.stack([1 - weights[other], weights[other]]).reshape(shape)
            # A corner without weight counts for nothing, also where it is not finite.
            weighted = np.where(factor == 0, 0.0, factor * corners)
            low, high = (
                np.take(weighted, side, axis=axis).reshape(-1, values.size).sum(axis=0)
                for side in (0, 1)
            )
            slopes[:, axis] = high - low
        return values, slopes

    def _interpolated(
        self, steps: Positions, space: list[Positions]
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], list[Positions]]:
        """Values, the 16 corners (2, 2, 2, 2, points) around each point, and the weights of the upper corner along each axis."""
        shape = self._array.shape
        low = [
            np.clip(np.floor(p).astype(np.int64), 0, max(n - 2, 0))
            for p, n in zip([steps, *space], shape, strict=True)
        ]
        weights = [p - i for p, i in zip([steps, *space], low, strict=True)]
        high = [np.minimum(i + 1, n - 1) for i, n in zip(low, shape, strict=True)]
        corners = np.empty((2, 2, 2, 2, steps.size))
        box = tuple(
            (int(i.min()), int(h.max()) + 1) for i, h in zip(low[1:], high[1:], strict=True)
        )
        space_slices = tuple(slice(*part) for part in box)
        for step in np.unique(np.concatenate([low[0], high[0]])):
            frame = self._array.read((slice(int(step), int(step) + 1), *space_slices))[0]
            for corner in product((0, 1), repeat=4):
                at = [(high if up else low)[axis] for axis, up in enumerate(corner)]
                chosen = at[0] == step
                if chosen.any():
                    where = tuple(at[axis + 1][chosen] - box[axis][0] for axis in range(3))
                    corners[(*corner, chosen)] = frame[where]
        values = np.zeros(steps.size)
        for corner in product((0, 1), repeat=4):
            parts = [weights[axis] if up else 1 - weights[axis] for axis, up in enumerate(corner)]
            # A corner without weight counts for nothing, also where it is not finite.
            weight = np.asarray(prod(parts))
            values += np.where(weight == 0, 0.0, weight * corners[corner])
        return values, corners, weights
