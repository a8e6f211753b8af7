"""Marching in packets of rays by the native library (fhash_codec/native/march.cpp).

A central difference is half of the difference between the values one vertex of the frame behind and
before, clamped to the frame. Where one of the two is missing, the gradient of the cell along that
axis takes its place. The normal buffer always has the gradient of the cell.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from itertools import count, product

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.native.cells import cells_of
from fhash_codec.rendering.native.frame_task import MarchInput, empty_table
from fhash_codec.rendering.native.structure import (
    ATTENUATED,
    AVERAGE,
    GRADED,
    LIT,
    MAX_PLANES,
    MAX_SURFACES,
    MAXIMUM,
    MINIMUM,
    POWERS,
    SHADED,
    TILE,
    March,
    box,
    numbers,
    plane,
    surface,
)
from fhash_codec.rendering.task.bricks import SIDE, Bricks, smoothed
from fhash_codec.rendering.task.task import (
    GRADES,
    MAX_VALUES,
    Frame,
    Lighting,
    Marched,
    Table,
    Task,
    complete,
    extinctions_in,
)
from fhash_formats.support.threads import in_threads, usable_threads

__all__ = ["MAX_SURFACES", "march_native"]

Single = npt.NDArray[np.float32]

ENTRIES = 4000
"""Entries of a table of a step, at least. So close together, opacity is linear between them as
extinction is.
"""
GROUP = 8
"""Tiles that a thread takes at a time."""
MIN_SKIPPED = 0.4
"""Smallest share of invisible bricks for which leaping over them pays; below it the test costs more
than it saves.
"""
SHARPEST = 16
"""Exponent of highlights above which their table is stretched over the cosines next to 1."""
PROJECTIONS = {
    "maximum": MAXIMUM,
    "minimum": MAXIMUM | MINIMUM,
    "average": AVERAGE,
    "attenuated": ATTENUATED,
}
"""Flags of the values that rays show instead of the volume."""
COUNTED = ("rays", "passes", "samples", "gradients", "skipped_bricks")
"""Names of the counters of `fhash_march`, in its order."""


def march_native(
    library: ctypes.CDLL,
    frame: Frame,
    task: Task,
    bricks: Bricks,
    threads: int | None = None,
    *,
    path: int = 0,
) -> Marched:
    """The picture of a task, as `march` describes it.

    path: instructions of the processor that may be used: 0 all, 1 at most AVX2, 2 only those that
    every processor has. The pictures agree within rounding.
    """
    assert frame.values.size <= MAX_VALUES, "a plan has no larger frame"
    task = task.marched
    given = MarchInput.of(frame, task, bricks)
    buffers = _Buffers.of(task)
    skipping = _skipping(library, given, task, bricks)
    structure = March(
        values=given.values,
        shape=given.values.shape,
        bricks=bricks.low.shape,
        distance=skipping.distance,
        cells=skipping.cells,
        highest=skipping.highest,
        **_table_fields(given, task),
        **_light_fields(given, task),
        **_ray_fields(given, task),
        **_lighting_fields(task.lighting),
        gradient=numbers(given.gradient),
        floor=given.floor,
        smooth=_smooth(given, task, bricks),
        **_grading_fields(given, task),
        planes=len(given.planes),
        plane=(ctypes.c_double * 4 * MAX_PLANES)(*map(plane, given.planes)),
        surfaces=0 if task.projection else len(task.surfaces),
        surface=_surfaces(given, task),
        out=buffers.rgba,
        depth=buffers.depth,
        normal=buffers.normal,
        path=path,
    )
    counters = _march(library, structure, task, threads)
    return Marched(
        rgba=buffers.rgba,
        depth=buffers.depth if task.depth else None,
        normal=buffers.normal,
        counters=counters,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Buffers:
    """The pictures that rays are added to: rgba (H, W, 4), depth (H, W) and normal (H, W, 3).

    Normals need the depth, to keep that of the nearest of several rays.
    """

    rgba: Single
    depth: Single | None
    normal: Single | None

    @classmethod
    def of(cls, task: Task) -> _Buffers:
        width, height = task.rays.size
        return cls(
            rgba=np.zeros((height, width, 4), dtype=np.float32),
            depth=np.full((height, width), np.inf, dtype=np.float32)
            if task.depth or task.normal
            else None,
            normal=np.zeros((height, width, 3), dtype=np.float32) if task.normal else None,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Skipping:
    """Bricks and cells that rays may pass over; None where all of a frame is looked at.

    Attributes:
        distance: int32 (z, y, x), as `Bricks.distance` has it.
        cells: uint32 (z, y, x, 2), as `cells_of` has it.
        highest: float32 (z, y, x) of bricks, the largest value, for the maximum along a ray, or the
            smallest times -1 for the minimum.
    """

    distance: npt.NDArray[np.int32] | None = None
    cells: npt.NDArray[np.uint32] | None = None
    highest: Single | None = None


def _skipping(library: ctypes.CDLL, given: MarchInput, task: Task, bricks: Bricks) -> _Skipping:
    """The parts of a frame that a task's rays may pass over."""
    if not task.skipping:
        return _Skipping()
    if task.projection in ("maximum", "minimum"):
        # Scaled values have other extremes than the bricks.
        if given.values is not bricks.values:
            return _Skipping()
        return _Skipping(highest=bricks.high if task.projection == "maximum" else -bricks.low)
    shortest = float(np.abs(given.spacing).min())
    # A step longer than a brick could pass through one in which a surface lies, on its way from one
    # in which nothing is visible to another.
    if task.surfaces and task.step / shortest > SIDE:
        return _Skipping()
    distance = bricks.distance(task)
    # For the same reason no step may be longer than a cell. Rounding of places to float32 counts.
    by_cells = not (task.surfaces and task.step > 0.99 * shortest)
    cells = (
        bricks.remembered(
            "cells", task.visibility, lambda: cells_of(library, bricks, task, distance)
        )
        if by_cells
        else None
    )
    if cells is None and np.count_nonzero(distance) < MIN_SKIPPED * distance.size:
        return _Skipping()
    return _Skipping(distance=distance, cells=cells)


