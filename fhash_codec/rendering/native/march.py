"""Marching in packets of rays by the native library (formats/fhash_formats/native/march.cpp).

With central differences a gradient is half of the difference between the values a vertex of the frame behind and before along each axis,
clamped to the frame; where one of them is missing that of the cell, along that axis. The normal buffer always has that of the cell.
"""

from __future__ import annotations

import ctypes
from ctypes import POINTER, c_double, c_float, c_int32, c_int64, c_uint32
from itertools import count, product

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.native.cells import cells_of
from fhash_codec.rendering.native.frame_task import MarchInput, empty_table
from fhash_codec.rendering.task.bricks import SIDE, Bricks
from fhash_codec.rendering.task.task import Frame, Marched, Table, Task, extinctions_in
from fhash_formats.support.threads import in_threads, usable_threads

__all__ = ["MAX_SURFACES", "march_native"]

MAX_SURFACES = 64
"""In one picture: FHASH_SURFACES of march.hpp."""
MAX_VALUES = 2**31 - 1
"""Of a frame, for the vectors' indices of 32 bits."""
ENTRIES = 4000
"""Of a table, at least."""
POWERS = 1024
TILE = 16
GROUP = 8
"""Tiles that a thread takes at a time."""
MIN_SKIPPED = 0.4
"""Of the bricks, those of which nothing can be seen: of fewer, looking for them takes longer than marching through them."""
SHADED, LIT, MAXIMUM = 1, 2, 4

_Three = c_double * 3
_Pair = c_double * 2
_Ends = _Pair * 3
_Five = c_double * 5


