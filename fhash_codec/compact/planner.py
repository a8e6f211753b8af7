"""Plan by prices: fhash_plan of libfhash (native/planner.cpp), and what its plan is checked by.

The planner sees some parts of a series and codes nothing. What prices do not know is measured on a
few coded parts: which coder takes how many bytes, and the error that a trellis and a bulk leave.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.attempt import (
    DECODING_NS,
    MAX_WHOLE_VERTICES,
    PRICES,
    REGION_MS,
    TRANSFORM_NS,
    WORTH,
    PlanTask,
    first_tile,
    is_small,
    quick_tile,
    region_vertices,
    tiles_of_large,
    tiles_to_try,
)
from fhash_codec.compact.goal import with_step
from fhash_codec.compact.sample import Sample
from fhash_codec.compact.tiles import Blocks
from fhash_codec.compact.transform import (
    Bases,
    about_center,
    moved_transform,
    scale_of,
    usual_transform,
)
from fhash_codec.measure.value_range import Mean, ValueRange, mean_of
from fhash_codec.progress import stage
from fhash_formats.native import ffi, pointer
from fhash_formats.support.values import Single
from fhash_formats.transform.spec import KINDS, AxisTransform, TransformSpec
from fhash_formats.transform.tile import call
from fhash_formats.transform.tile_format import Shape, TileSettings
from fhash_formats.transform.values import all_finite

PART_VERTICES = 1 << 16
"""Vertices of a part that is priced: smaller ones take longer for each vertex."""
PRICED_VERTICES = 1 << 18
"""Vertices of all parts of one kind: prices of twice as many chose the same within 0.5 %."""
QUICK_SHARE = 0.25
"""Share of all these vertices that effort 1 prices."""
OF_PLATEAU = 4
"""Vertices of parts beside a plateau, where they cost little, as a multiple of the usual ones.

Thin shells take all of the bytes, and small parts hold little of them (a shock took 1.3 times the
bytes).
"""
BLOCK_VERTICES = 5 << 19
"""Vertices of the block on which the price of cuts is checked."""
DOUBT = 0.075
"""Part of the allowed bytes of a tiling that no price may take: prices erred by as much."""
LINES = 2048
"""Lines along an axis that its own basis is foretold by, some for each of its vertices."""


BINS = 4096
"""Intervals of the value range among which the fullest is looked for."""
PLATEAU = 0.03
"""Share of the values in the fullest interval from which on it is a plateau.

Series without one had 0.011 at most (wind, still over land), where either centre gave the same
bytes within 0.1 %; counts over a background had 0.07 and took 15 % fewer bytes by it.
"""
MAX_CENTER = 3e38
"""Largest magnitude of a centre that is rounded to float32."""


def mean_center(sample: Sample, value_range: ValueRange) -> float:
    """Return the mean of a series as the centre, in data units; without values the middle.

    Of one that is not in memory it is the mean of a sample. That of some parts of a short series
    cost up to 2 % of the bytes.
    """
    if not sample.counted:
        return _rounded_center(value_range.low + (value_range.high - value_range.low) / 2)
    if sample.blocks.in_memory:
        mean = Mean()
        for values in sample.blocks.counted_values():
            mean.add(values if all_finite(values) else values[np.isfinite(values)])
        if mean.count:
            return _rounded_center(mean.value())
    means = [mean_of(tile.counted_values) for tile in sample.tiles]
    return _rounded_center(float(np.average(means, weights=sample.weights)))


def plateau_center(sample: Sample, value_range: ValueRange) -> float | None:
    """Return the plateau of a series as the centre, in data units; None without one.

    About a plateau all coefficients are 0 where nothing happens; about the mean they are not.
    """
    low, high = value_range.low, value_range.high
    if not (low < high and math.isfinite(high - low)):
        return None
    counted = (tile.counted_values for tile in sample.tiles)
    numbers = [values[np.isfinite(values)].astype(np.float64) for values in counted]
    edges = np.linspace(low, high, BINS + 1)
    counts = np.zeros(BINS)
    for values, weight in zip(numbers, sample.weights, strict=True):
        counts += weight * np.histogram(values, edges)[0]
    fullest = int(np.argmax(counts))
    if counts[fullest] < PLATEAU * counts.sum() or not counts[fullest]:
        return None
    values = np.concatenate(numbers)
    inside = (values >= edges[fullest]) & (values <= edges[fullest + 1])
    return _rounded_center(float(np.median(values[inside])))


def _rounded_center(center: float) -> float:
    """Return a centre as float32 holds it, where it can."""
    return float(np.float32(center)) if abs(center) < MAX_CENTER else center


def sheet_of(shape: Shape, vertices: int) -> Shape:
    """Return a part of a box with all of y and x where they can be: t and z are shortened first."""
    t, z, y, x = shape
    while t * z * y * x > vertices and max(t, z) > 2:
        t, z = ((t + 1) // 2, z) if t >= z else (t, (z + 1) // 2)
    while t * z * y * x > vertices and max(y, x) > 8:
        y, x = ((y + 1) // 2, x) if y >= x else (y, (x + 1) // 2)
    return t, z, y, x


COLUMNS = ((8, 64), (8, 32), (4, 32), (4, 16), (2, 16))
"""Vertices along y and x to which columns are shortened, one after the other.

