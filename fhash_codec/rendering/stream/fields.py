"""Fields that streamed samples are read from: a decoded frame, or the model itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Protocol

import numpy as np

from fhash_codec.paper.model import PaperModel
from fhash_codec.rendering.camera.camera import Grid
from fhash_codec.rendering.stream.inference import inference_in
from fhash_codec.rendering.task.arrays import NUMPY, Array, Arrays
from fhash_codec.rendering.task.bricks import Bricks
from fhash_codec.rendering.task.palette import Palette
from fhash_codec.rendering.task.task import Frame
from fhash_codec.rendering.task.units import Units
from fhash_codec.volume import Volume
from fhash_formats.errors import InputError

__all__ = ["Field", "FrameField", "NetworkField", "central_slopes"]

CORNERS = tuple(product((0, 1), repeat=3))
"""Corners (z, y, x) of a cell: 0 for the vertex before a place, 1 for the one after it."""


class Field(Protocol):
    """Values anywhere in the domain, in arrays of `arrays`.

    Places (n, 3), float64, are x, y, z in vertices of the domain.
    """

    @property
    def arrays(self) -> Arrays:
        """The arrays that places and values are in."""
        ...

    @property
    def bounds(self) -> Array:
        """The box (3, 2), x, y, z, beyond which nothing has a value."""
        ...

    @property
    def vertices(self) -> Array:
        """The box (3, 2), x, y, z, from the first vertex to the last."""
        ...

    @property
    def bricks(self) -> Bricks:
        """Bricks with values at least as far apart as those of the field."""
        ...

    @property
    def first(self) -> Array:
        """The place (3,), x, y, z, at which the first brick begins."""
        ...

    @property
    def stride(self) -> float:
        """Vertices of the domain from one value to the next: the side of a cell."""
        ...

    def visible(self, palette: Palette) -> Array:
        """Cells (z, y, x), the first at `first`, in which a sample could have an opacity.

        A few more may be among them.
        """
        ...

    def values(self, places: Array, wanted: Array | None = None) -> Array:
        """Values, float64 (n,), NaN where there is none, and where none is wanted.

        wanted: bool (n,). A device may wait in order to compute no others; without it a device
            computes all and does not wait.
        """
        ...

    def slopes(self, places: Array) -> Array:
        """Derivatives by x, y and z per vertex, float64 (n, 3), 0 where there are none."""
        ...


def central_slopes(field: Field, places: Array) -> Array:
    """Slopes (n, 3) at places (n, 3) by central differences.

    They are over one vertex of the field before and behind along each axis, clamped to its
    vertices. Where one of the two has no value, the field's own slope along that axis stands.
    """
    arrays, xp, (low, high) = field.arrays, field.arrays.xp, field.vertices.T
    slopes = arrays.empty((len(places), 3))
    for axis in range(3):
        ends = []
        for offset in (-field.stride, field.stride):
            moved = arrays.copy(places)
            moved[:, axis] = xp.clip(
                xp.clip(places[:, axis], low[axis], high[axis]) + offset, low[axis], high[axis]
            )
            ends.append(field.values(moved))
        slopes[:, axis] = (ends[1] - ends[0]) / (2 * field.stride)
    (missing,) = arrays.nonzero(xp.any(xp.isnan(slopes), axis=1))
    if len(missing):
        slopes[missing] = xp.where(
            xp.isnan(slopes[missing]), field.slopes(places[missing]), slopes[missing]
        )
    return slopes


class FrameField:
    """A decoded frame, trilinear between its vertices.

    A place has no value where a vertex of weight around it has none.
    """

    def __init__(self, frame: Frame, grid: Grid, bricks: Bricks, arrays: Arrays = NUMPY) -> None:
        self.arrays, self.bricks = arrays, bricks
        self._frame, self._grid = frame, grid
        self.stride = float(frame.stride)
        first = np.array(frame.first[::-1], dtype=np.float64)
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

    def smoothed(self, deviation: float, error: float) -> FrameField:
        """The field of values that a Gaussian has smoothed, as `smoothing.smoothed` has them."""
        bricks = replace(self.bricks, values=self.bricks.smoothed(deviation, error))
        return FrameField(self._frame, self._grid, bricks, self.arrays)

    def visible(self, palette: Palette) -> Array:
        arrays, xp = self.arrays, self.arrays.xp
        layers = max(1, arrays.batch // self._jumps[2])
        visible = []
        for start in range(0, max(len(self._values) - 1, 1), layers):
            values = self._values[start : start + layers + 1]
            low, high = (
                arrays.to_float64(_of_cells(values, extreme)) for extreme in (xp.fmin, xp.fmax)
            )
            visible.append(palette.visible(low, high))
        return xp.concatenate(visible)

    def values(self, places: Array, wanted: Array | None = None) -> Array:
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
            result[start : start + len(slopes)] = (
                xp.nan_to_num(slopes, nan=0.0, posinf=0.0, neginf=0.0) / self.stride
            )
        return result

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


class NetworkField:
    """The network of a file of the profile paper, evaluated at every place.

    Between vertices it has values of its own. A place has no value where a vertex of weight around
    it is outside the coreset.
    """

    def __init__(self, volume: Volume, step: float, units: Units, arrays: Arrays = NUMPY) -> None:
        model = volume._model
        if not isinstance(model, PaperModel):
            raise InputError(
                f"{volume.path}: a file of the profile {volume.profile} has no network"
            )
        self.arrays, self.stride = arrays, 1.0
        self._low, self._high = (
            float(end) for end in units.to([volume.value_range.low, volume.value_range.high])
        )
        key = volume.key_times.key_index(step)
        first, stop = (
            np.array([float(ends[side]) for ends in volume.box][::-1]) for side in (0, 1)
        )
        flat = np.array(volume.shape[:0:-1]) == 1
        ends = np.stack([first, stop - 1], axis=-1)
        self.vertices = arrays.array(ends)
        self.bounds = arrays.array(ends + np.where(flat[:, None], [-0.5, 0.5], 0.0))
        self.first = arrays.array(first)
        self._last, self._flat = arrays.array(stop - 1 - first), arrays.array(flat)
        in_coreset = np.ascontiguousarray(volume.occupancy(step, volume.box))
        network = model.network
        with arrays.guarded():
            self._in_coreset = arrays.array(in_coreset)
            self._inference = inference_in(arrays, network, key)
        self._jumps = (1, in_coreset.shape[2], in_coreset.shape[1] * in_coreset.shape[2])
        self.bricks = self._possible(in_coreset)

    def _possible(self, in_coreset: Array) -> Bricks:
        """Bricks with the values that a network may have: any value of the range, with a margin.

        Which one is not known before the network is evaluated.
        """
        bricks = Bricks.of(
            Frame(values=np.where(in_coreset, np.float32(1), np.float32(np.nan)), first=(0, 0, 0))
        )
        low, high = np.float32(2 * self._low - self._high), np.float32(2 * self._high - self._low)
        has_value = bricks.low <= bricks.high
        return replace(
            bricks,
            low=np.where(has_value, low, np.float32(np.inf)),
            high=np.where(has_value, high, np.float32(-np.inf)),
        )

    def visible(self, palette: Palette) -> Array:
        """Cells with a vertex of the coreset: their values are not known before evaluation."""
        return _of_cells(self._in_coreset, self.arrays.xp.logical_or)

    def values(self, places: Array, wanted: Array | None = None) -> Array:
        arrays, (at, inside) = self.arrays, self._inside(places)
        result = arrays.full(len(places), np.nan)
        if wanted is None:
            some = arrays.candidates(inside)
        else:
            (some,) = arrays.nonzero(inside & wanted)
        if len(at := at[some]):
            unit = arrays.xp.clip(arrays.to_float64(self._inference.values(at)), 0.0, 1.0)
            values = self._low + unit * (self._high - self._low)
            result[some] = arrays.kept(inside[some], values, np.nan)
        return result

    def slopes(self, places: Array) -> Array:
        """Derivatives as `Field` has them, analytic, through interpolation and network."""
        arrays, (at, inside) = self.arrays, self._inside(places)
        result, some = arrays.full((len(places), 3), 0.0), arrays.candidates(inside)
        if len(at := at[some]):
            slopes = arrays.to_float64(self._inference.slopes(at)) * (self._high - self._low)
            slopes = arrays.xp.nan_to_num(slopes, nan=0.0, posinf=0.0, neginf=0.0)
            result[some] = arrays.kept(inside[some], slopes, 0.0)
        return result

    def _inside(self, places: Array) -> tuple[Array, Array]:
        """Places (n, 3) in vertices of the network's box, clipped to it, and whether they count.

        A place counts where it is in the box and all vertices of weight around it are in the
        coreset.
        """
        arrays, xp, last = self.arrays, self.arrays.xp, self._last
        at = xp.where(self._flat, 0.0, places - self.first)
        inside = xp.all((at >= 0) & (at <= last), axis=1)
        at = xp.clip(at, 0 * last, last)
        low = arrays.to_int64(at)
        first = low[:, 0] + low[:, 1] * self._jumps[1] + low[:, 2] * self._jumps[2]
        jumps = [
            arrays.to_int64(at[:, axis] > low[:, axis]) * jump
            for axis, jump in enumerate(self._jumps)
        ]
        in_coreset = self._in_coreset.reshape(-1)
        for corner in CORNERS:
            inside &= xp.take(in_coreset, first + _jump(corner, jumps))
        return at, inside


def _jump(corner: tuple[int, ...], jumps: list[Array] | list[int]) -> Array | int:
    """The step in a flat array to a corner (z, y, x); jumps: steps along x, y and z."""
    return sum(jump for up, jump in zip(corner[::-1], jumps, strict=True) if up)


def _of_cells(values: Array, reduce: Callable[[Array, Array], Array]) -> Array:
    """Reduce the eight vertices of each cell (z, y, x) by a function of two arrays.

    An axis of one vertex has one cell.
    """
    for axis in range(3):
        if values.shape[axis] > 1:
            before = (slice(None),) * axis
            values = reduce(values[(*before, slice(None, -1))], values[(*before, slice(1, None))])
    return values
