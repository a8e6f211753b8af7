"""Value ranges of small bricks of a frame, by which rays leap, and the cells that are visible."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import product
from typing import Any, TypeVar, cast

import numpy as np
import numpy.typing as npt

from fhash_codec import native
from fhash_codec.native import pointer
from fhash_codec.rendering.march_task import NUMPY, Array, Arrays, Frame, Table, Task
from fhash_formats.support.threads import in_threads
from fhash_formats.support.values import Mask, Single


@dataclass(frozen=True, kw_only=True, eq=False)
class Palette:
    """A `Table` in arrays of `arrays`.

    Attributes:
        low, high: values of the first and the last entry.
        colours: float64 (n, 3), 0..1.
        extinctions: float64 (n,), per unit of the coordinates.
        opaque_before: int64 (n + 1,), number of entries before each one that have an extinction.
    """

    arrays: Arrays
    low: float
    high: float
    colours: Array
    extinctions: Array
    opaque_before: Array

    @classmethod
    def of(cls, table: Table, arrays: Arrays = NUMPY) -> Palette:
        """The palette of a table."""
        opaque_before = np.concatenate([[0], np.cumsum(table.extinctions > 0)])
        return cls(
            arrays=arrays,
            low=table.low,
            high=table.high,
            colours=arrays.array(table.colours, "float64"),
            extinctions=arrays.array(table.extinctions, "float64"),
            opaque_before=arrays.array(opaque_before, "int64"),
        )

    def colour(self, values: Array) -> Array:
        """Colours (n, 3) of finite values (n,), linear between the entries."""
        before, share = self._located(values)
        share = share[:, None]
        return self.colours[before] * (1 - share) + self.colours[before + 1] * share

    def extinction(self, values: Array) -> Array:
        """Extinctions (n,) of finite values (n,), linear between the entries."""
        xp = self.arrays.xp
        before, share = self._located(values)
        low = xp.take(self.extinctions, before)
        return low + share * (xp.take(self.extinctions, before + 1) - low)

    def visible(self, low: Array, high: Array) -> Array:
        """Whether a value between `low` and `high` has an extinction.

        False where one of the two is NaN or `low` is above `high`.
        """
        xp, last = self.arrays.xp, len(self.extinctions) - 1
        ordered = low <= high
        first, stop = (
            xp.clip(self._entry(xp.where(ordered, ends, 0.0)), 0, last) for ends in (low, high)
        )
        first, stop = self.arrays.to_int64(xp.floor(first)), self.arrays.to_int64(xp.ceil(stop))
        return ordered & (
            xp.take(self.opaque_before, stop + 1) > xp.take(self.opaque_before, first)
        )

    def _entry(self, values: Array) -> Array:
        """Positions of values among the entries, fractional.

        They are infinite where the table is so narrow that float64 does not hold them.
        """
        with np.errstate(over="ignore"):
            return (values - self.low) / (self.high - self.low) * (len(self.extinctions) - 1)

    def _located(self, values: Array) -> tuple[Array, Array]:
        """The entry before each value, and the weight 0..1 of the entry after it."""
        last = len(self.extinctions) - 1
        entry = self.arrays.xp.clip(self._entry(values), 0, last)
        before = self.arrays.xp.clip(self.arrays.to_int64(entry), None, last - 1)
        return before, entry - before


Result = TypeVar("Result")

SIDE: int = native.ffi.integer_const("FHASH_BRICK")
"""Cells along a brick's side. With twice as many, a narrow interval takes twice the samples."""
FARTHEST = 255
"""Largest distance of bricks, in bricks, and so the largest leap of a ray."""
ROUNDING = 2.0**-22
"""Distance of an interpolated float32 beyond the values around it, at most, as a share of the
largest magnitude.
"""
LAYERS = 4
"""Layers or rows of bricks that a thread looks at together."""
CACHED = 3
"""Results of each kind that bricks keep, by default: those of the last transfer functions."""
SMALL = 2**19
"""Vertices of a frame below which threads take longer to start than the work takes."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Bricks:
    """The extreme values of a frame's bricks. One object serves every picture of the frame.

    What follows from the frame and a transfer function alone is kept for the next picture.

    Attributes:
        values: float32 (z, y, x), contiguous, the values of the frame with NaN for infinite ones.
        low, high: float32 (z, y, x) of bricks, the smallest and the largest value; infinity and
            minus infinity where a brick has no value.
        value_range: the smallest and the largest value, of the series where it is known: then it
            depends neither on the step nor on what is decoded. (0, 0) where there is none.
    """

    values: Single
    low: Single
    high: Single
    value_range: tuple[float, float]
    _kept: dict[str, OrderedDict[object, Any]] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def of(cls, frame: Frame) -> Bricks:
        """The bricks of a frame, found in a time that is short beside that of a picture."""
        values = np.ascontiguousarray(frame.values, dtype=np.float32)
        low, high = extremes(values)
        if not finite(low, high):
            values = np.where(np.isfinite(values), values, np.float32(np.nan))
            low, high = extremes(values)
        least, most = float(low.min()), float(high.max())
        ends = (least, most) if least <= most else (0.0, 0.0)
        return cls(values=values, low=low, high=high, value_range=ends)

    @classmethod
    def unknown(cls, values: Single) -> Bricks:
        """The bricks of values that are still to come: without a value."""
        low = np.full(_counts(values), np.inf, dtype=np.float32)
        return cls(values=values, low=low, high=-low, value_range=(0.0, 0.0))

    def remembered(
        self, kind: str, key: object, compute: Callable[[], Result], most: int = CACHED
    ) -> Result:
        """The result of a function, kept from an earlier call with the same kind and key.

        The results of the last `most` keys of a kind are kept.
        """
        kept = self._kept.setdefault(kind, OrderedDict())
        if key in kept:
            kept.move_to_end(key)
        else:
            kept[key] = compute()
            while len(kept) > most:
                kept.popitem(last=False)
        return cast(Result, kept[key])

    def smoothed(self, deviation: float, error: float) -> Single:
        """The values smoothed by a Gaussian, as `smoothed` has them, kept."""
        return self.remembered(
            "smoothed", (deviation, error), lambda: smoothed(self.values, deviation, error), most=1
        )

    def matters(self, task: Task) -> Mask:
        """Whether a brick (z, y, x) has anything visible: a value with extinction, or a surface."""
        limits, visible = limits_of(self, task), np.zeros(self.low.shape, dtype=bool)
        if len(limits) > MAX_LIMITS:
            limits = limits[[0, -1]].reshape(1, 4)[:, [0, 3]]

        def look(first: int, stop: int) -> None:
            """Look at layers of bricks."""
            layers = slice(first, stop)
            for low, high in limits:
                visible[layers] |= (self.low[layers] < high) & (self.high[layers] > low)

        _in_turn(look, len(visible), self.values.size)
        return visible

    def distance(self, task: Task) -> npt.NDArray[np.int32]:
        """Distance of each brick from the nearest that matters: int32 (z, y, x), 0..FARTHEST.

        It is counted in bricks, a diagonal step as one. The array is kept for the next picture that
        sees the same values, and cannot be written to.
        """

        def compute() -> npt.NDArray[np.int32]:
            matters = self.matters(task)
            distance = np.where(matters, 0, FARTHEST).astype(np.int32)
            if matters.any():
                nearest(distance)
            distance.flags.writeable = False
            return distance

        return self.remembered("distance", task.visibility, compute)


def _counts(values: Single) -> list[int]:
    """Numbers of bricks along z, y and x."""
    return [max(-(-(size - 1) // SIDE), 1) for size in values.shape]


def finite(low: Single, high: Single) -> bool:
    """Whether bricks of these smallest and largest values have no infinite one."""
    return not (np.isneginf(low).any() or np.isposinf(high).any())


def extremes(values: Single) -> tuple[Single, Single]:
    """The smallest and the largest value of each brick, as the attributes of `Bricks` have them."""
    bricks = _counts(values)
    low, high = np.empty(bricks, dtype=np.float32), np.empty(bricks, dtype=np.float32)
    library = native.library()
    assert values.strides[2] == values.itemsize
    strides = [stride // values.itemsize for stride in values.strides[:2]]
    first_value = native.ffi.cast("float *", values.ctypes.data)  # of a part of an array

    def layers(first: int, stop: int) -> None:
        scratch = np.empty(2 * values.shape[2], dtype=np.float32)
        library.fhash_march_bricks(
            *(first_value, values.shape, strides, bricks, SIDE, first, stop),
            *map(pointer, (low, high, scratch)),
        )

    _in_turn(layers, bricks[0], values.size)
    return low, high


def nearest(distance: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    """Put the distance from the nearest brick of 0 in place of larger numbers (z, y, x)."""
    library = native.library()
    layers, rows = library.fhash_march_distance_layers, library.fhash_march_distance_rows
    for count, function in zip(distance.shape, (layers, rows), strict=False):

        def find(first: int, stop: int, function: Callable[..., object] = function) -> None:
            scratch = np.empty(max(distance.shape[:2]) * distance.shape[2], dtype=np.int32)
            function(distance.shape, pointer(distance), first, stop, pointer(scratch))

        _in_turn(find, count, distance.size * SIDE**3)
    return distance


CORNERS = tuple(product((0, 1), repeat=3))
"""Corners (z, y, x) of a cell: 0 for the vertex before a place, 1 for the one after it."""


def of_cells(values: Array, reduce: Callable[[Array, Array], Array]) -> Array:
    """Reduce the eight vertices of each cell (z, y, x) by a function of two arrays.

    An axis of one vertex has one cell.
    """
    for axis in range(3):
        if values.shape[axis] > 1:
            before = (slice(None),) * axis
            values = reduce(values[(*before, slice(None, -1))], values[(*before, slice(1, None))])
    return values


def _in_turn(function: Callable[[int, int], object], count: int, vertices: int) -> None:
    """Call a function with spans of 0 to `count`: in threads, if the frame has enough vertices."""
    if vertices < SMALL:
        function(0, count)
    else:
        spans = [(first, min(first + LAYERS, count)) for first in range(0, count, LAYERS)]
        list(in_threads(lambda span: function(*span), spans))


REACH = 3.0
"""Standard deviations after which the Gaussian ends."""


def smoothed(values: Single, deviation: float, error: float = math.inf) -> Single:
    """Values smoothed by a Gaussian along each axis, and no further from their own than an error.

    The pair of values on both sides of a vertex counts only where both are there; else twice the
    value of the vertex takes its place. So values that are linear stay as they are, up to the
    faces. A missing value stays missing.

    Bounded files are shaded by the gradients of such values. Their errors have no direction, and
    largely cancel in them. Where the values themselves change from vertex to vertex, a Gaussian
    would blur what is there: a smoothed value that is further from the decoded one than the bound
    is wrong for sure, and is clipped to the bound.

    Args:
        values: float32 (z, y, x), contiguous, NaN where there is none.
        deviation: standard deviation of the Gaussian, in vertices, above 0.
        error: largest difference of a smoothed value from its own, in the units of the values.
    """
    weights = _weights(deviation)
    library = native.library()
    layers, rows, _ = values.shape
    flat, out = np.empty_like(values), np.empty_like(values)
    given = values.shape, pointer(weights), len(weights) - 1

    def layer(z: int) -> None:
        scratch = np.empty(values.shape[1:], dtype=np.float32)
        library.fhash_march_smooth_layers(
            pointer(values), *given, z, z + 1, pointer(flat), pointer(scratch)
        )

    def row(y: int) -> None:
        library.fhash_march_smooth_rows(pointer(flat), *given, y, y + 1, pointer(out))

    def clip(z: int) -> None:
        out[z] -= values[z]
        np.clip(out[z], -np.float32(error), np.float32(error), out=out[z])
        out[z] += values[z]

    list(in_threads(layer, range(layers)))
    list(in_threads(row, range(rows)))
    if error < math.inf:
        list(in_threads(clip, range(layers)))
    return out


def reach_of(deviation: float) -> int:
    """Vertices that a Gaussian reaches on both sides."""
    return math.ceil(REACH * deviation)


def _weights(deviation: float) -> Single:
    """Weights of a value itself and of those 1, 2 and so on vertices away on both sides."""
    away = np.arange(reach_of(deviation) + 1)
    weights = np.exp(-0.5 * (away / deviation) ** 2)
    return np.asarray(weights / (2 * weights.sum() - weights[0]), dtype=np.float32)


Numbers = npt.NDArray[np.int64]
Interval = tuple[float, float]

PROBED = 64
"""Bricks from which the share of visible cells is estimated."""
MAX_SEEN = 0.5
"""Largest share of visible cells in the probed bricks; above it the search for them takes longer
than samples in all cells.
"""
MAX_LIMITS = 16
"""Intervals of visible values, at most."""
GROUP = 1024
"""Bricks that a thread takes at a time."""


def limits_of(bricks: Bricks, task: Task) -> Single:
    """Intervals of the values that are visible: float32 (n, 2), ascending, without their ends."""
    slack = ROUNDING * max(abs(limit) for limit in bricks.value_range)
    intervals = [] if task.table is None else _opaque(task.table)
    intervals += [(surface.value - slack, surface.value + slack) for surface in task.surfaces]
    limits = np.array(_joined(intervals), dtype=np.float64).reshape(-1, 2)
    with np.errstate(over="ignore"):  # a surface beyond float32 lies at infinity, where no value is
        near = limits.astype(np.float32)
        # Outwards where float32 does not have them.
        below = np.where(
            near[:, 0] > limits[:, 0], np.nextafter(near[:, 0], np.float32(-np.inf)), near[:, 0]
        )
        above = np.where(
            near[:, 1] < limits[:, 1], np.nextafter(near[:, 1], np.float32(np.inf)), near[:, 1]
        )
    return np.stack([below, above], axis=-1)


def _opaque(table: Table) -> list[Interval]:
    """Intervals of the values to which a table gives an extinction."""
    last = len(table.extinctions) - 1
    entries = np.linspace(table.low, table.high, last + 1)
    changes = np.flatnonzero(
        np.diff(np.concatenate([[0], table.extinctions > 0, [0]]).astype(np.int8))
    )
    return [
        (entries[first - 1] if first else -np.inf, entries[stop] if stop <= last else np.inf)
        for first, stop in changes.reshape(-1, 2)
    ]


def _joined(intervals: list[Interval]) -> list[Interval]:
    """Intervals in ascending order, overlapping ones made one."""
    joined: list[Interval] = []
    for low, high in sorted(intervals):
        if joined and low <= joined[-1][1]:
            low, high = joined[-1][0], max(high, joined.pop()[1])
        joined.append((low, high))
    return joined


def cells_of(
    library: native.Library, bricks: Bricks, task: Task, distance: npt.NDArray[np.int32]
) -> npt.NDArray[np.uint32] | None:
    """A bit for each cell of each brick, set where the cell is visible.

    distance: of the bricks, as `Bricks.distance` has it; bricks of distance 0 are looked into.
    The result is uint32 (z, y, x, 2), the lower half first, or None where most cells are visible.
    """
    limits = limits_of(bricks, task)
    chosen = np.flatnonzero(distance == 0).astype(np.int64)
    if len(limits) > MAX_LIMITS or not len(chosen):
        return None
    cells = np.zeros((*distance.shape, 2), dtype=np.uint32)

    def look(numbers: Numbers, first: int, stop: int) -> int:
        """Set the bits of bricks by their numbers; how many bits are set."""
        return int(
            library.fhash_march_cells(
                *(pointer(bricks.values), bricks.values.shape, distance.shape),
                *(pointer(limits), len(limits), pointer(numbers), first, stop, pointer(cells)),
            )
        )

    probed = np.ascontiguousarray(chosen[:: -(-len(chosen) // PROBED)])
    if look(probed, 0, len(probed)) > MAX_SEEN * SIDE**3 * len(probed):
        return None
    spans = [(first, min(first + GROUP, len(chosen))) for first in range(0, len(chosen), GROUP)]
    list(in_threads(lambda span: look(chosen, *span), spans))
    return cells