A coder takes up to three times as long for each value of shorter rows.
"""


def column_of(shape: Shape, vertices: int) -> Shape:
    """Return a part of a box with all of t and z where they can be: y and x are shortened first."""
    t, z, y, x = shape
    for least_y, least_x in COLUMNS:
        while t * z * y * x > vertices and (y > least_y or x > least_x):
            if y > least_y and (y >= x or x <= least_x):
                y = max(least_y, (y + 1) // 2)
            else:
                x = max(least_x, (x + 1) // 2)
    while t * z * y * x > 2 * vertices and max(t, z) > 8:
        t, z = ((t + 1) // 2, z) if t >= z else (t, (z + 1) // 2)
    return t, z, y, x


def block_of(shape: Shape, vertices: int) -> Shape:
    """Return a part of a box that is as long as may be along all axes: the longest are halved."""
    lengths = list(shape)
    while prod(lengths) > vertices:
        axis = max(range(4), key=lambda number: (lengths[number], number))
        lengths[axis] = (lengths[axis] + 1) // 2
    t, z, y, x = lengths
    return t, z, y, x


@dataclass(frozen=True, kw_only=True)
class Priced:
    """Plan of the native planner.

    Attributes:
        tile: shape of the tiles.
        axes: kind and levels of the transform along each axis; a basis is not fitted yet.
        step: of the plain quantiser, in data units.
        size: bytes of all tiles, by price.
        price: bytes of the tiling, as a multiple of the fewest.
        tried: number of tilings that were priced.
    """

    tile: Shape
    axes: tuple[tuple[str, int], ...]
    step: float
    size: float
    price: float
    tried: int

    def transform(self, bases: Bases) -> TransformSpec:
        """Return the transform, with bases of the data's own where it has some."""
        t, z, y, x = (
            bases.along(axis) if kind == "klt" else AxisTransform(kind=kind, depth=depth)
            for axis, (kind, depth) in enumerate(self.axes)
        )
        return TransformSpec(axes=(t, z, y, x))


def lines_along(values: npt.NDArray[Any], axis: int, settings: TileSettings) -> Single:
    """Return lines along an axis of an array (t, z, y, x), spread evenly: (count, length)."""
    others = [length for number, length in enumerate(values.shape) if number != axis]
    count = prod(others)
    numbers = np.unique(np.linspace(0, count - 1, min(LINES, count)).astype(np.int64))
    places = np.unravel_index(numbers, others)
    return np.ascontiguousarray(about_center(np.moveaxis(values, axis, -1)[places], settings))


class _Held:
    """Arrays that a native call reads, kept until it is over."""

    def __init__(self) -> None:
        self._arrays: list[npt.NDArray[Any]] = []

    def pointer(self, array: npt.NDArray[Any] | None) -> Any:
        """Return a pointer to the numbers of an array; NULL for None."""
        if array is not None:
            self._arrays.append(array)
        return pointer(array)

    def parts(self, sample: Sample, settings: TileSettings, vertices: int) -> tuple[Any, ...]:
        """Return the tiles of a sample as `fhash_plan_parts` of a series of so many vertices."""
        values = np.stack([about_center(tile.values, settings) for tile in sample.tiles])
        counted = None
        if any(tile.counted is not None for tile in sample.tiles):
            masks = [
                np.ones(tile.values.shape, bool) if tile.counted is None else tile.counted
                for tile in sample.tiles
            ]
            counted = np.stack(masks).astype(np.uint8)
        # Parts where no vertex counts are not in the sample, and stand for no bytes.
        weights = np.array(sample.weights, np.float64) * (vertices / prod(values.shape[1:]))
        weights /= (
            prod(sample.blocks.grid) / len(sample.blocks.weights) * sum(sample.blocks.weights)
        )
        return values.shape[1:], len(values), *map(self.pointer, (values, counted, weights))


