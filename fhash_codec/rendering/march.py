"""Marching in packets of rays through a frame, by the native library (native/march.cpp)."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from itertools import count, product
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec import native
from fhash_codec.native import ffi, pointer
from fhash_codec.progress import Progress, silent
from fhash_codec.rendering.bricks import SIDE, Bricks, cells_of, reach_of, smoothed
from fhash_codec.rendering.light import flatness, slope_scale, smoothing
from fhash_codec.rendering.march_device import DeviceMarcher
from fhash_codec.rendering.march_task import (
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
from fhash_codec.rendering.tiled_frame import Fetching, TiledFrame
from fhash_formats.errors import InputError
from fhash_formats.support.threads import in_threads, usable_threads
from fhash_formats.support.values import Single

MAX_SURFACES: int = ffi.integer_const("FHASH_SURFACES")
"""Surfaces of a picture, at most."""
POWERS: int = ffi.integer_const("FHASH_POWERS")
"""Intervals of the table of highlights."""
TILE = 16
"""Pixels along a tile's side: TILE of march_packet.hpp."""
SHADED = 1
"""Flag of `fhash_march`: the volume is lit by its gradients."""
LIT = 2
"""Flag of `fhash_march`: the volume has a light grid."""
MAXIMUM = 4
"""Flag of `fhash_march`: the largest value along each ray is drawn."""

MINIMUM = 32
"""Flag of `fhash_march`, with MAXIMUM: the smallest value along each ray is drawn."""
AVERAGE = 64
"""Flag of `fhash_march`: the mean along each ray is drawn."""
ATTENUATED = 128
"""Flag of `fhash_march`: the attenuated maximum along each ray is drawn."""
GRADED = 256
"""Flag of `fhash_march`, with SHADED: the gradients decide on the opacity, too."""


def structure_of(fields: dict[str, Any]) -> Any:
    """`FhashMarch` (codec.h) of fields by name: numbers, arrays, and None for null.

    Whoever keeps it keeps the arrays of pointers. Arrays within the structure may be shorter.
    """
    kinds = {name: field.type.kind for name, field in ffi.typeof("FhashMarch").fields}
    given = {name: field for name, field in fields.items() if field is not None}
    for name, field in given.items():
        if isinstance(field, np.ndarray):
            given[name] = field.tolist() if kinds[name] == "array" else pointer(field)
    return ffi.new("FhashMarch *", given)


