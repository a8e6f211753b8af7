"""Plan by prices: fhash_plan of libfhash (native/planner.cpp), and what its plan is checked by.

The planner sees some parts of a series and codes nothing. What prices do not know is measured on a
few coded parts: which coder takes how many bytes, and the error that a trellis and a bulk leave.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.attempt import (
    DECODING_NS,
    FAST_BYTES,
    MAX_WHOLE_VERTICES,
    PRICES,
    REGION_MS,
    TRANSFORM_NS,
    WORTH,
    Attempt,
    PlanTask,
    Tiling,
    decoding_ns,
    is_small,
    region_vertices,
    sub_tile,
    tiles_to_try,
)
from fhash_codec.compact.goal import EXCHANGE, SLOPE, Goal, with_step
from fhash_codec.compact.head import LEAST_GAIN, training_pairs
from fhash_codec.compact.head_training import foretold_gain
from fhash_codec.compact.sample import MAX_PRICED_EFFORT, Sample
from fhash_codec.compact.stages import (
    MAX_SEARCHED_VERTICES,
    SAMPLE_VERTICES,
    allows_trellis,
    mean_center,
    plateau_center,
    try_head,
    without_head,
)
from fhash_codec.compact.tiles import MIN_STEP_SHARE, Blocks, Coding, Index, Outcome, on_trellis
from fhash_codec.compact.tilings import tiles_of_large
from fhash_codec.compact.transform import (
    Bases,
    magnitudes_of,
    magnitudes_of_all,
    moved_transform,
    refit,
    squared_error,
)
from fhash_codec.progress import skip, stage, tell
from fhash_formats.support.values import Single
from fhash_formats.transform.spec import KINDS, AxisTransform, TransformSpec
from fhash_formats.transform.tile import call_with_context
from fhash_formats.transform.tile_format import Shape, TileSettings
from fhash_formats.transform.values import all_finite

PART_VERTICES = 1 << 16
"""Vertices of a part that is priced: smaller ones take longer for each vertex."""
PRICED_VERTICES = 1 << 18
"""Vertices of all parts of one kind: prices of twice as many chose the same within 0.5 %."""
OF_PLATEAU = 4
"""Vertices of parts beside a plateau, where they cost little, as a multiple of the usual ones.

