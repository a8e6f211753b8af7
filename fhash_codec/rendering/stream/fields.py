"""Where streamed samples get their values from: a decoded frame, or the model itself at every point."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Protocol

import numpy as np

from fhash_codec.paper.model import PaperModel
from fhash_codec.rendering.camera.camera import Grid
from fhash_codec.rendering.stream.inference import DenseInference, Inference, PatchInference
from fhash_codec.rendering.task.arrays import NUMPY, Array, Arrays
from fhash_codec.rendering.task.bricks import Bricks
from fhash_codec.rendering.task.palette import Palette
from fhash_codec.rendering.task.task import Frame
from fhash_codec.rendering.task.units import Units
from fhash_codec.volume import Volume
from fhash_formats.errors import InputError

__all__ = ["Field", "FrameField", "NetworkField", "central_slopes"]


class Field(Protocol):
    """Values anywhere in the domain; places (n, 3), float64, are x, y, z in vertices of the domain, in arrays of `arrays`."""

    @property
    def arrays(self) -> Arrays:
        """Where it takes places and gives values."""
        ...

    @property
    def bounds(self) -> Array:
        """The box (3, 2), x, y, z, beyond which nothing has a value."""
        ...

    @property
    def vertices(self) -> Array:
        """The box (3, 2), x, y, z, from its first vertex to its last."""
        ...

    @property
    def bricks(self) -> Bricks:
        """What its bricks hold, at most."""
        ...

    @property
    def first(self) -> Array:
        """Where the first brick begins (x, y, z), and `stride` vertices of the domain make a cell's side."""
        ...

    @property
    def stride(self) -> float:
        """Vertices of the domain from one value to the next."""
        ...

    def visible(self, palette: Palette) -> Array:
        """Cells (z, y, x), the first at `first`, in which a sample could have an opacity; a few more may be among them."""
        ...

    def values(self, places: Array) -> Array:
        """Values float64 (n,), NaN where there is none."""
        ...

    def slopes(self, places: Array) -> Array:
        """Derivatives float64 (n, 3) by x, y and z per vertex, 0 where there are none."""
        ...


def central_slopes(field: Field, places: Array) -> Array:
    """Slopes by differences between the places one vertex of the field before and behind along each axis, clamped to its vertices.

    places: (n, 3). Where one of the two has no value, the field's own slope along that axis.
    """
    arrays, xp, (low, high) = field.arrays, field.arrays.xp, field.vertices.T
    found = arrays.empty((len(places), 3))
    for axis in range(3):
        ends = []
        for way in (-field.stride, field.stride):
            moved = arrays.copy(places)
            moved[:, axis] = xp.clip(
                xp.clip(places[:, axis], low[axis], high[axis]) + way, low[axis], high[axis]
            )
            ends.append(field.values(moved))
        found[:, axis] = (ends[1] - ends[0]) / (2 * field.stride)
    (missing,) = arrays.nonzero(xp.any(xp.isnan(found), axis=1))
    if len(missing):
        found[missing] = xp.where(
            xp.isnan(found[missing]), field.slopes(places[missing]), found[missing]
        )
    return found


