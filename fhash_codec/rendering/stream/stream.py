"""Sample streaming: all rays of a picture take samples together, in passes.

The model is evaluated for a whole pass at once. Plain streaming takes one sample of every ray that
is alive in a pass. Adaptive ray marching takes more samples the fewer rays are left, N_s =
clamp(N_r / N_alive, 1, 64) of each ray (paper, algorithm 1).

Both make the same picture. With numpy it is the same bit for bit, since every number of a sample is
computed without the other samples of the pass (inference.py). On a device a network's values differ
by the rounding of matrix products, and the picture with them.

A pass is computed where the field has its values: by numpy on the host, or by torch on a device.
From a device only counts come back before the picture is finished.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from fhash_codec.progress import Progress, silent
from fhash_codec.rendering.stream.beams import Beams
from fhash_codec.rendering.stream.canvas import Canvas, Events
from fhash_codec.rendering.stream.crossings import Crossings, crossings
from fhash_codec.rendering.stream.fields import Field
from fhash_codec.rendering.stream.leaping import Leaping
from fhash_codec.rendering.task.arrays import Array
from fhash_codec.rendering.task.bricks import SIDE
from fhash_codec.rendering.task.counters import complete
from fhash_codec.rendering.task.palette import Palette
from fhash_codec.rendering.task.task import Marched, Task

__all__ = ["MAX_SAMPLES", "stream"]

MAX_SAMPLES = 64
"""Samples of one ray in a pass at most, as in the paper."""
BAND = 1 << 20
"""Rays that are alive at a time; a larger picture is made in bands of rows."""


def stream(
    field: Field,
    task: Task,
    *,
    adaptive: bool,
    budget: int | None = None,
    progress: Progress = silent,
) -> Marched:
    """March a task's rays through a field, where the field has its arrays.

    adaptive: adaptive ray marching with N_r = `budget` samples in a pass, the number of rays if None; else one sample of each ray.
    Raises InputError where the memory of a device is not enough.
    """
    width, height = task.rays.size
    arrays, fine = field.arrays, task.antialiasing**2
    rows = max(1, BAND // (width * fine))
    rgba = np.zeros((height, width, 4), dtype=np.float32)
    depth = np.full((height, width), np.inf, dtype=np.float32)
    normal = np.zeros((height, width, 3), dtype=np.float32)
    counters = complete()
    with arrays.guarded():
        for first in range(0, height, rows):
            band = slice(first, min(first + rows, height))
            marcher = _Marcher(
                field, task, Beams.of(task, field.bounds, range(band.start, band.stop), arrays)
            )
            marcher.march(adaptive, budget, partial(_report, progress, first, height))
            counters = complete(counters, marcher.counters, {"gradients": marcher.canvas.gradients})
            rgba[band], depth[band], normal[band] = _pixels(
                marcher.canvas, (band.stop - band.start, width, fine)
            )
    return Marched(
        rgba=rgba,
        depth=depth if task.depth else None,
        normal=normal if task.normal else None,
        counters=counters,
    )


def _report(progress: Progress, first: int, height: int, done: int, total: int) -> None:
    """A part of a band's rays as a part of all."""
    progress("marching", first * total + (height - first) * done, height * total, "")


def _pixels(canvas: Canvas, shape: tuple[int, int, int]) -> tuple[Array, Array, Array]:
    """rgba, depth and normal of rays (rows, width, rays of a pixel) on the host: the mean colour, and what is nearest."""
    arrays, xp = canvas.arrays, canvas.arrays.xp
    rgba = (
        xp.concatenate([canvas.colour, 1 - canvas.clear[:, None]], axis=1)
        .reshape(*shape, 4)
        .mean(axis=2)
    )
    depth = canvas.depth.reshape(shape)
    nearest = xp.argmin(depth, axis=2)[..., None]
    normal = arrays.take_along(canvas.normal.reshape(*shape, 3), nearest[..., None], 2)[:, :, 0]
    return (
        arrays.host(rgba),
        arrays.host(arrays.take_along(depth, nearest, 2)[..., 0]),
        arrays.host(normal),
    )