class _March(ctypes.Structure):
    """FhashMarch of march.hpp, field by field."""

    _fields_ = (
        ("values", POINTER(c_float)),
        ("shape", c_int64 * 3),
        ("distance", POINTER(c_int32)),
        ("cells", POINTER(c_uint32)),
        ("highest", POINTER(c_float)),
        ("bricks", c_int64 * 3),
        ("table", POINTER(c_float)),
        ("extinction", POINTER(c_double)),
        ("entries", c_int64),
        ("low", c_double),
        ("scale", c_double),
        ("light", POINTER(c_float)),
        ("light_shape", c_int64 * 3),
        ("light_offset", _Three),
        ("light_scale", c_double),
        ("eye", _Three),
        ("right", _Three),
        ("up", _Three),
        ("forward", _Three),
        ("box", _Ends),
        ("seen", _Ends),
        ("spacing", _Three),
        ("width", c_int64),
        ("height", c_int64),
        ("parallel", c_int64),
        ("rays", c_int64),
        ("step", c_double),
        ("threshold", c_double),
        ("jitter", c_int64),
        ("lamp", _Three),
        ("ambient", c_double),
        ("diffuse", c_double),
        ("specular", c_double),
        ("steep", c_double),
        ("gradient", _Three),
        ("floor", c_double),
        ("powers", POINTER(c_float)),
        ("surfaces", c_int64),
        ("surface", _Five * MAX_SURFACES),
        ("out", POINTER(c_float)),
        ("depth", POINTER(c_float)),
        ("normal", POINTER(c_float)),
        ("central", c_int64),
        ("path", c_int64),
    )


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

    path: of the processor: 0 the quickest that it has, 1 at most AVX2, 2 neither. Pictures agree within rounding.
    """
    setting = MarchInput.of(frame, task, bricks)
    table = task.table or empty_table(setting.low, setting.high)
    width, height = task.rays.size
    rgba = np.zeros((height, width, 4), dtype=np.float32)
    depth = (
        np.full((height, width), np.inf, dtype=np.float32) if task.depth or task.normal else None
    )
    normal = np.zeros((height, width, 3), dtype=np.float32) if task.normal else None
    entries, extinctions = _entries(table, task.step)
    # A step longer than a brick could pass through one in which a surface lies, from one in which nothing does to another.
    leap = task.step / float(np.abs(setting.spacing).min()) > SIDE and bool(task.surfaces)
    distance = bricks.distance(task) if task.skipping and not task.maximum and not leap else None
    cells = None
    # For the same reason no step is longer than a cell; rounding of places in float32 counts.
    if distance is not None and not (
        task.surfaces and task.step > 0.99 * float(np.abs(setting.spacing).min())
    ):
        cells = cells_of(library, bricks, task, distance)
    if (
        distance is not None
        and cells is None
        and np.count_nonzero(distance) < MIN_SKIPPED * distance.size
    ):
        distance = None
    highest = (
        bricks.high if task.skipping and task.maximum and setting.values is bricks.values else None
    )
    light = (
        None if task.light is None else np.ascontiguousarray(task.light.shares, dtype=np.float32)
    )
    lighting = task.lighting
    steep = max(1.0, lighting.specular_power / 16) if lighting is not None else 1.0
    cosines = np.maximum(1 - np.arange(POWERS + 2) / (POWERS * steep), 0.0)
    powers = (cosines ** (lighting.specular_power if lighting is not None else 1.0)).astype(
        np.float32
    )
    surfaces = [
        _Five(level, *surface.colour, surface.opacity)
        for level, surface in zip(setting.levels, task.surfaces, strict=True)
    ]
    given = _March(
        values=_floats(setting.values),
        shape=setting.values.shape,
        distance=None if distance is None else distance.ctypes.data_as(POINTER(c_int32)),
        cells=None if cells is None else cells.ctypes.data_as(POINTER(c_uint32)),
        highest=_floats(highest),
        bricks=bricks.low.shape,
        table=_floats(entries),
        extinction=extinctions.ctypes.data_as(POINTER(c_double)),
        entries=len(entries) - 1,
        low=setting.low,
        scale=(len(entries) - 2) / (setting.high - setting.low),
        light=_floats(light),
        light_shape=(0, 0, 0) if light is None else light.shape[:3],
        light_offset=_Three(*setting.light_offset),
        light_scale=setting.light_scale,
        eye=_Three(*setting.eye),
        right=_Three(*setting.right),
        up=_Three(*setting.up),
        forward=_Three(*setting.forward),
        box=_Ends(*(_Pair(*ends) for ends in setting.box)),
        seen=_Ends(*(_Pair(*ends) for ends in setting.seen)),
        spacing=_Three(*setting.spacing),
        width=width,
        height=height,
        parallel=task.rays.parallel,
        rays=task.antialiasing,
        step=task.step,
        threshold=task.threshold,
        jitter=task.jitter,
        lamp=_Three(
            *(
                lighting.lamp
                if lighting is not None and lighting.lamp is not None
                else (0.0, 0.0, 0.0)
            )
        ),
        ambient=lighting.ambient if lighting is not None else 1.0,
        diffuse=lighting.diffuse if lighting is not None else 0.0,
        specular=lighting.specular if lighting is not None else 0.0,
        steep=steep,
        gradient=_Three(*setting.gradient),
        floor=setting.floor,
        powers=_floats(powers),
        surfaces=0 if task.maximum else len(surfaces),
        surface=(_Five * MAX_SURFACES)(*surfaces),
        out=_floats(rgba),
        depth=_floats(depth),
        normal=_floats(normal),
        central=lighting is not None and lighting.central,
        path=path,
    )
    wanted = MAXIMUM if task.maximum else SHADED * task.shaded | LIT * (light is not None)
    spans = _spans(task)
    groups = count()

    def work(_: int) -> npt.NDArray[np.int64]:
        counters = np.zeros(5, dtype=np.int64)
        while (group := next(groups)) < len(spans):
            failed = library.fhash_march(
                ctypes.byref(given),
                c_int64(wanted),
                c_int64(spans[group][0]),
                c_int64(spans[group][1]),
                ctypes.c_void_p(counters.ctypes.data),
            )
            assert not failed
        return counters

    workers = max(1, min(threads or usable_threads(), len(spans)))
    found = (
        work(0)
        if workers == 1
        else sum(in_threads(work, range(workers)), np.zeros(5, dtype=np.int64))
    )
    rays, passes, samples, gradients, skipped = (int(number) for number in found)
    counters = {
        "rays": rays,
        "passes": passes,
        "samples": samples,
        "evaluations": 0,
        "gradients": gradients,
        "secondary_rays": 0,
        "skipped_bricks": skipped,
    }
    return Marched(rgba=rgba, depth=depth if task.depth else None, normal=normal, counters=counters)


def _spans(task: Task) -> list[tuple[int, int]]:
    """Tiles of the picture, first and stop in rows, of the rectangle around the box: all other rays miss it."""
    width, height = task.rays.size
    across, down = -(-width // TILE), -(-height // TILE)
    with np.errstate(all="ignore"):
        pixels, depth = task.rays.project(np.array(list(product(*task.rays.grid.bounds))))
    left, top, right, bottom = 0, 0, across, down
    if np.isfinite(pixels).all() and (task.rays.parallel or np.all(depth > 1e-6 * depth.max())):
        # Rounding is far below a pixel.
        low, high = (
            np.floor((pixels.min(axis=0) - 1) / TILE),
            np.ceil((pixels.max(axis=0) + 1) / TILE),
        )
        left, top = (
            int(min(max(at, 0), most)) for at, most in zip(low, (across, down), strict=True)
        )
        right, bottom = (
            int(min(max(at, 0), most)) for at, most in zip(high, (across, down), strict=True)
        )
    rows = (range(row * across + left, row * across + right, GROUP) for row in range(top, bottom))
    return [(first, min(first + GROUP, row.stop)) for row in rows for first in row]


def _entries(table: Table, step: float) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float64]]:
    """Colours and opacities (n + 1, 4), and extinctions (n + 1,), of a step; the last entry twice.

    They lie so close that opacity is linear between them as extinction is.
    """
    last = len(table.extinctions) - 1
    places = np.append(np.linspace(0, last, last * -(-ENTRIES // last) + 1), last)
    columns = [np.interp(places, np.arange(last + 1), column) for column in table.colours.T]
    extinctions = extinctions_in(np.interp(places, np.arange(last + 1), table.extinctions), step)
    return np.stack([*columns, -np.expm1(-extinctions)], axis=-1).astype(np.float32), extinctions


def _floats(array: npt.NDArray[np.float32] | None) -> object:
    """A pointer that keeps its array; null for None."""
    return None if array is None else array.ctypes.data_as(POINTER(c_float))