def _table_fields(given: MarchInput, task: Task) -> dict[str, object]:
    """The fields of the transfer function."""
    entries, extinctions = _entries(task.table or empty_table(given.low, given.high), task.step)
    return {
        "table": entries,
        "extinction": extinctions,
        "entries": len(entries) - 1,
        "low": given.low,
        "scale": (len(entries) - 2) / (given.high - given.low),
    }


def _entries(table: Table, step: float) -> tuple[Single, npt.NDArray[np.float64]]:
    """Colours and opacities (n + 1, 4) and extinctions (n + 1,) of a step; the last entry twice."""
    last = len(table.extinctions) - 1
    places = np.append(np.linspace(0, last, last * -(-ENTRIES // last) + 1), last)
    columns = [np.interp(places, np.arange(last + 1), column) for column in table.colours.T]
    extinctions = extinctions_in(np.interp(places, np.arange(last + 1), table.extinctions), step)
    return np.stack([*columns, -np.expm1(-extinctions)], axis=-1).astype(np.float32), extinctions


def _light_fields(given: MarchInput, task: Task) -> dict[str, object]:
    """The fields of the light grid."""
    light = task.light
    shares = None if light is None else np.ascontiguousarray(light.shares, dtype=np.float32)
    return {
        "light": shares,
        "light_shape": (0, 0, 0) if shares is None else shares.shape[:3],
        "light_offset": numbers(given.light_offset),
        "light_scale": given.light_scale,
    }


def _ray_fields(given: MarchInput, task: Task) -> dict[str, object]:
    """The fields of the rays and their steps."""
    width, height = task.rays.size
    return {
        "eye": numbers(given.eye),
        "right": numbers(given.right),
        "up": numbers(given.up),
        "forward": numbers(given.forward),
        "box": box(given.box),
        "seen": box(given.seen),
        "spacing": numbers(given.spacing),
        "width": width,
        "height": height,
        "parallel": task.rays.parallel,
        "rays": task.antialiasing,
        "step": task.step,
        "threshold": task.threshold,
        "jitter": task.jitter,
    }


def _smooth(given: MarchInput, task: Task, bricks: Bricks) -> Single | None:
    """The smoothed values that what is lit is shaded by; None where those of the frame do."""
    if not given.smoothing or not (task.shaded or task.surfaces):
        return None
    if given.values is not bricks.values:  # scaled for this task alone
        return smoothed(given.values, given.smoothing, given.error)
    return bricks.smoothed(given.smoothing, given.error)


def _grading_fields(given: MarchInput, task: Task) -> dict[str, object]:
    """The fields of the opacity by gradient."""
    grading = task.grading
    if grading is None:
        return {"grading": None, "grade_scale": 0.0, "unlit": 0}
    factors = np.append(grading.factors, grading.factors[-1]).astype(np.float32)
    return {
        "grading": factors,
        "grade_scale": GRADES * given.steepness / grading.top,
        "unlit": not task.shaded,
    }


def _lighting_fields(lighting: Lighting | None) -> dict[str, object]:
    """The fields of Phong's model; without one only ambient light of strength 1."""
    if lighting is None:
        lighting = Lighting(ambient=1.0, diffuse=0.0, specular=0.0, specular_power=1.0, lamp=None)
    steep = max(1.0, lighting.specular_power / SHARPEST)
    cosines = np.maximum(1 - np.arange(POWERS + 2) / (POWERS * steep), 0.0)
    return {
        "lamp": numbers((0.0, 0.0, 0.0) if lighting.lamp is None else lighting.lamp),
        "ambient": lighting.ambient,
        "diffuse": lighting.diffuse,
        "specular": lighting.specular,
        "steep": steep,
        "powers": (cosines**lighting.specular_power).astype(np.float32),
        "central": lighting.central,
    }


def _surfaces(given: MarchInput, task: Task) -> ctypes.Array[ctypes.Array[ctypes.c_double]]:
    surfaces = zip(given.levels, task.surfaces, strict=True)
    rows = (surface(level, each.colour, each.opacity) for level, each in surfaces)
    return (ctypes.c_double * 5 * MAX_SURFACES)(*rows)


def _march(
    library: ctypes.CDLL, structure: March, task: Task, threads: int | None
) -> dict[str, int]:
    """March all rays in several threads, into the buffers of a structure; the counters."""
    flags = SHADED * task.shaded | LIT * (task.light is not None)
    if task.grading is not None:
        flags |= SHADED | GRADED
    if task.projection:
        flags = PROJECTIONS[task.projection]
    spans = _spans(task)
    groups = count()

    def work(_: int) -> npt.NDArray[np.int64]:
        counters = np.zeros(len(COUNTED), dtype=np.int64)
        while (group := next(groups)) < len(spans):
            first, stop = spans[group]
            failed = library.fhash_march(
                ctypes.byref(structure), flags, first, stop, counters.ctypes.data
            )
            assert not failed
        return counters

    workers = max(1, min(threads or usable_threads(), len(spans)))
    if workers == 1:
        total = work(0)
    else:
        total = sum(in_threads(work, range(workers)), np.zeros(len(COUNTED), dtype=np.int64))
    return complete(dict(zip(COUNTED, total.tolist(), strict=True)))


def _spans(task: Task) -> list[tuple[int, int]]:
    """Tiles (first, stop) in rows of the picture, in the rectangle around the drawn box.

    All other rays miss the box.
    """
    width, height = task.rays.size
    across, down = -(-width // TILE), -(-height // TILE)
    with np.errstate(all="ignore"):
        pixels, depth = task.rays.project(np.array(list(product(*task.bounds))))
    left, top, right, bottom = 0, 0, across, down
    if np.isfinite(pixels).all() and (task.rays.parallel or np.all(depth > 1e-6 * depth.max())):
        # Rounding is far below a pixel.
        left, top = _tiles(np.floor((pixels.min(axis=0) - 1) / TILE), (across, down))
        right, bottom = _tiles(np.ceil((pixels.max(axis=0) + 1) / TILE), (across, down))
    rows = (range(row * across + left, row * across + right, GROUP) for row in range(top, bottom))
    return [(first, min(first + GROUP, row.stop)) for row in rows for first in row]


def _tiles(ends: npt.NDArray[np.float64], limits: tuple[int, int]) -> tuple[int, int]:
    """Numbers of tiles (x, y), clipped to 0..limits."""
    x, y = (int(min(max(end, 0), limit)) for end, limit in zip(ends, limits, strict=True))
    return x, y
