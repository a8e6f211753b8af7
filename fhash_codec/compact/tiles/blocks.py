"""A series cut into tiles: what each holds, and what of it counts."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from math import prod
from threading import Lock
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.extent import Extent
from fhash_formats.series import Series
from fhash_formats.transform.tile.sections import Shape

Values = npt.NDArray[Any]
Care = npt.NDArray[np.bool_] | None
Index = tuple[int, int, int, int]

HELD_BYTES = 1 << 30
"""A box of at most this size is kept in memory, of a larger one a layer of tiles at a time."""


class _Whole:
    """Values and mask of the whole box once they were read, shared by all its tilings."""

    def __init__(self) -> None:
        self.lock = Lock()
        self.content: tuple[Values, Care] | None = None


class Blocks:
    """The feature bounding box over all steps as a grid of tiles (t, z, y, x).

    Attributes:
        shape: vertices of the box over all steps. tile: vertices of a tile; the last of an axis may reach beyond the box.
        grid: tiles along each axis. dtype: of the series. complete: whether all of the box counts.
    """

    def __init__(self, series: Series, extent: Extent, tile: Shape) -> None:
        self._series, self._extent = series, extent
        self.dtype: np.dtype[Any] = series.dtype.newbyteorder("=")
        self.shape: Shape = (series.shape[0], *extent.box.shape)
        self.tile: Shape = tuple(min(n, length) for n, length in zip(tile, self.shape, strict=True))  # type: ignore[assignment]
        self.grid: Index = tuple(
            -(-length // n) for length, n in zip(self.shape, self.tile, strict=True)
        )  # type: ignore[assignment]
        self.complete = extent.samples == prod(self.shape)
        self._held: tuple[int, Values, Care] | None = None
        self._whole = _Whole()

    def retile(self, tile: Shape) -> Blocks:
        """The same series in other tiles; what is in memory is shared."""
        other = Blocks(self._series, self._extent, tile)
        other._whole = self._whole
        return other

    @property
    def held(self) -> bool:
        """Whether the whole box is kept in memory."""
        return prod(self.shape) * self.dtype.itemsize <= HELD_BYTES

    def indices(self) -> Iterator[Index]:
        """All tiles in C order."""
        yield from product(*(range(n) for n in self.grid))

    def read(self, index: Index) -> tuple[Values, Care]:
        """A tile's values in the type of the source, its rest beyond the box repeating the border, and what counts (None: everything).

        Any thread where the whole is held, else one at a time and in C order, since the layer of one t is kept.
        """
        values, care = self._layer(index[0])
        spans = [
            slice(i * n, min((i + 1) * n, length))
            for i, n, length in zip(index[1:], self.tile[1:], self.shape[1:], strict=True)
        ]
        part = values[:, spans[0], spans[1], spans[2]]
        kept = None if care is None else care[:, spans[0], spans[1], spans[2]]
        beyond = [(0, n - m) for n, m in zip(self.tile, part.shape, strict=True)]
        if not any(after for _, after in beyond):
            return np.ascontiguousarray(
                part
            ), None if kept is None or kept.all() else np.ascontiguousarray(kept)
        inside = np.ones(part.shape, bool) if kept is None else kept
        return np.pad(part, beyond, mode="edge"), np.pad(inside, beyond)

    def _layer(self, t: int) -> tuple[Values, Care]:
        """Values and mask of one layer of tiles, (up to tile t, z, y, x of the box)."""
        steps = range(t * self.tile[0], min((t + 1) * self.tile[0], self.shape[0]))
        if self.held:
            with self._whole.lock:
                if self._whole.content is None:
                    self._whole.content = self._load(range(self.shape[0]))
            values, care = self._whole.content
            return values[steps[0] : steps[-1] + 1], None if care is None else care[
                steps[0] : steps[-1] + 1
            ]
        if self._held is None or self._held[0] != t:
            self._held = None
            self._held = (t, *self._load(steps))
        return self._held[1], self._held[2]

    def _load(self, steps: range) -> tuple[Values, Care]:
        values = np.empty((len(steps), *self.shape[1:]), dtype=self.dtype)
        for number, step in enumerate(steps):
            values[number] = self._series.read(step)[self._extent.box.slices()]
        return values, None if self.complete else np.stack(
            [self._extent.mask(step) for step in steps]
        )