class _Marcher:
    """The state of a band's rays."""

    def __init__(self, field: Field, task: Task, beams: Beams) -> None:
        arrays, count = field.arrays, len(beams.end)
        self.field, self.task, self.beams, self.arrays = field, task, beams, arrays
        self.palette = None if task.table is None else Palette.of(task.table, arrays)
        self.canvas = Canvas(field, task, beams, self.palette)
        self.leaping = Leaping.of(field.bricks, task, field.first, field.stride, arrays)
        # A long step could pass a brick in which a surface lies, from one in which nothing does to another.
        short = task.step <= SIDE * field.stride * float(np.min(np.abs(task.rays.grid.spacing)))
        self.skipping = task.skipping and (short or not task.surfaces)
        # Between two samples in cells without a surface there may be one with it: then all of a brick is looked at.
        by_cells = self.skipping and not task.surfaces and not task.maximum
        self.cells = field.visible(self.palette) if by_cells and self.palette is not None else None
        # With surfaces, one more place after the last sample: the end of the path.
        behind = (beams.leaving > arrays.real(beams.end) - 1) & (beams.end > beams.begin)
        self.end = beams.end + arrays.whole(behind) if task.surfaces else beams.end
        self.next = arrays.copy(beams.begin)
        # The last place that was looked at, in samples, and the value there; NaN where a ray leapt since, or has not yet begun.
        self.from_, self.before = arrays.copy(beams.entered), arrays.full(count, np.nan)
        self.peak, self.peak_at = arrays.full(count, -np.inf), arrays.full(count, 0.0)
        self.counters = complete({"rays": int(arrays.xp.count_nonzero(beams.end > beams.begin))})

    def march(self, adaptive: bool, budget: int | None, report: Callable[[int, int], None]) -> None:
        """Passes until no ray is alive."""
        # Of N_r are all rays that the camera sends, also those that miss.
        budget = len(self.next) if budget is None else budget
        (alive,) = self.arrays.nonzero(self.next < self.end)
        total = max(len(alive), 1)
        while len(alive):
            alive = self._leapt(alive)
            if len(alive):
                pace = int(min(max(budget // len(alive), 1), MAX_SAMPLES)) if adaptive else 1
                self._pass(
                    alive,
                    min(pace, int((self.end[alive] - self.next[alive]).max())) if pace > 1 else 1,
                )
            alive = alive[
                (self.next[alive] < self.end[alive])
                & (self.canvas.clear[alive] >= self.task.threshold)
            ]
            report(total - len(alive), total)
        if self.task.maximum:
            self.canvas.show_peaks(self.peak, self.peak_at)

    def _leapt(self, alive: Array) -> Array:
        """Move rays on to their next sample in a brick that matters; those that have one."""
        if not self.skipping:
            return alive
        leapers = alive
        if self.task.surfaces:
            # There may be one between the last place in a brick and the next one, which is no longer in it.
            near = ~self.arrays.xp.isnan(self.from_[alive])
            near[self.arrays.nonzero(near)] = self.leaping.matters(
                self.beams.places(alive[near], self.from_[alive[near]])
            )
            leapers = alive[~near]
        before = self.next[leapers]
        reached, leaps = self.leaping.leap(
            self.beams.origin[leapers], self.beams.pace[leapers], before, self.end[leapers]
        )
        self.counters["skipped_bricks"] += leaps
        gone = leapers[reached > before]
        self.before[gone], self.from_[gone] = np.nan, np.nan
        self.next[leapers] = reached
        return alive[self.next[alive] < self.end[alive]]

    def _pass(self, alive: Array, pace: int) -> None:
        """Take `pace` samples of each ray."""
        task, beams, arrays, xp = self.task, self.beams, self.arrays, self.arrays.xp
        sample = self.next[alive][:, None] + arrays.range(pace)
        wanted = sample < beams.end[alive][:, None]
        places = beams.places(alive, sample)
        if self.cells is not None:
            wanted[arrays.nonzero(wanted)] = self._visible(places[wanted])
        elif self.skipping and pace > 1:
            worth = self.leaping.matters(places)
            if task.surfaces:  # one may lie between a sample in a brick and the one before or after it, which is not
                within, worth[:, 0] = arrays.copy(worth), True
                worth[:, :-1] = worth[:, :-1] | within[:, 1:]
                worth[:, 1:] = worth[:, 1:] | within[:, :-1]
            wanted = wanted & worth
        values = arrays.full(sample.shape, np.nan)
        values[wanted] = self._looked_up(places[wanted])
        self.counters["passes"] += 1
        self.next[alive] += pace
        if task.maximum:
            best = xp.argmax(xp.where(xp.isnan(values), -np.inf, values), axis=1)[:, None]
            value, at = (
                arrays.take_along(part, best, 1)[:, 0] for part in (values, arrays.real(sample))
            )
            larger = value > self.peak[alive]
            self.peak[alive[larger]], self.peak_at[alive[larger]] = value[larger], at[larger]
        if task.surfaces or not task.maximum:
            self.canvas.add(alive, self._events(alive, sample, values))

    def _visible(self, places: Array) -> Array:
        """Whether places (n, 3) lie in cells in which anything can be seen."""
        assert self.cells is not None
        z, y, x = self.cells.shape
        at = self.arrays.whole((places - self.field.first) / self.field.stride)
        i, j, k = (
            self.arrays.xp.clip(at[:, axis], 0, size - 1) for axis, size in enumerate((x, y, z))
        )
        return self.arrays.xp.take(self.cells, (k * y + j) * x + i)

    def _looked_up(self, places: Array) -> Array:
        values = self.field.values(places)
        self.counters["samples"] += len(places)
        self.counters["evaluations"] += self.arrays.xp.count_nonzero(~self.arrays.xp.isnan(values))
        return values

    def _events(self, alive: Array, sample: Array, values: Array) -> Events:
        task, arrays, xp = self.task, self.arrays, self.arrays.xp
        surfaces, rows = len(task.surfaces), len(alive)
        shape = (*sample.shape, surfaces + 1)
        opacity = arrays.full(shape, 0.0)
        at, which = (
            arrays.real(xp.broadcast_to(sample[..., None], shape)),
            xp.broadcast_to(arrays.range(surfaces + 1), shape),
        )
        if task.surfaces:
            found = self._crossings(alive, sample, values)
            opacity[..., :-1], at[..., :-1] = found.opacity, found.at
            which = xp.concatenate([found.which, which[..., -1:]], axis=2)
        if self.palette is not None and not task.maximum:
            opacity[..., -1] = self._opacity(self.palette, alive, sample, values)
        return Events(
            opacity=opacity.reshape(rows, -1),
            at=at.reshape(rows, -1),
            which=which.reshape(rows, -1),
            values=values,
        )

    def _crossings(self, alive: Array, sample: Array, values: Array) -> Crossings:
        """The surfaces before each sample; before the first of a ray from where it enters, behind the last to where it leaves."""
        beams, arrays, xp = self.beams, self.arrays, self.arrays.xp
        leaving, places = beams.leaving[alive][:, None], arrays.real(sample)
        to = xp.minimum(places, leaving)
        values = arrays.copy(values)
        beyond = (places >= leaving) & (sample < self.end[alive][:, None])
        values[beyond] = self._looked_up(beams.borders(alive, to)[beyond])
        rays = alive[xp.isnan(self.before[alive])]
        self.from_[rays] = xp.maximum(
            arrays.real(self.next[rays] - sample.shape[1] - 1), beams.entered[rays]
        )
        self.before[rays] = self._looked_up(beams.borders(rays, self.from_[rays]))
        found = crossings(
            lambda row, at: self._looked_up(beams.places(alive[row], at)),
            xp.concatenate([self.from_[alive][:, None], to], axis=1),
            xp.concatenate([self.before[alive][:, None], values], axis=1),
            self.task.surfaces,
            arrays,
        )
        self.before[alive], self.from_[alive] = values[:, -1], to[:, -1]
        return found

    def _opacity(self, palette: Palette, alive: Array, sample: Array, values: Array) -> Array:
        """Of samples (rays, samples), 0 where there is no value; the last step of a path is shorter."""
        arrays, xp = self.arrays, self.arrays.xp
        known = ~xp.isnan(values)
        row, column = arrays.nonzero(known)
        length = (
            xp.where(
                sample[row, column] == self.beams.last[alive][row], self.beams.rest[alive][row], 1.0
            )
            * self.task.step
        )
        opacity = arrays.full(values.shape, 0.0)
        opacity[row, column] = -xp.expm1(-palette.extinction(values[row, column]) * length)
        return opacity
