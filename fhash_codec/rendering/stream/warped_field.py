"""A field of a series with uneven axes, read at the places of the even grid that is drawn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fhash_codec.rendering.camera.axes import Warp
from fhash_codec.rendering.stream.fields import Field
from fhash_codec.rendering.task.arrays import Array
from fhash_codec.rendering.task.bricks import SIDE, Bricks
from fhash_codec.rendering.task.palette import Palette

__all__ = ["WarpedField"]


class WarpedField:
    """A field in drawn vertices, of a field in vertices of the series.

    Between two drawn vertices places run linearly. Bricks and cells take in all that they touch.
    """

    def __init__(self, field: Field, warp: Warp) -> None:
        """Stand between a marcher and a field."""
        self._field, self.arrays = field, field.arrays
        arrays = field.arrays
        counts = [
            own if places is None else len(places)
            for own, places in zip(warp.counts, warp.places, strict=True)
        ]
        self._places = [
            np.arange(count, dtype=np.float64) if places is None else places
            for count, places in zip(counts, warp.places, strict=True)
        ]
        self._tables = [None if places is None else arrays.array(places) for places in warp.places]
        ends, inner = (arrays.host(box) for box in (field.bounds, field.vertices))
        self.bounds = arrays.array(np.stack([self._drawn(end) for end in ends.T], axis=-1))
        self.vertices = arrays.array(np.stack([self._drawn(end) for end in inner.T], axis=-1))
        self._origin = np.floor(arrays.host(self.vertices)[:, 0]).astype(np.int64)
        self._last = np.ceil(arrays.host(self.vertices)[:, 1]).astype(np.int64)
        self.first = arrays.array(self._origin.astype(np.float64))
        self.bricks = self._drawn_bricks()

    def _drawn(self, places: Array) -> Array:
        """Places (3,) of the series in drawn vertices, beyond the ends as far beyond."""
        drawn = []
        for at, own, table in zip(places, self._places, self._tables, strict=True):
            drawn.append(
                float(at) if table is None else float(np.interp(at, own, np.arange(len(own))))
            )
        return np.array(drawn)

    def _drawn_bricks(self) -> Bricks:
        """Bricks of drawn cells with the extreme values of all bricks that they touch."""
        bricks = self._field.bricks
        first = self.arrays.host(self._field.first)
        low, high = bricks.low, bricks.high
        for axis, number in ((0, 2), (1, 1), (2, 0)):
            begin, end = self._touched(number, SIDE, low.shape[axis], float(first[number]))
            low = _extremes(low, begin, end, axis, np.minimum)
            high = _extremes(high, begin, end, axis, np.maximum)
        return replace(bricks, low=low, high=high)

    def _touched(
        self, number: int, side: int, blocks: int, first: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """First and last block of the series that each block of drawn cells touches.

        number: axis, 0 for x. side: cells of a block. blocks: of the series. first: where they
        begin.
        """
        origin, last = int(self._origin[number]), int(self._last[number])
        starts = np.arange(origin, max(last, origin + 1), side)
        stops = np.minimum(starts + side, last)
        own = self._places[number]
        ends = [own[np.clip(at, 0, len(own) - 1)] - first for at in (starts, stops)]
        begin = np.floor(ends[0] / side - 1e-9)
        end = np.floor(ends[1] / side + 1e-9)
        return (
            np.clip(begin, 0, blocks - 1).astype(np.int64),
            np.clip(end, 0, blocks - 1).astype(np.int64),
        )

    def visible(self, palette: Palette) -> Array:
        """Drawn cells (z, y, x) that touch a visible cell of the series."""
        seen = self.arrays.host(self._field.visible(palette))
        first = self.arrays.host(self._field.first)
        for axis, number in ((0, 2), (1, 1), (2, 0)):
            begin, end = self._touched(number, 1, seen.shape[axis], float(first[number]))
            seen = _extremes(seen, begin, end, axis, np.logical_or)
        return self.arrays.array(seen)

    def values(self, places: Array, wanted: Array | None = None) -> Array:
        """Values (n,) at places (n, 3) in drawn vertices, NaN where there is none."""
        return self._field.values(self._moved(places)[0], wanted)

    def slopes(self, places: Array) -> Array:
        """Derivatives (n, 3) by x, y and z per drawn vertex, 0 where there are none."""
        moved, rates = self._moved(places)
        return self._field.slopes(moved) * rates

    def _moved(self, places: Array) -> tuple[Array, Array]:
        """Places (n, 3) in vertices of the series, and vertices of it per drawn vertex (n, 3)."""
        arrays, xp = self.arrays, self.arrays.xp
        moved, rates = arrays.copy(places), arrays.full(places.shape, 1.0)
        for axis, table in enumerate(self._tables):
            if table is None:
                continue
            at = xp.clip(places[:, axis], 0.0, float(len(table) - 1))
            before = arrays.to_int64(xp.clip(xp.floor(at), 0.0, float(max(len(table) - 2, 0))))
            low = xp.take(table, before)
            rate = xp.take(table, before + 1) - low
            moved[:, axis] = low + (at - arrays.to_float64(before)) * rate
            rates[:, axis] = rate
        return moved, rates


def _extremes(
    values: np.ndarray, begin: np.ndarray, end: np.ndarray, axis: int, reduce: np.ufunc
) -> np.ndarray:
    """Reduce the spans `begin` to `end`, both included, of an axis."""
    moved = np.moveaxis(values, axis, 0)
    parts = [
        reduce.reduce(moved[low : high + 1], axis=0) for low, high in zip(begin, end, strict=True)
    ]
    return np.ascontiguousarray(np.moveaxis(np.stack(parts), 0, axis))