MAX_MAGNITUDE = 1e36
"""Largest magnitude of values that float32 can compute with; larger values are scaled."""
MIN_RANGE = 1e-28
"""Smallest range of a table that float32 can compute with; values of a smaller one are scaled."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MarchInput:
    """The numbers of a task in the units of the native marcher.

    All places and directions are in vertices of the frame, x, y, z.

    Attributes:
        fields: of `FhashMarch`, by name: values, scaled where float32 could not compute with them,
            rays, the drawn box as it is clipped, the part `seen` of it in which the frame has
            values, and what follows from these.
        low, high: values of the table's ends, scaled likewise.
        steepness: a gradient of shading of 1, in marched units per unit of the coordinates.
        smoothing: deviation of the Gaussian by which values are smoothed before shading, in
            vertices; 0 for none.
        error: largest error of a value, scaled likewise; smoothed values stay within it.
    """

    fields: dict[str, Any]
    low: float
    high: float
    steepness: float
    smoothing: float
    error: float

    @classmethod
    def of(cls, frame: Frame, task: Task, bricks: Bricks) -> MarchInput:
        """The input for a task and a frame with its bricks."""
        rays, grid, stride = task.rays, task.rays.grid, float(frame.stride)
        first = np.array(frame.first[::-1], dtype=np.float64)
        least, most = bricks.value_range
        low, high = (task.table.low, task.table.high) if task.table is not None else (least, most)
        scaling = _Scaling.of(low, high, max(abs(least), abs(most)))
        low, high, least, most = map(scaling.number, (low, high, least, most))
        noise = scaling.width(task.noise)
        span, floor = flatness(low, high, least, most, noise)
        box, planes, within = task.bounds, task.planes, frame.bounds(grid)
        seen = np.stack(
            [np.maximum(within[:, 0], box[:, 0]), np.minimum(within[:, 1], box[:, 1])], axis=-1
        )
        seen[:, 1] = np.maximum(seen[:, 1], seen[:, 0])  # nothing, and no box that is turned over
        # Of a network the shape alone counts.
        values = frame.values if frame.network else scaling.array(bricks.values)
        fields = {
            "values": values,
            "shape": values.shape,
            "bricks": bricks.low.shape,
            "low": low,
            "eye": (rays.eye - first) / stride,
            "right": rays.right / stride,
            "up": rays.up / stride,
            "forward": rays.forward / stride,
            "box": (box - first[:, None]) / stride,
            "seen": (seen - first[:, None]) / stride,
            "spacing": grid.spacing * stride,
            "planes": len(planes),
            "plane": np.column_stack(
                [planes[:, :3], (planes[:, 3] - planes[:, :3] @ first) / stride]
            ),
            "surfaces": 0 if task.projection else len(task.surfaces),
            "surface": np.reshape(
                [
                    (scaling.number(each.value), *each.colour, each.opacity)
                    for each in task.surfaces
                ],
                (-1, 5),
            ),
            "gradient": slope_scale(grid, span, least, most),
            "floor": floor,
            **_light_fields(task, first, stride),
        }
        if frame.network is not None:
            start, stop = map(scaling.number, (frame.network.low, frame.network.high))
            fields |= {
                **frame.network.fields,
                "values": frame.network.mask,
                "network_shape": frame.network.mask.shape,
                "network_whole": frame.network.whole,
                "network_low": start,
                "network_span": stop - start,
                "network_status": np.zeros(1, np.int64),
            }
        return cls(
            fields=fields,
            low=low,
            high=high if high > low else low + span,
            steepness=span * scaling.unit / (stride * grid.vertex_spacing),
            smoothing=smoothing(span, noise),
            error=scaling.width(task.error),
        )


def _light_fields(task: Task, first: npt.NDArray[np.float64], stride: float) -> dict[str, Any]:
    """The fields of the light grid: a place is at place * scale + offset (3,) in it."""
    light = task.light
    if light is None:
        return {"light": None, "light_scale": 1.0}
    shares = np.ascontiguousarray(light.shares, dtype=np.float32)
    return {
        "light": shares,
        "light_shape": shares.shape[:3],
        "light_offset": (first - light.first) / light.cell,
        "light_scale": stride / light.cell,
    }


@dataclass(frozen=True, kw_only=True)
class _Scaling:
    """Values as value / unit - middle / unit, so that float32 can compute with them."""

    middle: float = 0.0
    unit: float = 1.0

    @classmethod
    def of(cls, low: float, high: float, magnitude: float) -> _Scaling:
        """The scaling for a table from `low` to `high` and values of at most a magnitude."""
        largest = max(magnitude, abs(low), abs(high))
        if largest <= MAX_MAGNITUDE and not 0 < high - low < MIN_RANGE:
            return cls()
        return cls(middle=low / 2 + high / 2, unit=max(high / 2 - low / 2, largest * 1e-30, 5e-324))

    def number(self, value: float) -> float:
        """Scale a value."""
        return value / self.unit - self.middle / self.unit

    def width(self, difference: float) -> float:
        """Scale a difference of two values."""
        return difference / self.unit

    def array(self, values: Single) -> Single:
        """Scale values, clipped to MAX_MAGNITUDE; without scaling the result is the same array."""
        if self == _Scaling():
            return values
        with np.errstate(over="ignore"):
            scaled = values.astype(np.float64) / self.unit - self.middle / self.unit
            return scaled.clip(-MAX_MAGNITUDE, MAX_MAGNITUDE).astype(np.float32)


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
COUNTED = ("rays", "passes", "samples", "gradients", "skipped_bricks", "evaluations")
"""Names of the counters of `fhash_march`, in its order."""


def march_native(
    frame: Frame | TiledFrame,
    task: Task,
    bricks: Bricks,
    threads: int | None = None,
    *,
    path: int = 0,
    progress: Progress = silent,
    device: DeviceMarcher | None = None,
) -> Marched:
    """The picture of a task, as `march` describes it.

    path: instructions of the processor that may be used: 0 all, 1 at most AVX2, 2 only those that
        every processor has. The pictures agree within rounding.
    device: draws in place of the processor.
    """
    library = native.library()
    tiles = frame if isinstance(frame, TiledFrame) else None
    frame = frame.frame if isinstance(frame, TiledFrame) else frame
    assert frame.values.size <= MAX_VALUES, "a plan has no larger frame"
    task = task.marched
    given, fetching = MarchInput.of(frame, task, bricks), None
    if tiles is not None and given.fields["values"] is bricks.values:
        fetching = _fetching(given, task, tiles)
        fields = fetching.fields
    else:
        if tiles is not None:
            tiles.complete()  # scaled values are a copy
            given = MarchInput.of(frame, task, bricks)
        fields = _skipping_fields(library, given, task, bricks)
        fields["smooth"] = _smooth(given, task, bricks)
    width, height = task.rays.size
    rgba = np.zeros((height, width, 4), dtype=np.float32)
    # Normals need the depth, to keep that of the nearest of several rays.
    depth = np.full((height, width), np.inf, np.float32) if task.depth or task.normal else None
    normal = np.zeros((height, width, 3), dtype=np.float32) if task.normal else None
    everything = dict(
        **given.fields,
        **fields,
        **_table_fields(given, task),
        **_lighting_fields(task.lighting),
        **_grading_fields(given, task),
        width=width,
        height=height,
        parallel=task.rays.parallel,
        rays=task.antialiasing,
        step=task.step,
        threshold=task.threshold,
        jitter=task.jitter,
        out=rgba,
        depth=depth,
        normal=normal,
        path=path,
    )
    if device is None:
        counters = _march(library, structure_of(everything), task, threads, progress)
    else:
        network = None if frame.network is None else frame.network.device
        counters = _counted(
            device.march(
                everything, _flags(task), fetching=fetching, network=network, progress=progress
            )
        )
    if fetching is not None and fetching.error is not None:
        raise fetching.error
    if frame.network is not None and given.fields["network_status"].any():
        raise MemoryError("not enough memory to evaluate points")
    return Marched(rgba=rgba, depth=depth if task.depth else None, normal=normal, counters=counters)


def _skipping_fields(
    library: native.Library, given: MarchInput, task: Task, bricks: Bricks
) -> dict[str, Any]:
    """The fields of the bricks and cells that rays may pass over; none where all is looked at.

    They are the distances of `Bricks.distance`, the cells of `cells_of`, or the largest value of
    each brick for the maximum along a ray, the smallest times -1 for the minimum.
    """
    by = _leaps_by(given, task)
    if by == "highest" and ("network" in given.fields or given.fields["values"] is bricks.values):
        return {"highest": bricks.high if task.projection == "maximum" else -bricks.low}
    if by != "distance":  # scaled values have other extremes than the bricks
        return {}
    distance = bricks.distance(task)
    # No step may be longer than a cell, either. Rounding of places to float32 counts.
    by_cells = not (task.surfaces and _longest_step(given, task) > 0.99)
    # The values of a network are not known before it is evaluated: any brick may show something.
    cells = (
        bricks.remembered(
            "cells", task.visibility, lambda: cells_of(library, bricks, task, distance)
        )
        if by_cells and "network" not in given.fields
        else None
    )
    if cells is None and np.count_nonzero(distance) < MIN_SKIPPED * distance.size:
        return {}
    return {"distance": distance, "cells": cells}


def _longest_step(given: MarchInput, task: Task) -> float:
    """The length of a step in vertices of the frame, where these lie nearest to each other."""
    return task.step / float(np.abs(given.fields["spacing"]).min())


def _leaps_by(given: MarchInput, task: Task) -> str:
    """The name of the field that rays leap by, '' if they look at everything."""
    # A step longer than a brick could pass through one in which a surface lies, on its way from one
    # in which nothing is visible to another.
    if not task.skipping or (task.surfaces and _longest_step(given, task) > SIDE):
        return ""
    return "highest" if task.projection in ("maximum", "minimum") else "distance"


def _fetching(given: MarchInput, task: Task, tiles: TiledFrame) -> Fetching:
    """The fields of a frame whose blocks are decoded when rays come to them."""
    lighting, smoothing = task.lighting, None
    margin = int(lighting is not None and lighting.central)
    if given.smoothing and (task.shaded or task.surfaces):
        smoothing = given.smoothing, given.error
        margin = 1 + reach_of(given.smoothing)
    if task.surfaces:  # one is looked for between places up to two steps from a sample
        margin += math.ceil(2 * _longest_step(given, task))
    by = _leaps_by(given, task)
    return Fetching(tiles, task, margin=margin, by=by, smoothing=smoothing)


def _table_fields(given: MarchInput, task: Task) -> dict[str, object]:
    """The fields of the transfer function."""
    colours = np.zeros((2, 3), dtype=np.float32)
    nothing = Table(low=given.low, high=given.high, colours=colours, extinctions=np.zeros(2))
    entries, extinctions = _entries(task.table or nothing, task.step)
    return {
        "table": entries,
        "extinction": extinctions,
        "entries": len(entries) - 1,
        "scale": (len(entries) - 2) / (given.high - given.low),
    }


def _entries(table: Table, step: float) -> tuple[Single, npt.NDArray[np.float64]]:
    """Colours and opacities (n + 1, 4) and extinctions (n + 1,) of a step; the last entry twice."""
    last = len(table.extinctions) - 1
    places = np.append(np.linspace(0, last, last * -(-ENTRIES // last) + 1), last)
    columns = [np.interp(places, np.arange(last + 1), column) for column in table.colours.T]
    extinctions = extinctions_in(np.interp(places, np.arange(last + 1), table.extinctions), step)
    return np.stack([*columns, -np.expm1(-extinctions)], axis=-1).astype(np.float32), extinctions


def _smooth(given: MarchInput, task: Task, bricks: Bricks) -> Single | None:
    """The smoothed values that what is lit is shaded by; None where those of the frame do."""
    if not given.smoothing or not (task.shaded or task.surfaces) or "network" in given.fields:
        return None
    values: Single = given.fields["values"]
    if values is not bricks.values:  # scaled for this task alone
        return smoothed(values, given.smoothing, given.error)
    return bricks.smoothed(given.smoothing, given.error)


def _grading_fields(given: MarchInput, task: Task) -> dict[str, object]:
    """The fields of the opacity by gradient."""
    grading = task.grading
    if grading is None:
        return {}
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
        "lamp": (0.0, 0.0, 0.0) if lighting.lamp is None else lighting.lamp,
        "ambient": lighting.ambient,
        "diffuse": lighting.diffuse,
        "specular": lighting.specular,
        "steep": steep,
        "powers": (cosines**lighting.specular_power).astype(np.float32),
        "central": lighting.central,
    }


def _march(
    library: native.Library,
    structure: Any,
    task: Task,
    threads: int | None,
    progress: Progress,
) -> dict[str, int]:
    """March all rays in several threads, into the buffers of a structure; the counters."""
    flags, spans = _flags(task), _spans(task)
    groups = count()

    def work(thread: int) -> npt.NDArray[np.int64]:
        counters = np.zeros(len(COUNTED), dtype=np.int64)
        while (group := next(groups)) < len(spans):
            if thread == 0:
                try:
                    progress("marching", group, len(spans), "")
                except BaseException:
                    spans.clear()  # the other threads end, too
                    raise
            for first, stop in spans[group : group + 1]:
                failed = library.fhash_march(structure, flags, first, stop, pointer(counters))
                assert not failed
        return counters

    workers = max(1, min(threads or usable_threads(), len(spans)))
    if workers == 1:
        total = work(0)
    else:
        total = sum(in_threads(work, range(workers)), np.zeros(len(COUNTED), dtype=np.int64))
    return _counted(total)


def _flags(task: Task) -> int:
    """The flags of `fhash_march` for what is drawn."""
    if task.projection:
        return PROJECTIONS[task.projection]
    graded = (SHADED | GRADED) * (task.grading is not None)
    return SHADED * task.shaded | LIT * (task.light is not None) | graded


def _counted(counters: npt.NDArray[np.int64]) -> dict[str, int]:
    """Counters by name."""
    return complete(dict(zip(COUNTED, counters.tolist(), strict=True)))


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


def march(
    frame: Frame | TiledFrame,
    task: Task,
    *,
    bricks: Bricks | None = None,
    threads: int | None = None,
    progress: Progress = silent,
    device: DeviceMarcher | None = None,
) -> Marched:
    """March the rays of a task.

    The last step of a ray is shorter; if its sample lies beyond the box, the nearest place in the
    box is sampled. Outside a frame that is smaller than the domain nothing is seen.

    Surfaces are searched between the entry, the samples and the exit of a ray, and lie in front of
    the next sample. They are drawn over a projection.

    The depth is where less than half of the light is left, or where the maximum is, or where the
    mean begins; the nearest one of several rays of a pixel.

    Args:
        frame: the values; those of a `TiledFrame` are decoded where rays reach them.
        task: what to march.
        bricks: of the frame; made if None.
        threads: most threads; None for all processors.
        progress: is told of the rows that are done.
        device: draws in place of the processor.

    Raises InputError for more than MAX_SURFACES surfaces.
    """
    if len(task.surfaces) > MAX_SURFACES:
        raise InputError(f"a picture has {len(task.surfaces)} surfaces; allowed: {MAX_SURFACES}")
    if bricks is None:
        bricks = frame.bricks if isinstance(frame, TiledFrame) else Bricks.of(frame)
    if task.projection and task.surfaces:
        surfaces = dataclasses.replace(task, projection="", table=None, shaded=False)
        projection = dataclasses.replace(task, surfaces=())
        front, back = (
            march_native(frame, part, bricks, threads, progress=progress, device=device)
            for part in (surfaces, projection)
        )
        return _over(front, back)
    return march_native(frame, task, bricks, threads, progress=progress, device=device)


def _over(front: Marched, back: Marched) -> Marched:
    """Put one picture over another of the same rays, and add their counters."""
    depth, normal = front.depth, front.normal
    hidden = front.rgba[..., 3] > 0.5
    if depth is not None and back.depth is not None:
        depth = np.where(hidden, depth, back.depth)
    if normal is not None and back.normal is not None:
        normal = np.where(hidden[..., None], normal, back.normal)
    return Marched(
        rgba=front.rgba + (1 - front.rgba[..., 3:]) * back.rgba,
        depth=depth,
        normal=normal,
        counters={key: front.counters[key] + back.counters[key] for key in front.counters},
    )