Thin shells take all of the bytes, and small parts hold little of them (a shock took 1.3 times the
bytes).
"""
BLOCK_VERTICES = 5 << 19
"""Vertices of the block on which the price of cuts is checked."""
CODED_PART = 1 << 18
"""Vertices of a part that is coded."""
CODED_VERTICES = 1 << 19
"""Vertices of all parts that are coded: a single one foretold a wrong coder."""
LOOKS = 3
"""Times that parts are coded for the step at most."""
FARTHEST = 3.0
"""Factor by which the step changes at most from one look to the next."""
NEAR = 0.35
"""Change of the logarithm of the step, 2 dB, up to which no further look is needed."""
DOUBT = 0.075
"""Part of the allowed bytes of a tiling that no price may take: prices erred by as much."""
AIM = 0.02
"""dB above the promise that the step is for: all tiles are coded again where they fall short."""
LINES = 2048
"""Lines along an axis that its own basis is foretold by, some for each of its vertices."""


def sheet_of(shape: Shape, vertices: int) -> Shape:
    """Return a part of a box with all of y and x where they can be: t and z are shortened first."""
    t, z, y, x = shape
    while t * z * y * x > vertices and max(t, z) > 2:
        t, z = (max(2, t // 2), z) if t >= z else (t, max(2, z // 2))
    while t * z * y * x > vertices and max(y, x) > 8:
        y, x = (y // 2, x) if y >= x else (y, x // 2)
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


ROUNDING_ERROR = 12**-0.5
"""Root of the mean squared error of rounding to integers, in data units."""


def is_nearly_exact(task: PlanTask) -> bool:
    """Whether a PSNR leaves integers less error than rounding, so that exact ones may be smaller.

    Below the error of that rounding, hardly any step of the quantiser gives the PSNR: a little
    finer, and all values are exact.
    """
    return (
        task.goal.psnr is not None
        and task.blocks.dtype.kind in "iu"
        and task.goal.expected_error < ROUNDING_ERROR
    )


def is_priced(task: PlanTask, tiled: Blocks, settings: TileSettings) -> bool:
    """Whether a series is planned by prices.

    They know neither features nor a size yet, take more bytes under some bounds, and do not find
    the fewest bytes at any cost.
    """
    goal = task.goal
    return (
        1 < task.config.effort <= MAX_PRICED_EFFORT
        and task.config.access != "small"
        and goal.psnr is not None
        and goal.data_range > 0
        and tiled.in_memory
        and tiled.complete
        and not settings.double
        and not task.config.without
        and not is_nearly_exact(task)
    )


class _Parts(ctypes.Structure):
    """fhash_plan_parts (native/planner.hpp)."""

    _fields_ = (
        ("shape", ctypes.c_int64 * 4),
        ("count", ctypes.c_int64),
        ("values", ctypes.c_void_p),
        ("counted", ctypes.c_void_p),
        ("weights", ctypes.c_void_p),
    )


class _Task(ctypes.Structure):
    """fhash_plan_task (native/planner.hpp)."""

    _fields_ = (
        ("shape", ctypes.c_int64 * 4),
        ("columns", _Parts),
        ("sheets", _Parts),
        ("block", _Parts),
        ("lines", ctypes.c_void_p * 4),
        ("line_counts", ctypes.c_int64 * 4),
        ("tiles", ctypes.c_void_p),
        ("works", ctypes.c_void_p),
        ("tile_count", ctypes.c_int64),
        ("worth", ctypes.c_double),
        ("region_ns", ctypes.c_double),
        ("vertex_ns", ctypes.c_double),
        ("bit_ns", ctypes.c_double),
        ("most", ctypes.c_double),
        ("step", ctypes.c_double),
        ("mean_square", ctypes.c_double),
    )


class _Result(ctypes.Structure):
    """fhash_plan_result (native/planner.hpp)."""

    _fields_ = (
        ("tile", ctypes.c_int64 * 4),
        ("kinds", ctypes.c_int32 * 4),
        ("depths", ctypes.c_int32 * 4),
        ("step", ctypes.c_double),
        ("bytes", ctypes.c_double),
        ("price", ctypes.c_double),
        ("priced", ctypes.c_int64),
        ("tried", ctypes.c_int64),
    )


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


def _float32(values: npt.NDArray[Any], center: float) -> Single:
    """Return finite values about a centre."""
    about = np.ascontiguousarray(values, np.float32) - np.float32(center)
    if not all_finite(about):
        np.nan_to_num(about, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
    return about


def lines_along(values: npt.NDArray[Any], axis: int, center: float) -> Single:
    """Return lines along an axis of an array (t, z, y, x), spread evenly: (count, length)."""
    others = [length for number, length in enumerate(values.shape) if number != axis]
    count = prod(others)
    numbers = np.unique(np.linspace(0, count - 1, min(LINES, count)).astype(np.int64))
    places = np.unravel_index(numbers, others)
    return np.ascontiguousarray(_float32(np.moveaxis(values, axis, -1)[places], center))


class _Held:
    """Arrays that a native call reads, kept until it is over."""

    def __init__(self) -> None:
        self._arrays: list[npt.NDArray[Any]] = []

    def address(self, array: npt.NDArray[Any]) -> int:
        """Return the address of an array."""
        self._arrays.append(array)
        return array.ctypes.data

    def parts(self, sample: Sample, center: float) -> _Parts:
        """Return the tiles of a sample as parts of its series."""
        values = np.stack([_float32(tile.values, center) for tile in sample.tiles])
        counted = None
        if any(tile.counted is not None for tile in sample.tiles):
            masks = [
                np.ones(tile.values.shape, bool) if tile.counted is None else tile.counted
                for tile in sample.tiles
            ]
            counted = self.address(np.stack(masks).astype(np.uint8))
        weights = np.array(sample.weights, np.float64)
        weights *= prod(sample.blocks.shape) / (weights.sum() * prod(values.shape[1:]))
        shape = (ctypes.c_int64 * 4)(*values.shape[1:])
        return _Parts(shape, len(values), self.address(values), counted, self.address(weights))


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
    held = _Held()
    first, more = DECODING_NS["fast"]
    given = _Task(
        shape=(ctypes.c_int64 * 4)(*blocks.shape),
        columns=held.parts(columns, settings.center),
        tiles=held.address(np.array(tiles, np.int64)),
        works=held.address(np.array([region_vertices(blocks.shape, tile) for tile in tiles])),
        tile_count=len(tiles),
        worth=WORTH[config.access],
        region_ns=1e6 * REGION_MS[config.access],
        vertex_ns=TRANSFORM_NS + first,
        bit_ns=more,
        most=max(PRICES[config.access] - DOUBT, 1.0),
        step=settings.step,
        mean_square=goal.expected_error**2,
    )
    if sheets is not None:
        given.sheets = held.parts(sheets, settings.center)
    if block is not None:
        given.block = held.parts(block, settings.center)
    whole = blocks.values_in_memory
    for axis, length in enumerate(blocks.shape):
        if length > 1:
            lines = lines_along(whole, axis, settings.center)
            given.lines[axis], given.line_counts[axis] = held.address(lines), len(lines)
    found = _Result()
    call_with_context("fhash_plan", ctypes.byref(given), ctypes.byref(found))
    t, z, y, x = found.tile
    return Priced(
        tile=(t, z, y, x),
        axes=tuple(
            (KINDS[kind], depth) for kind, depth in zip(found.kinds, found.depths, strict=True)
        ),
        step=found.step,
        size=found.bytes,
        price=found.price,
        tried=found.tried,
    )


def plan_by_prices(task: PlanTask, settings: TileSettings) -> Attempt:
    """Return the plan of a series that `is_priced`, with the step that should keep the promise.

    settings: with a first guess of the step.
    """
    blocks, goal, config = task.blocks, task.goal, task.config
    task.parts.begin("tiles and transform")
    with stage("plan", "tiles, transform and step, by prices of some parts"):
        columns, larger = _parts(task, settings, column_of, 1), 1
        center = plateau_center(columns, task.value_range)
        if center is None:
            center = mean_center(columns, task.value_range)
        else:
            larger = OF_PLATEAU
            columns = _parts(task, settings, column_of, larger)
        sheets = None
        if columns.blocks.tile[2:] != blocks.shape[2:]:
            sheets = _parts(task, settings, sheet_of, larger)
        settings = replace(settings, center=center)
        tiles, block = _candidates(task), None
        if len(tiles) > 1:
            cut = blocks.retile(block_of(blocks.shape, BLOCK_VERTICES))
            costs = part_costs(task, cut, settings.step)
            block = Sample(cut, 1, task.workers, costs, task.parts.tick)
        found = priced_plan(task, settings, columns, sheets, block, tiles)
    tiling = None
    if task.fixed_tile is None:
        tiling = Tiling(tile=found.tile, price=found.price, tried=found.tried)
        tell("plan", f"--access {config.access}: {tiling.describe()}")
    tiled = blocks.retile(found.tile)
    sample = Sample(tiled, 1, task.workers)
    settings = with_step(settings, found.step, goal)
    with stage("bases", "the data's own bases, of all lines of the series"):
        settings = replace(settings, transform=found.transform(Bases(sample, settings)))
    coding = Coding(
        filled=True,
        density=0,
        bulk=goal.bulk,
        passes=2 if config.effort > 2 else 1,
        rounds=2,
        rough=True,
    )
    task.parts.begin("quantiser step")
    with stage("step", "coder and step, by coding some parts"):
        parts = coded_parts(task, tiled, settings.step)
        settings, coding, outcome, moved = _coded(task, settings, coding, tiled, parts, found.size)
        settings = refit(sample, settings)
    task.gains.note("transform by trial", outcome)
    attempt = Attempt(
        sample=sample,
        settings=settings,
        outcome=outcome,
        coding=coding,
        tiling=tiling,
        quick=True,
    )
    return with_head(task, attempt, parts, moved)


ROWS = 4
"""Distance in y of the rows that a part's cost is taken from."""


