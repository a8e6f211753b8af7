"""The model of a compact file: values at vertices in a table, linear between them. numpy only."""

from __future__ import annotations

from functools import cached_property
from itertools import product
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.parts import CompactTable, head_mlp, level_count, read_coarse
from fhash_codec.compact.plain import PlainArray
from fhash_codec.coreset.boxes import Box
from fhash_codec.coreset.occupancy import read_occupancy
from fhash_codec.model_parts import Mlp, Table
from fhash_formats.container import Container
from fhash_formats.container.header import PLAIN_FEATURE
from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.transform.values.elementwise import cast

Positions = npt.NDArray[np.float64]
"""Coordinates of some points along one axis."""


class CompactModel:
    """A `VolumeModel` (volume_model.py) of a compact file.

    Its table holds values (t, z, y, x) at the vertices of the feature bounding box.
    """

    def __init__(self, container: Container) -> None:
        self._container = container
        self._arrays = container.arrays
        self._table = self._arrays["tables/level_1"]
        self._plain: PlainArray | None = None
        if PLAIN_FEATURE in container.header["required_features"]:
            self._plain = PlainArray(container.header["model"], self._arrays)
        self._array = self._plain or self._table
        self.chunks = self._array.chunk_shape

    @cached_property
    def tables(self) -> list[Table]:
        """The tables, finest first."""
        if self._plain is not None:
            levels = range(1, self._plain.levels + 1)
            stored = {n: self._arrays[f"tables/level_{n}"] for n in levels}
            return [Table(n, array, array.dtype) for n, array in stored.items()]
        count = level_count(self._table.shape[1:])
        sources = [CompactTable(self._table, halvings) for halvings in range(count)]
        return [Table(n, source, source.dtype) for n, source in enumerate(sources, start=1)]

    @cached_property
    def mlp(self) -> Mlp:
        """The head as an MLP."""
        if self._plain is not None:
            return head_mlp(self._plain.head)
        settings = self._table.settings
        return head_mlp(None if settings is None else settings.head)

    def occupied(self, first: int, last: int, region: Box) -> npt.NDArray[np.bool_]:
        """Return which vertices (z, y, x) of a region are in the coreset at both of two steps."""
        # Between steps both count: a value is no better than the two it lies between.
        return np.asarray(self._occupied_at(first, last + 1, region).all(axis=0))

    def _occupied_at(self, first: int, end: int, region: Box) -> npt.NDArray[np.bool_]:
        """Return which vertices (t, z, y, x) of a region are in the coreset at each step."""
        steps, space = slice(first, end), region.slices()
        if self._plain is None:
            return self._table.read_mask((steps, *space))
        return read_occupancy(self._container, first, end)[:, *space]

    def read(self, step: float, region: Box, requested: npt.NDArray[np.bool_]) -> npt.NDArray[Any]:
        """Return the values (z, y, x) of a region of the box at a step.

        At a stored step they have the type of the source; between steps they are interpolated
        linearly, in float64. Raises DamagedFileError for infinities, which no table holds.
        """
        first = int(np.floor(step))
        weight = step - first
        space = tuple(slice(low, high) for low, high in region)
        stored = self._array.read((slice(first, first + (2 if weight else 1)), *space))
        steps = self._without_infinities(stored)
        values: npt.NDArray[Any] = steps[0]
        if weight:
            values = values.astype(np.float64) * (1 - weight) + steps[1].astype(np.float64) * weight
        return values

    def read_steps(
        self, first: int, end: int, region: Box
    ) -> tuple[npt.NDArray[Any], npt.NDArray[np.bool_]]:
        """Return the values (t, z, y, x) of a region at neighbouring steps, and its coreset.

        They have the type of the source. Raises what `read` raises.
        """
        values = self._array.read((slice(first, end), *region.slices()))
        return self._without_infinities(values), self._occupied_at(first, end, region)

    def read_lod(self, step: int, lod: int, region: Box) -> npt.NDArray[Any]:
        """Return every 2^lod-th vertex (z, y, x) of a region of the box at a step.

        Each tile is low-passed on its own.

        region: counted in coarse vertices.
        """
        if self._plain is not None:
            return self._read_plain_lod(step, lod, region)
        array = self._table
        values = read_coarse(array, step, lod, region, array.decode_chunk, array.dtype)
        lost = np.isnan(values) if lod and values.dtype.kind == "f" else np.zeros(0, np.bool_)
        if lost.any():
            # A tile of labels that begins between coarse vertices gives a vertex beside each of
            # them, which may be outside of the coreset where the vertex itself is not.
            spans = [slice(low << lod, ((high - 1) << lod) + 1) for low, high in region]
            own = array.read((slice(step, step + 1), *spans))[0][(slice(None, None, 1 << lod),) * 3]
            np.copyto(values, own, where=lost)
        return self._without_infinities(values)

    def _read_plain_lod(self, step: int, lod: int, region: Box) -> npt.NDArray[Any]:
        """The table of a level, in the type of the values; level 0 is the values themselves."""
        if lod == 0:
            frames = self._array.read((slice(step, step + 1), *region.slices()))
            return np.asarray(frames[0])
        if lod >= len(self.tables):
            raise InputError(f"level of detail {lod}; a plain file has 0 to {len(self.tables) - 1}")
        return cast(self.tables[lod][step, *region.slices(), 0], self._array.dtype)

    def sample(self, steps: Positions, space: list[Positions]) -> npt.NDArray[np.float64]:
        """Return the values at points, quadrilinear.

        steps, space: steps and (z, y, x) of the points, in vertices of the box, all inside.
        """
        return self._interpolated(steps, space)[0]

    def sample_with_gradient(
        self, steps: Positions, space: list[Positions]
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Return the values at points, and their derivatives (points, 4) by step, z, y and x.

        On the border of two cells the derivatives are those of the cell after it.
        """
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
        """Return the values at points, and what they are interpolated from.

        That is the 16 corners (2, 2, 2, 2, points) around each point, and the weights of the
        upper corners along each axis.
        """
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
        space_slices = tuple(slice(*span) for span in box)
        for step in np.unique(np.concatenate([low[0], high[0]])):
            stored = self._array.read((slice(int(step), int(step) + 1), *space_slices))[0]
            frame = self._without_infinities(stored)
            for corner in product((0, 1), repeat=4):
                at = [(high if up else low)[axis] for axis, up in enumerate(corner)]
                chosen = at[0] == step
                if chosen.any():
                    where = tuple(at[axis + 1][chosen] - box[axis][0] for axis in range(3))
                    corners[(*corner, chosen)] = frame[where]
        values = np.zeros(steps.size)
        for corner in product((0, 1), repeat=4):
            factors = [weights[axis] if up else 1 - weights[axis] for axis, up in enumerate(corner)]
            # A corner without weight counts for nothing, also where it is not finite.
            weight = np.asarray(prod(factors))
            values += np.where(weight == 0, 0.0, weight * corners[corner])
        return values, corners, weights

    def _without_infinities(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return values of the table, which are finite or NaN; raise DamagedFileError otherwise."""
        if values.dtype.kind == "f" and np.isinf(values).any():
            raise DamagedFileError("the table holds infinities; the file is damaged")
        return values
