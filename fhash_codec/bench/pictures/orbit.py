"""An orbit about a large volume made here: a shell in the middle of 256 x 256 x 256 vertices.

The pictures of an orbit have one frame and one transfer function. What follows from these alone,
the distances of empty bricks and the visible cells, is found anew for each picture, or kept.
"""

from __future__ import annotations

import time
from statistics import median

import numpy as np
import numpy.typing as npt

from fhash_codec.bench.pictures.results import Switch
from fhash_codec.rendering.bricks import Bricks
from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.march import march
from fhash_codec.rendering.march_task import Frame, Lighting, Marched, Table, Task
from fhash_codec.rendering.scenes import Camera

__all__ = ["orbit", "shell", "view_of_shell"]

SIDE = 256
"""Vertices along each axis."""
LIGHTING = Lighting(ambient=0.2, diffuse=0.8, specular=0.2, specular_power=16.0, lamp=None)


def shell(side: int) -> npt.NDArray[np.float32]:
    """A wavy shell about the middle, float32 (z, y, x), 0 far from it and 1 on it."""
    axis = np.linspace(-1, 1, side, dtype=np.float32)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij", sparse=True)
    radius = np.sqrt(x * x + y * y + z * z) + 0.03 * np.sin(9 * x) * np.cos(8 * y + 3 * z)
    return np.asarray(np.exp(-(((radius - 0.7) / 0.04) ** 2)), dtype=np.float32)


def orbit(turns: int, size: int, side: int | None = None) -> tuple[Switch, ...]:
    """Measure pictures of an orbit, unlit and lit, with bricks found anew and with bricks kept.

    Args:
        turns: pictures of an orbit, and so runs of each median.
        size: pixels along both sides.
        side: vertices along each axis; SIDE if None.
    """
    side = SIDE if side is None else side
    frame = Frame(values=shell(side), first=(0, 0, 0))
    kept = Bricks.of(frame)
    found = []
    for shaded in (False, True):
        tasks = [view_of_shell(side, size, 360 * turn / turns, shaded) for turn in range(turns)]
        anew: list[float] = []
        again: list[float] = []
        pictures: list[Marched] = []
        march(frame, tasks[0], bricks=kept)
        for task in tasks:
            fresh = Bricks(values=kept.values, low=kept.low, high=kept.high)
            for bricks, times in ((fresh, anew), (kept, again)):
                begun = time.perf_counter()
                pictures.append(march(frame, task, bricks=bricks))
                times.append(1e3 * (time.perf_counter() - begun))
        found.append(
            Switch(
                name=f"shell of {side}^3, {'lit' if shaded else 'unlit'}: bricks kept",
                off_ms=median(anew),
                on_ms=median(again),
                counters_off=dict(pictures[-2].counters),
                counters_on=dict(pictures[-1].counters),
                psnr=None,
            )
        )
    return tuple(found)


def view_of_shell(side: int, size: int, azimuth: float, shaded: bool) -> Task:
    """A view of the shell, of which what lies above a tenth is seen."""
    grid = Grid(counts=(side,) * 3, origin=np.zeros(3), spacing=np.ones(3))
    values = np.linspace(0.0, 1.0, 1001)
    return Task(
        rays=Rays.of(Camera(azimuth=azimuth, elevation=10.0), grid, (size, size)),
        step=0.5,
        threshold=1 / 1024,
        table=Table(
            low=0.0,
            high=1.0,
            colours=np.stack([values, 0.5 * values, 1 - values], axis=-1).astype(np.float32),
            extinctions=0.3 * np.clip((values - 0.1) / 0.9, 0.0, 1.0),
        ),
        lighting=LIGHTING if shaded else None,
        shaded=shaded,
    )