def part_costs(task: PlanTask, blocks: Blocks, step: float) -> list[float]:
    """Return the approximate bits of each tile, by the differences of neighbours along x."""

    def cost(index: Index) -> float:
        values = blocks.read(index).values[:, :, ::ROWS].astype(np.float32)
        with np.errstate(all="ignore"):
            bits = np.log2(1 + np.abs(np.diff(values, axis=3)) * np.float32(1 / step))
        return float(np.nansum(bits, dtype=np.float64))

    return list(task.workers.map(cost, blocks.indices()))


def _parts(
    task: PlanTask, settings: TileSettings, part_of: Callable[[Shape, int], Shape], larger: int
) -> Sample:
    """Return a sample of parts of a series by their costs; a small series is one part.

    larger: vertices of each part, and of all, as a multiple of the usual ones.
    """
    shape, vertices = task.blocks.shape, larger * PRICED_VERTICES
    one = prod(shape) <= vertices
    blocks = task.blocks.retile(shape if one else part_of(shape, larger * PART_VERTICES))
    costs = part_costs(task, blocks, settings.step)
    vertices = max(vertices, prod(blocks.tile))
    return Sample(blocks, vertices, task.workers, costs, task.parts.tick)


def _candidates(task: PlanTask) -> list[Shape]:
    """Return the tiles that a series may have."""
    shape = task.blocks.shape
    if task.fixed_tile is not None:
        return [task.fixed_tile]
    if is_small(shape) and task.config.access == "balanced":
        return [shape]
    if prod(shape) > MAX_WHOLE_VERTICES:
        return tiles_of_large(task.blocks)
    return tiles_to_try(shape, MAX_WHOLE_VERTICES, slabs=True)


