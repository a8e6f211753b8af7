"""A decoded frame as a field of the streamed marcher."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fhash_codec.rendering.bricks import Bricks, Palette
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.march_task import NUMPY, Array, Arrays, Frame
from fhash_codec.rendering.stream_fields import CORNERS, of_cells


class FrameField:
    """A decoded frame, trilinear between its vertices.

    A place has no value where a vertex of weight around it has none.
    """

    def __init__(self, frame: Frame, bricks: Bricks, grid: Grid, arrays: Arrays = NUMPY) -> None:
        """Copy a frame to where the arrays are. bricks: of the frame. grid: of the domain."""
        self.arrays, self.bricks, self.frame, self._grid = arrays, bricks, frame, grid
        self.stride, first = frame.stride, np.array(frame.first[::-1], dtype=np.float64)
        counts = np.array(frame.values.shape[::-1])
        self.bounds, self.first = arrays.array(frame.bounds(grid)), arrays.array(first)
        self.vertices = arrays.array(
            np.stack([first, first + (counts - 1) * frame.stride], axis=-1)
        )
        self._last = arrays.array(counts - 1.0)
        self._last_cell = arrays.array(np.maximum(counts - 2.0, 0.0))
        self._jumps = (1, int(counts[0]), int(counts[0] * counts[1]))
        self._wide = [bool(count > 1) for count in counts]
        with arrays.guarded():
            self._values = arrays.array(bricks.values)
        self._flat = self._values.reshape(-1)

    def visible(self, palette: Palette) -> Array:
        """Cells (z, y, x) with a value that has an extinction."""
        arrays, xp = self.arrays, self.arrays.xp
        layers = max(1, arrays.batch // self._jumps[2])
        visible = []
        for start in range(0, max(len(self._values) - 1, 1), layers):
            values = self._values[start : start + layers + 1]
            low, high = (
                arrays.to_float64(of_cells(values, extreme)) for extreme in (xp.fmin, xp.fmax)
            )
            visible.append(palette.visible(low, high))
        return xp.concatenate(visible)

    def values(self, places: Array, wanted: Array | None = None) -> Array:
        """Values (n,) at places (n, 3), as `Field` has them."""
        result = self.arrays.empty((len(places),))
        for start in range(0, len(places), self.arrays.batch):
            part = slice(start, start + self.arrays.batch)
            inside, low, share = self._located(places[part], self._last)
            if wanted is not None:
                inside &= wanted[part]
            # The corner after a place counts only where it has weight: a missing vertex beyond a
            # place on a vertex does not matter.
            jumps = [
                self.arrays.to_int64(share[:, axis] > 0) * jump
                for axis, jump in enumerate(self._jumps)
            ]
            corners = self._corners(low, jumps)
            along = corners[:, :, 0] + share[:, 0] * (corners[:, :, 1] - corners[:, :, 0])
            across = along[:, 0] + share[:, 1] * (along[:, 1] - along[:, 0])
            values = across[0] + share[:, 2] * (across[1] - across[0])
            result[start : start + len(values)] = self.arrays.xp.where(inside, values, np.nan)
        return result

    def slopes(self, places: Array) -> Array:
        """Derivatives as `Field` has them; between two cells those of the cell after the border."""
        xp = self.arrays.xp
        result = self.arrays.empty((len(places), 3))
        for start in range(0, len(places), self.arrays.batch):
            _, low, share = self._located(
                places[start : start + self.arrays.batch], self._last_cell
            )
            corners = self._corners(
                low,
                [jump if wide else 0 for jump, wide in zip(self._jumps, self._wide, strict=True)],
            )
            x, y, z = share.T
            by_x = corners[:, :, 1] - corners[:, :, 0]
            along = corners[:, :, 0] + x * by_x
            by_y = along[:, 1] - along[:, 0]
            across = along[:, 0] + y * by_y
            by_x = by_x[:, 0] + y * (by_x[:, 1] - by_x[:, 0])
            slopes = xp.stack(
                [
                    by_x[0] + z * (by_x[1] - by_x[0]),
                    by_y[0] + z * (by_y[1] - by_y[0]),
                    across[1] - across[0],
                ],
                axis=-1,
            )
            slopes = xp.nan_to_num(slopes, nan=0.0, posinf=0.0, neginf=0.0)
            result[start : start + len(slopes)] = slopes / self.stride
        return result

    def smoothed(self, deviation: float, error: float) -> FrameField:
        """The frame with the values that shade."""
        values = self.bricks.smoothed(deviation, error)
        frame, bricks = replace(self.frame, values=values), replace(self.bricks, values=values)
        return FrameField(frame, bricks, self._grid, self.arrays)

    def _located(self, places: Array, last_before: Array) -> tuple[Array, Array, Array]:
        """Whether places lie within the bounds, and the vertices around them.

        last_before: (3,), the last vertex (x, y, z) that may be the one before a place.
        Returns a mask (n,), the numbers (n,) of the vertices before the places, and the weights
        (n, 3) of the vertices after them.
        """
        arrays, xp, last = self.arrays, self.arrays.xp, self._last
        inside = xp.all((places >= self.bounds[:, 0]) & (places <= self.bounds[:, 1]), axis=1)
        at = xp.clip((places - self.first) / self.stride, 0 * last, last)
        before = xp.minimum(xp.floor(at), last_before)
        x, y, z = arrays.to_int64(before).T
        return inside, x + y * self._jumps[1] + z * self._jumps[2], at - before

    def _corners(self, low: Array, jumps: list[Array] | list[int]) -> Array:
        """Values (z 2, y 2, x 2, n) around places.

        low: numbers (n,) of the vertices before the places.
        jumps: steps along x, y and z to the vertices after them, (n,) or one number for all.
        """
        corners = self.arrays.empty((2, 2, 2, len(low)))
        for corner in CORNERS:
            corners[corner] = self.arrays.xp.take(self._flat, low + _jump(corner, jumps))
        return corners


def _jump(corner: tuple[int, ...], jumps: list[Array] | list[int]) -> Array | int:
    """The step in a flat array to a corner (z, y, x); jumps: steps along x, y and z."""
    return sum(jump for up, jump in zip(corner[::-1], jumps, strict=True) if up)