def priced_plan(
    task: PlanTask,
    settings: TileSettings,
    columns: Sample,
    sheets: Sample | None,
    block: Sample | None,
    tiles: Sequence[Shape],
) -> Priced:
    """Return what the planner finds.

    settings: centre, and the step to begin with.
    columns, sheets: parts, see `column_of` and `sheet_of`; None where columns are sheets, too.
    block: one part, see `block_of`; None where there is nothing to choose.
    tiles: candidates.
    """
    config, goal, blocks = task.config, task.goal, task.blocks
    held, scale = _Held(), scale_of(settings)
    first, more = DECODING_NS["fast"]
    fields = dict(
        shape=blocks.shape,
        columns=held.parts(columns, settings, prod(blocks.shape)),
        tiles=held.pointer(np.array(tiles, np.int64)),
        works=held.pointer(np.array([region_vertices(blocks.shape, tile) for tile in tiles])),
        tile_count=len(tiles),
        worth=WORTH[config.access],
        region_ns=1e6 * REGION_MS[config.access],
        vertex_ns=TRANSFORM_NS + first,
        bit_ns=more,
        most=max(PRICES[config.access] - DOUBT, 1.0),
        step=settings.step * scale,
        mean_square=(goal.expected_error * scale) ** 2 if goal.psnr is not None else 0.0,
        size=0.0 if goal.size is None else max(goal.size - goal.overhead, 1.0),
    )
    given = ffi.new("fhash_plan_task *", fields)
    if sheets is not None:
        given.sheets = held.parts(sheets, settings, prod(blocks.shape))
    if block is not None:
        given.block = held.parts(block, settings, prod(blocks.shape))
    for axis, length in enumerate(blocks.shape):
        if blocks.in_memory and length > 1:
            whole = blocks.values_in_memory
            lines = lines_along(whole, axis, settings)
            given.lines[axis], given.line_counts[axis] = held.pointer(lines), len(lines)
    found = ffi.new("fhash_plan_result *")
    call("fhash_plan", given, found)
    t, z, y, x = found.tile
    return Priced(
        tile=(t, z, y, x),
        axes=tuple(
            (KINDS[kind], depth) for kind, depth in zip(found.kinds, found.depths, strict=True)
        ),
        step=found.step / scale,
        size=found.bytes,
        price=found.price,
        tried=found.tried,
    )


def by_prices(
    task: PlanTask, view: Blocks, settings: TileSettings, density: int
) -> tuple[Blocks, TileSettings, Priced]:
    """Return tiles, settings with centre, transform and step, and the plan that they are of."""
    columns, larger = _parts(task, view, settings, column_of, 1), 1
    center = plateau_center(columns, task.value_range)
    if center is None:
        center = mean_center(columns, task.value_range)
    else:
        larger = OF_PLATEAU
        columns = _parts(task, view, settings, column_of, larger)
    settings = replace(settings, center=center)
    sheets, tiles, block = None, _candidates(task), None
    if columns.blocks.tile[2:] != view.shape[2:]:
        sheets = _parts(task, view, settings, sheet_of, larger)
    if len(tiles) > 1:
        cut = view.retile(block_of(view.shape, BLOCK_VERTICES))
        costs = part_costs(task, cut, settings)
        block = Sample(cut, 1, task.workers, costs, task.parts.tick)

    def filled(sample: Sample | None) -> Sample | None:
        if sample is None or not density:
            return sample
        return sample.filled(moved_transform(sample, settings), 1)

    columns_filled = filled(columns)
    assert columns_filled is not None
    found = priced_plan(task, settings, columns_filled, filled(sheets), filled(block), tiles)
    settings, tiled = with_step(settings, found.step, task.goal), view.retile(found.tile)
    if not task.asks("transform"):
        return tiled, replace(settings, transform=usual_transform(found.tile)), found
    with stage("bases", "the data's own bases, of all lines of the series"):
        sample = Sample(tiled, 1, task.workers)
        settings = replace(settings, transform=found.transform(Bases(sample, settings)))
    return tiled, settings, found


WINDOWS = 2
"""Boxes of a series larger than memory that stand for it."""
WINDOW_VERTICES = 8 << 20
"""Vertices of each of them at most."""
LEAST_EDGE = 64
"""Vertices along an axis in space up to which these are shortened before steps are left out."""


