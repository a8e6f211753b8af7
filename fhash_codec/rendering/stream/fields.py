"""Fields that streamed samples are read from: the network of a file, or another model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Protocol

import numpy as np
import numpy.typing as npt

from fhash_codec.paper.model import PaperModel
from fhash_codec.rendering.stream.inference import inference_in
from fhash_codec.rendering.task.arrays import NUMPY, Array, Arrays
from fhash_codec.rendering.task.bricks import Bricks
from fhash_codec.rendering.task.palette import Palette
from fhash_codec.rendering.task.task import Frame
from fhash_codec.rendering.task.units import Units
from fhash_codec.volume import Volume
from fhash_formats.errors import InputError

__all__ = ["CoresetField", "Field", "NetworkField", "central_slopes"]

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
        """The place (3,), x, y, z, at which the first brick and the first cell begin."""
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

    They are over one vertex before and behind along each axis, clamped to those of the field. Where
    one of the two has no value, the field's own slope along that axis stands.
    """
    arrays, xp, (low, high) = field.arrays, field.arrays.xp, field.vertices.T
    slopes = arrays.empty((len(places), 3))
    for axis in range(3):
        ends = []
        for offset in (-1.0, 1.0):
            moved = arrays.copy(places)
            moved[:, axis] = xp.clip(
                xp.clip(places[:, axis], low[axis], high[axis]) + offset, low[axis], high[axis]
            )
            ends.append(field.values(moved))
        slopes[:, axis] = (ends[1] - ends[0]) / 2
    (missing,) = arrays.nonzero(xp.any(xp.isnan(slopes), axis=1))
    if len(missing):
        slopes[missing] = xp.where(
            xp.isnan(slopes[missing]), field.slopes(places[missing]), slopes[missing]
        )
    return slopes


class CoresetField:
    """The box of a coreset, for fields that have values within the coreset alone.

    A place has a value where all vertices of weight around it are in the coreset. Which one is not
    known before the field is evaluated: any value of the range, with a margin.
    """

    def __init__(
        self,
        in_coreset: npt.NDArray[np.bool_],
        first: npt.ArrayLike,
        flat: npt.ArrayLike,
        ends: tuple[float, float],
        arrays: Arrays,
    ) -> None:
        """Prepare a box.

        Args:
            in_coreset: bool (z, y, x), its vertices.
            first: (3,), x, y, z, the first of them in vertices of the domain.
            flat: bool (3,), x, y, z, axes along which the domain has one vertex.
            ends: of the range of values.
            arrays: that places and values are in.
        """
        self.arrays = arrays
        counts = np.array(in_coreset.shape[::-1])
        low = np.array(first, np.float64)
        vertices = np.stack([low, low + counts - 1], axis=-1)
        widened = np.where(np.array(flat)[:, None], [-0.5, 0.5], 0.0)
        self.first, self.vertices = arrays.array(low), arrays.array(vertices)
        self.bounds = arrays.array(vertices + widened)
        self._last, self._flat = arrays.array(counts - 1.0), arrays.array(flat)
        self._jumps = (1, int(counts[0]), int(counts[0] * counts[1]))
        with arrays.guarded():
            self._in_coreset = arrays.array(in_coreset)
        self.bricks = _possible(in_coreset, *ends)

    def visible(self, palette: Palette) -> Array:
        """Cells with a vertex of the coreset: their values are not known before evaluation."""
        return _of_cells(self._in_coreset, self.arrays.xp.logical_or)

    def inside(self, places: Array) -> tuple[Array, Array]:
        """Places (n, 3) in vertices of the box, clipped to it, and whether they have a value."""
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
            jump = sum(step for up, step in zip(corner[::-1], jumps, strict=True) if up)
            inside &= xp.take(in_coreset, first + jump)
        return at, inside


class NetworkField(CoresetField):
    """The network of a file of the profile paper, evaluated at every place.

    Between vertices it has values of its own.
    """

    def __init__(self, volume: Volume, step: float, units: Units, arrays: Arrays = NUMPY) -> None:
        model = volume._model
        if not isinstance(model, PaperModel):
            raise InputError(
                f"{volume.path}: a file of the profile {volume.profile} has no network"
            )
        self._low, self._high = (
            float(end) for end in units.to([volume.value_range.low, volume.value_range.high])
        )
        super().__init__(
            np.ascontiguousarray(volume.occupancy(step, volume.box)),
            [low for low, _ in reversed(volume.box)],
            np.array(volume.shape[:0:-1]) == 1,
            (self._low, self._high),
            arrays,
        )
        with arrays.guarded():
            self._inference = inference_in(arrays, model.network, volume.key_times.key_index(step))

    def values(self, places: Array, wanted: Array | None = None) -> Array:
        arrays, (at, inside) = self.arrays, self.inside(places)
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
        arrays, (at, inside) = self.arrays, self.inside(places)
        result, some = arrays.full((len(places), 3), 0.0), arrays.candidates(inside)
        if len(at := at[some]):
            slopes = arrays.to_float64(self._inference.slopes(at)) * (self._high - self._low)
            slopes = arrays.xp.nan_to_num(slopes, nan=0.0, posinf=0.0, neginf=0.0)
            result[some] = arrays.kept(inside[some], slopes, 0.0)
        return result


def _possible(in_coreset: npt.NDArray[np.bool_], low: float, high: float) -> Bricks:
    """Bricks with the values that a field of a coreset may have: a range, with a margin."""
    bricks = Bricks.of(
        Frame(values=np.where(in_coreset, np.float32(1), np.float32(np.nan)), first=(0, 0, 0))
    )
    has_value = bricks.low <= bricks.high
    return replace(
        bricks,
        low=np.where(has_value, np.float32(2 * low - high), np.float32(np.inf)),
        high=np.where(has_value, np.float32(2 * high - low), np.float32(-np.inf)),
    )


def _of_cells(values: Array, reduce: Callable[[Array, Array], Array]) -> Array:
    """Reduce the eight vertices of each cell (z, y, x) by a function of two arrays.

    An axis of one vertex has one cell.
    """
    for axis in range(3):
        if values.shape[axis] > 1:
            before = (slice(None),) * axis
            values = reduce(values[(*before, slice(None, -1))], values[(*before, slice(1, None))])
    return values