def coded_parts(task: PlanTask, tiled: Blocks, step: float) -> Sample:
    """Return the parts of the tiles that are coded."""
    blocks = tiled.retile(sub_tile(tiled.tile, CODED_PART))
    costs = part_costs(task, blocks, step)
    return Sample(blocks, CODED_VERTICES, task.workers, costs, task.parts.tick)


def _coded(
    task: PlanTask,
    settings: TileSettings,
    coding: Coding,
    tiled: Blocks,
    parts: Sample,
    size: float,
) -> tuple[TileSettings, Coding, Outcome, TileSettings]:
    """Return settings and coding of the better coder at the step that should keep the promise.

    Beside them are what is expected of all tiles, and the settings of the parts.

    settings: of the plain quantiser.
    parts: coded for the choice.
    size: bytes of all tiles by price.
    """
    goal = task.goal
    if allows_trellis(settings, goal, task.config.effort):
        settings, coding = on_trellis(settings, coding)
    moved = moved_transform(parts, settings)
    outcome = parts.run(moved, coding)
    if task.is_slow(tiled.tile, size):
        faster = replace(coding, fast=True)
        other = parts.run(moved, faster)
        ratio = _at_promise(other, goal) / max(_at_promise(outcome, goal), 1.0)
        most = most_by_fast_coder(8 * size / prod(task.blocks.shape), task.config.access)
        tell("step", f"the fast coder takes {ratio:.3f} times the bytes, {most:.3f} are allowed")
        if ratio <= most:
            coding, outcome = faster, other
    assert goal.psnr is not None
    for _ in range(LOOKS):
        step = _step(task, settings, moved, tiled, parts, outcome)
        change = min(max(step / settings.step, 1 / FARTHEST), FARTHEST)
        if abs(math.log(change)) < NEAR:
            break
        # So far from where it was measured, coefficients foretell the error badly.
        settings = with_step(settings, change * settings.step, goal)
        moved = moved_transform(parts, replace(moved, step=settings.step, double=settings.double))
        outcome = parts.run(moved, coding)
    else:
        step = _step(task, settings, moved, tiled, parts, outcome)
    octaves = SLOPE * math.log(step / settings.step) / EXCHANGE
    vertices = prod(tiled.shape)
    expected = Outcome(
        size=round(outcome.size * 2**-octaves),
        squares=squared_error(vertices, goal.psnr, goal.data_range),
        count=vertices,
        max_error=outcome.max_error,
    )
    return with_step(settings, step, goal), coding, expected, moved