def in_part(blocks: Blocks) -> Blocks:
    """Return a series that is in memory, or boxes of it that are."""
    if blocks.in_memory:
        return blocks
    t, z, y, x = blocks.shape
    while t * z * y * x > WINDOW_VERTICES and max(z, y, x) > LEAST_EDGE:
        # What many steps have in common is worth more than what a wide space has.
        z, y, x = (min(n, max((max(z, y, x) + 1) // 2, LEAST_EDGE)) for n in (z, y, x))
    shape = block_of((t, z, y, x), WINDOW_VERTICES)
    free = [length - n for length, n in zip(blocks.shape, shape, strict=True)]
    places = []
    for number in range(WINDOWS):
        t, z, y, x = (((2 * number + 1) * n) // (2 * WINDOWS) for n in free)
        places.append((t, z, y, x))
    return blocks.boxes(shape, places, [1] * WINDOWS)


ROWS = 4
"""Distance in y of the rows that a part's cost is taken from."""
COSTED = 1 << 16
"""Differences that are worked on at a time, so that they stay in the cache of a core."""


def part_costs(task: PlanTask, blocks: Blocks, settings: TileSettings) -> list[float] | None:
    """Return the approximate bits of each tile, by the differences of neighbours along x.

    Tiles where no vertex counts have none. None for a series that is not in memory.
    """
    if not blocks.in_memory:
        return None
    with np.errstate(over="ignore"):
        per_step = np.float32(1 / (settings.step * scale_of(settings)))
    y, x = blocks.tile[2:]
    apart = min(ROWS, y)

    def costs(layer: int) -> npt.NDArray[np.float64]:
        frames = blocks.layer(layer)
        rows = frames.values[:, :, ::apart]
        total = np.zeros(rows.shape[1:], np.float32)
        count = max(COSTED // prod(rows.shape[1:]), 1)
        for first in range(0, len(rows), count):
            values = about_center(rows[first : first + count], settings)
            with np.errstate(all="ignore"):
                steps = np.diff(values, axis=3, append=values[..., -1:])
                bits = np.log2(1 + np.abs(steps) * per_step)
            total += np.nan_to_num(bits, copy=False, posinf=0).sum(axis=0)
        total += (blocks.tile[0] - len(rows)) * bits[-1]  # repeated beyond the end
        total[:, :, x - 1 :: x] = 0  # from one tile to the next
        sums = _of_tiles(np.add, total.astype(np.float64), blocks, apart)
        if frames.counted is None:
            return sums
        counts = np.logical_or.reduce(frames.counted, axis=0)
        return np.where(_of_tiles(np.logical_or, counts, blocks, 1), sums, 0.0)

    found: list[float] = np.ravel(list(task.workers.map(costs, range(blocks.grid[0])))).tolist()
    return found


def _of_tiles(
    ufunc: np.ufunc, values: npt.NDArray[Any], blocks: Blocks, apart: int
) -> npt.NDArray[Any]:
    """Return values (z, y, x) of rows that lie so far apart in y, reduced over each tile."""
    for axis, stride in enumerate((1, apart, 1)):
        starts = -(-blocks.tile[1 + axis] * np.arange(blocks.grid[1 + axis]) // stride)
        values = ufunc.reduceat(values, np.minimum(starts, values.shape[axis] - 1), axis=axis)
    return values


def _parts(
    task: PlanTask,
    view: Blocks,
    settings: TileSettings,
    part_of: Callable[[Shape, int], Shape],
    larger: float,
) -> Sample:
    """Return a sample of parts of a series by their costs; a small series is one part.

    larger: vertices of each part, and of all, as a multiple of the usual ones.
    """
    larger = larger if task.config.effort > 1 else larger * QUICK_SHARE
    shape, vertices = view.shape, round(larger * PRICED_VERTICES)
    one = prod(shape) <= vertices
    blocks = view.retile(shape if one else part_of(shape, round(larger * PART_VERTICES)))
    costs = part_costs(task, blocks, settings)
    vertices = max(vertices, prod(blocks.tile))
    return Sample(blocks, vertices, task.workers, costs, task.parts.tick)


def _candidates(task: PlanTask) -> list[Shape]:
    """Return the tiles that a series may have."""
    shape = task.blocks.shape
    if task.fixed_tile is not None:
        return [task.fixed_tile]
    if not task.asks("tiles"):
        return [first_tile(shape)]
    if task.config.effort == 1:
        return [quick_tile(shape, task.config.access)]
    if is_small(shape) and task.config.access == "balanced":
        return [shape]
    if prod(shape) > MAX_WHOLE_VERTICES:
        return tiles_of_large(task.blocks)
    return tiles_to_try(shape, MAX_WHOLE_VERTICES, slabs=True)