class FrameField:
    """Trilinear between decoded vertices; a place whose cell has a vertex of weight without a value has none."""

    def __init__(self, frame: Frame, grid: Grid, bricks: Bricks, arrays: Arrays = NUMPY) -> None:
        self.arrays, self.bricks = arrays, bricks
        self.stride = float(frame.stride)
        first, counts = (
            np.array(frame.first[::-1], dtype=np.float64),
            np.array(frame.values.shape[::-1]),
        )
        self.bounds, self.first = arrays.array(frame.bounds(grid)), arrays.array(first)
        self.vertices = arrays.array(
            np.stack([first, first + (counts - 1) * frame.stride], axis=-1)
        )
        self._last, self._last_cell = (
            arrays.array(counts - 1.0),
            arrays.array(np.maximum(counts - 2.0, 0.0)),
        )
        self._jumps = (1, int(counts[0]), int(counts[0] * counts[1]))
        self._wide = [bool(count > 1) for count in counts]
        with arrays.guarded():
            self._values = arrays.array(bricks.values)
        self._flat = self._values.reshape(-1)

    def visible(self, palette: Palette) -> Array:
        """As `Field` has it."""
        arrays, xp = self.arrays, self.arrays.xp
        layers = max(1, arrays.batch // self._jumps[2])
        found = []
        for start in range(0, max(len(self._values) - 1, 1), layers):
            values = self._values[start : start + layers + 1]
            found.append(
                palette.visible(
                    *(arrays.real(_of_cells(values, extreme)) for extreme in (xp.fmin, xp.fmax))
                )
            )
        return xp.concatenate(found)

    def values(self, places: Array) -> Array:
        """As `Field` has it."""
        result = self.arrays.empty((len(places),))
        for start in range(0, len(places), self.arrays.batch):
            inside, low, share = self._located(
                places[start : start + self.arrays.batch], self._last
            )
            # The corner after counts only where it has weight, so that a missing one beyond a vertex does not matter.
            jumps = [
                self.arrays.whole(share[:, axis] > 0) * jump
                for axis, jump in enumerate(self._jumps)
            ]
            corners = self._corners(low, jumps)
            along = corners[:, :, 0] + share[:, 0] * (corners[:, :, 1] - corners[:, :, 0])
            across = along[:, 0] + share[:, 1] * (along[:, 1] - along[:, 0])
            found = across[0] + share[:, 2] * (across[1] - across[0])
            result[start : start + len(found)] = self.arrays.xp.where(inside, found, np.nan)
        return result

    def slopes(self, places: Array) -> Array:
        """As `Field` has it; on the border of two cells those of the cell after it."""
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
            steps = corners[:, :, 1] - corners[:, :, 0]
            along = corners[:, :, 0] + x * steps
            across = along[:, 0] + y * (along[:, 1] - along[:, 0])
            part = steps[:, 0] + y * (steps[:, 1] - steps[:, 0])
            rise = along[:, 1] - along[:, 0]
            found = xp.stack(
                [
                    part[0] + z * (part[1] - part[0]),
                    rise[0] + z * (rise[1] - rise[0]),
                    across[1] - across[0],
                ],
                axis=-1,
            )
            result[start : start + len(found)] = (
                xp.nan_to_num(found, nan=0.0, posinf=0.0, neginf=0.0) / self.stride
            )
        return result

    def _located(self, places: Array, most: Array) -> tuple[Array, Array, Array]:
        """Whether places are within the bounds, the numbers (n,) of the vertices before them, and shares (n, 3) of those after.

        most: the last vertex (x, y, z) that counts as one before a place.
        """
        arrays, xp, last = self.arrays, self.arrays.xp, self._last
        inside = xp.all((places >= self.bounds[:, 0]) & (places <= self.bounds[:, 1]), axis=1)
        at = xp.clip((places - self.first) / self.stride, 0 * last, last)
        before = xp.minimum(xp.floor(at), most)
        x, y, z = arrays.whole(before).T
        return inside, x + y * self._jumps[1] + z * self._jumps[2], at - before

    def _corners(self, low: Array, jumps: list[Array] | list[int]) -> Array:
        """Values (z 2, y 2, x 2, n) around places; jumps, (n,) or one for all, to the vertices after them along x, y and z."""
        found = self.arrays.empty((2, 2, 2, len(low)))
        for corner in product((0, 1), repeat=3):
            found[corner] = self.arrays.xp.take(
                self._flat,
                low + sum(jump for up, jump in zip(corner[::-1], jumps, strict=True) if up),
            )
        return found


class NetworkField:
    """The network of a file of the profile paper at every point: between its vertices it has values of its own."""

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
        first, last = (
            np.array([float(ends[side]) for ends in volume.box][::-1]) for side in (0, 1)
        )
        flat = np.array(volume.shape[:0:-1]) == 1
        ends = np.stack([first, last - 1], axis=-1)
        self.vertices, self.bounds = (
            arrays.array(ends),
            arrays.array(ends + np.where(flat[:, None], [-0.5, 0.5], 0.0)),
        )
        self.first, self._last, self._flat = (
            arrays.array(part) for part in (first, last - 1 - first, flat)
        )
        occupied = np.ascontiguousarray(volume.occupancy(step, volume.box))
        network = model.network
        with arrays.guarded():
            self._occupied = arrays.array(occupied)
            self._inference: Inference = (
                PatchInference(network, key)
                if arrays is NUMPY
                else DenseInference(network, key, arrays)
            )
        self._jumps = (1, occupied.shape[2], occupied.shape[1] * occupied.shape[2])
        self.bricks = self._possible(occupied)

    def _possible(self, occupied: Array) -> Bricks:
        """What a brick of a network holds is not known before it is evaluated: any value, with a margin, where there is one at all."""
        found = Bricks.of(
            Frame(values=np.where(occupied, np.float32(1), np.float32(np.nan)), first=(0, 0, 0))
        )
        low, high = np.float32(2 * self._low - self._high), np.float32(2 * self._high - self._low)
        known = found.low <= found.high
        return replace(
            found,
            low=np.where(known, low, np.float32(np.inf)),
            high=np.where(known, high, np.float32(-np.inf)),
        )

    def visible(self, palette: Palette) -> Array:
        """As `Field` has it: where there is a vertex of the coreset."""
        return _of_cells(self._occupied, self.arrays.xp.logical_or)

    def values(self, places: Array) -> Array:
        """As `Field` has it."""
        at, inside = self._inside(places)
        result = self.arrays.full(len(places), np.nan)
        if len(at := at[inside]):
            unit = self.arrays.xp.clip(self.arrays.real(self._inference.values(at)), 0.0, 1.0)
            result[inside] = self._low + unit * (self._high - self._low)
        return result

    def slopes(self, places: Array) -> Array:
        """As `Field` has it: analytic, through interpolation and network."""
        at, inside = self._inside(places)
        result = self.arrays.full((len(places), 3), 0.0)
        if len(at := at[inside]):
            slopes = self.arrays.real(self._inference.slopes(at)) * (self._high - self._low)
            result[inside] = self.arrays.xp.nan_to_num(slopes, nan=0.0, posinf=0.0, neginf=0.0)
        return result

    def _inside(self, places: Array) -> tuple[Array, Array]:
        """Places in vertices of the box, and whether all vertices of weight around them are in the coreset."""
        arrays, xp, last = self.arrays, self.arrays.xp, self._last
        at = xp.where(self._flat, 0.0, places - self.first)
        inside = xp.all((at >= 0) & (at <= last), axis=1)
        at = xp.clip(at, 0 * last, last)
        low = arrays.whole(at)
        first = low[:, 0] + low[:, 1] * self._jumps[1] + low[:, 2] * self._jumps[2]
        jumps = [
            arrays.whole(at[:, axis] > low[:, axis]) * jump for axis, jump in enumerate(self._jumps)
        ]
        flat = self._occupied.reshape(-1)
        for corner in product((0, 1), repeat=3):
            inside &= xp.take(
                flat, first + sum(jump for up, jump in zip(corner[::-1], jumps, strict=True) if up)
            )
        return at, inside


def _of_cells(values: Array, reduce: Callable[[Array, Array], Array]) -> Array:
    """A function of two arrays over the eight vertices of each cell (z, y, x); an axis of one vertex has one cell."""
    for axis in range(3):
        if values.shape[axis] > 1:
            before = (slice(None),) * axis
            values = reduce(values[(*before, slice(None, -1))], values[(*before, slice(1, None))])
    return values