def _at_promise(outcome: Outcome, goal: Goal) -> float:
    """Return the bytes at a promised PSNR, by the usual exchange rate of dB for bytes."""
    assert goal.psnr is not None
    missing = goal.psnr - outcome.psnr(goal.data_range)
    return float(outcome.size * 2 ** (missing / EXCHANGE))


PEER_NS = (44.0, 58.0)
"""Nanoseconds in which a vertex may be decoded, and more for each of its bits: twice SPERR's."""


def most_by_fast_coder(bits: float, access: str) -> float:
    """Return the bytes that the fast coder may take, as a multiple of those of the other one.

    They grow from 1 on with the time by which the other one is slower than is wished for.

    bits: of a vertex.
    """
    most = FAST_BYTES[access]
    if most < 1 or access != "balanced":
        return most
    late = decoding_ns(bits, "mixing") / (PEER_NS[0] + PEER_NS[1] * bits)
    return min(max(1 + 2 * (most - 1) * (late - 1), 1.0), most)


def _step(
    task: PlanTask,
    settings: TileSettings,
    moved: TileSettings,
    tiled: Blocks,
    parts: Sample,
    outcome: Outcome,
) -> float:
    """Return the step at which all tiles should have the promised error, by their coefficients.

    What coefficients foretell is corrected by the true error of coded parts.

    moved: settings of these parts.
    outcome: of the parts.
    """
    goal = task.goal
    assert goal.psnr is not None
    series = magnitudes_of_all(tiled, settings, task.workers)
    few = [magnitudes_of(tile.values, moved) for tile in parts.tiles]
    foretold = sum(
        weight * one.error(settings.step) for weight, one in zip(parts.weights, few, strict=True)
    )
    least = goal.data_range * MIN_STEP_SHARE
    if not (foretold > 0 and outcome.squares > 0):
        even = squared_error(prod(tiled.shape), goal.even_psnr or goal.psnr, goal.data_range)
        return series.step(even, least)
    error = squared_error(prod(tiled.shape), goal.psnr + AIM, goal.data_range)
    step = series.step(error * foretold / outcome.squares, least)
    if outcome.bulk_squares == 0:
        return step
    error *= outcome.bulk_count / max(outcome.count, 1)
    return min(step, series.step(error * foretold / outcome.bulk_squares, least))


def with_head(task: PlanTask, attempt: Attempt, parts: Sample, moved: TileSettings) -> Attempt:
    """Return the plan with a head where coded parts foretell that one pays.

    parts: some parts of the tiles.
    moved: their settings.
    """
    if reason := without_head(task, attempt):
        skip("head", reason)
        return attempt
    with stage("head trial", "gain of least squares on some parts"):
        pairs = training_pairs(parts, moved, attempt.coding)
        low, high = attempt.settings.low, attempt.settings.high
        gain = foretold_gain(pairs, low, high, task.config.seed)
    if gain < LEAST_GAIN:
        skip("head", f"least squares gain {gain:.2f} dB on some parts: none would save enough")
        return attempt
    task.parts.begin("head")
    return try_head(task, on_all_tiles(task, attempt))


def on_all_tiles(task: PlanTask, attempt: Attempt) -> Attempt:
    """Return an attempt whose outcome is that of all tiles, or of many where a series is large."""
    if attempt.tried:
        return attempt
    vertices = prod(task.blocks.shape)
    most = MAX_SEARCHED_VERTICES if vertices <= MAX_SEARCHED_VERTICES else SAMPLE_VERTICES
    blocks = attempt.sample.blocks
    costs = part_costs(task, blocks, attempt.settings.step)
    sample = Sample(blocks, most, task.workers, costs, task.parts.tick)
    outcome = sample.run(attempt.settings, attempt.coding)
    return replace(attempt, sample=sample, outcome=outcome, tried=[outcome])
