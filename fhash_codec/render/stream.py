"""Sample streaming: all rays of a picture take samples together, pass by pass, and the model is evaluated for a whole pass at once.

Plain streaming takes one sample of every ray that is alive in a pass. Adaptive ray marching takes more the fewer rays are left:
N_s = clamp(N_r / N_alive, 1, 64) of each (paper, algorithm 1). Both make the same picture.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from fhash_codec.progress import Progress, silent
from fhash_codec.render.beams import Beams
from fhash_codec.render.bricks import SIDE
from fhash_codec.render.counters import complete
from fhash_codec.render.crossings import Crossings, crossings
from fhash_codec.render.fields import Field
from fhash_codec.render.leaping import Leaping
from fhash_codec.render.phong import Phong, light_at, table_colours
from fhash_codec.render.task import Marched, Task

__all__ = ["MOST_SAMPLES", "stream"]

Floats = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int64]

MOST_SAMPLES = 64
"""Samples of one ray in a pass at most, as in the paper."""
BAND = 1 << 20
"""Rays that are alive at a time; a larger picture is made in bands of rows."""


def stream(field: Field, task: Task, *, adaptive: bool, budget: int | None = None, progress: Progress = silent) -> Marched:
    """March a task's rays through a field.

    adaptive: adaptive ray marching with N_r = `budget` samples in a pass, the number of rays if None; else one sample of each ray.
    """
    width, height = task.rays.size
    fine = task.antialiasing**2
    rows = max(1, BAND // (width * fine))
    rgba = np.zeros((height, width, 4), dtype=np.float32)
    depth = np.full((height, width), np.inf, dtype=np.float32)
    normal = np.zeros((height, width, 3), dtype=np.float32)
    counters = complete()
    for first in range(0, height, rows):
        band = slice(first, min(first + rows, height))
        marcher = _Marcher(field, task, Beams.of(task, field.bounds, range(band.start, band.stop)))
        marcher.march(adaptive, budget, partial(_report, progress, first, height))
        counters = complete(counters, marcher.counters)
        shape = (band.stop - band.start, width, fine)
        rgba[band] = np.concatenate([marcher.colour, 1 - marcher.clear[:, None]], axis=1).reshape(*shape, 4).mean(axis=2)
        nearest = np.argmin(marcher.depth.reshape(shape), axis=2)[..., None]
        depth[band] = np.take_along_axis(marcher.depth.reshape(shape), nearest, axis=2)[..., 0]
        normal[band] = np.take_along_axis(marcher.normal.reshape(*shape, 3), nearest[..., None], axis=2)[:, :, 0]
    return Marched(rgba=rgba, depth=depth if task.depth else None, normal=normal if task.normal else None, counters=counters)


def _report(progress: Progress, first: int, height: int, done: int, total: int) -> None:
    """A part of a band's rays as a part of all."""
    progress("marching", first * total + (height - first) * done, height * total, "")


@dataclass(frozen=True, kw_only=True, eq=False)
class _Events:
    """What a pass meets along each ray, (rays, events), the nearest first: before each sample the surfaces, then the sample itself.

    opacity: 0 where there is nothing. at: in samples. which: of the surfaces, their number for the volume. values: of the samples.
    """

    opacity: Floats
    at: Floats
    which: Numbers
    values: Floats


class _Marcher:
    """The state of a band's rays."""

    def __init__(self, field: Field, task: Task, beams: Beams) -> None:
        count = len(beams.end)
        self.field, self.task, self.beams = field, task, beams
        self.leaping = Leaping.of(field.bricks, task, field.first, field.stride)
        # A long step could pass a brick in which a surface lies, from one in which nothing does to another.
        short = task.step <= SIDE * field.stride * float(np.min(np.abs(task.rays.grid.spacing)))
        self.skipping = task.skipping and (short or not task.surfaces)
        # Between two samples in cells without a surface there may be one with it: then all of a brick is looked at.
        self.cells = field.visible(task) if self.skipping and not task.surfaces and not task.maximum else None
        self.phong = Phong.of(task, field)
        # With surfaces, one more place after the last sample: the end of the path.
        behind = (beams.leaving > beams.end - 1) & (beams.end > beams.begin)
        self.end = beams.end + (behind if task.surfaces else 0)
        if task.table is None:
            self.opacities = np.zeros(2)
        else:
            self.opacities = -np.expm1(-task.table.extinctions * task.step)
        self.colour, self.clear = np.zeros((count, 3)), np.ones(count)
        self.next = beams.begin.copy()
        self.before, self.from_ = np.full(count, np.nan), np.zeros(count)
        self.peak, self.peak_at = np.full(count, -np.inf), np.zeros(count)
        self.depth = np.full(count, np.inf)
        self.normal = np.zeros((count, 3))
        self.counters = complete({"rays": int(np.count_nonzero(beams.end > beams.begin))})

    def march(self, adaptive: bool, budget: int | None, report: Callable[[int, int], None]) -> None:
        """Passes until no ray is alive."""
        # Of N_r are all rays that the camera sends, also those that miss.
        budget = len(self.next) if budget is None else budget
        alive = np.flatnonzero(self.next < self.end)
        total = max(int(alive.size), 1)
        while alive.size:
            alive = self._leapt(alive)
            if alive.size:
                pace = int(min(max(budget // alive.size, 1), MOST_SAMPLES)) if adaptive else 1
                self._pass(alive, min(pace, int((self.end[alive] - self.next[alive]).max())))
            alive = alive[(self.next[alive] < self.end[alive]) & (self.clear[alive] >= self.task.threshold)]
            report(total - int(alive.size), total)
        if self.task.maximum:
            self._show_peaks()

    def _leapt(self, alive: Numbers) -> Numbers:
        """Move rays on to their next sample in a brick that matters; those that have one."""
        if not self.skipping:
            return alive
        before, ends = self.next[alive], self.end[alive]
        reached, leaps = self.leaping.leap(self.beams.origin[alive], self.beams.pace[alive], before, ends)
        self.counters["skipped_bricks"] += leaps
        self.before[alive[reached > before]] = np.nan
        self.next[alive] = reached
        return alive[reached < ends]

    def _pass(self, alive: Numbers, pace: int) -> None:
        """Take `pace` samples of each ray."""
        task, beams = self.task, self.beams
        sample = self.next[alive][:, None] + np.arange(pace)
        wanted = sample < beams.end[alive][:, None]
        places = beams.places(alive, sample)
        if self.cells is not None:
            wanted[wanted] = self._visible(places[wanted])
        elif self.skipping and pace > 1:
            worth = self.leaping.matters(places)
            if task.surfaces:  # one may lie between the sample before a brick and the first within
                worth[:, :-1] |= worth[:, 1:]
            wanted &= worth
        values = np.full(sample.shape, np.nan)
        values[wanted] = self._looked_up(places[wanted])
        self.counters["passes"] += 1
        self.next[alive] += pace
        if task.maximum:
            best = np.argmax(np.where(np.isnan(values), -np.inf, values), axis=1)[:, None]
            value, at = (np.take_along_axis(part, best, axis=1)[:, 0] for part in (values, sample))
            larger = value > self.peak[alive]
            self.peak[alive[larger]], self.peak_at[alive[larger]] = value[larger], at[larger]
        if task.surfaces or not task.maximum:
            self._composite(alive, self._events(alive, sample, values))

    def _visible(self, places: Floats) -> npt.NDArray[np.bool_]:
        """Whether places (n, 3) lie in cells in which anything can be seen."""
        assert self.cells is not None
        last = np.array(self.cells.shape[::-1]) - 1
        x, y, z = np.clip((places - self.field.first) / self.field.stride, 0, last).astype(np.int64).T
        return np.asarray(self.cells[z, y, x])

    def _looked_up(self, places: Floats) -> Floats:
        values = self.field.values(places)
        self.counters["samples"] += len(places)
        self.counters["evaluations"] += int(np.count_nonzero(~np.isnan(values)))
        return values

    def _events(self, alive: Numbers, sample: Numbers, values: Floats) -> _Events:
        task = self.task
        surfaces = len(task.surfaces)
        shape = (*sample.shape, surfaces + 1)
        opacity, at = np.zeros(shape), np.repeat(sample[..., None].astype(np.float64), surfaces + 1, axis=2)
        which = np.broadcast_to(np.arange(surfaces + 1), shape)
        if task.surfaces:
            found = self._crossings(alive, sample, values)
            opacity[..., :-1], at[..., :-1] = found.opacity, found.at
            which = np.concatenate([found.which, which[..., -1:]], axis=2)
        if task.table is not None and not task.maximum:
            opacity[..., -1] = self._opacity(alive, sample, values)
        rows = len(alive)
        return _Events(opacity=opacity.reshape(rows, -1), at=at.reshape(rows, -1), which=which.reshape(rows, -1), values=values)

    def _crossings(self, alive: Numbers, sample: Numbers, values: Floats) -> Crossings:
        """The surfaces before each sample; before the first of a ray from where it enters, behind the last to where it leaves."""
        beams = self.beams
        leaving = beams.leaving[alive][:, None]
        to = np.minimum(sample, leaving)
        values = values.copy()
        beyond = (sample >= leaving) & (sample < self.end[alive][:, None])
        values[beyond] = self._looked_up(beams.places(alive, to)[beyond])
        fresh = np.isnan(self.before[alive])
        rays = alive[fresh]
        self.from_[rays] = np.maximum(self.next[rays] - sample.shape[1] - 1, beams.entered[rays])
        self.before[rays] = self._looked_up(beams.places(rays, self.from_[rays]))
        found = crossings(
            lambda row, at: self._looked_up(beams.places(alive[row], at)),
            np.concatenate([self.from_[alive][:, None], to], axis=1),
            np.concatenate([self.before[alive][:, None], values], axis=1),
            self.task.surfaces,
        )
        self.before[alive], self.from_[alive] = values[:, -1], to[:, -1]
        return found

    def _opacity(self, alive: Numbers, sample: Numbers, values: Floats) -> Floats:
        table = self.task.table
        assert table is not None
        known = ~np.isnan(values)
        entry = (np.where(known, values, table.low) - table.low) / (table.high - table.low) * (len(self.opacities) - 1)
        opacity = np.where(known, np.interp(entry, np.arange(len(self.opacities)), self.opacities), 0.0)
        row, column = np.nonzero((sample == self.beams.last[alive][:, None]) & (opacity > 0))
        with np.errstate(divide="ignore"):
            opacity[row, column] = -np.expm1(self.beams.rest[alive][row] * np.log1p(-opacity[row, column]))
        return opacity

    def _composite(self, alive: Numbers, events: _Events) -> None:
        """Join a pass to its rays, front to back."""
        each = len(self.task.surfaces) + 1
        # Light behind each event; the first column is what was left before.
        left = np.multiply.accumulate(np.concatenate([self.clear[alive][:, None], 1 - events.opacity], axis=1), axis=1)
        # A ray ends after a sample, never between a surface and the sample behind it.
        ended = np.zeros((len(alive), events.opacity.shape[1] // each), dtype=bool)
        ended[:, 1:] = left[:, each:-1:each] < self.task.threshold
        ended = np.repeat(ended, each, axis=1)
        weight = np.where(ended, 0.0, left[:, :-1] * events.opacity)
        after = np.where(ended, np.inf, left[:, 1:])
        self.clear[alive] = after.min(axis=1)
        row, column = np.nonzero(weight)
        if not row.size:
            return
        colours = self._colours(alive[row], events, row, column) * weight[row, column][:, None]
        # One event after the other, as in any other number of passes.
        order = np.argsort(column, kind="stable")
        firsts = np.searchsorted(column[order], np.arange(weight.shape[1]))
        for start, stop in zip(firsts, [*firsts[1:], len(order)], strict=True):
            chosen = order[start:stop]
            self.colour[alive[row[chosen]]] += colours[chosen]
        if self.task.depth or self.task.normal:
            new = np.isinf(self.depth[alive]) & (after < 0.5).any(axis=1)
            event = np.argmax(after[new] < 0.5, axis=1)
            self._see(alive[new], events.at[new, event])

    def _colours(self, rays: Numbers, events: _Events, row: Numbers, column: Numbers) -> Floats:
        """Colours (n, 3) of events, lit."""
        task, surfaces = self.task, len(self.task.surfaces)
        which = events.which[row, column]
        colours = np.zeros((len(rays), 3))
        of_volume = which == surfaces
        if task.table is not None:
            colours[of_volume] = table_colours(task.table, events.values[row[of_volume], column[of_volume] // (surfaces + 1)])
        for number, surface in enumerate(task.surfaces):
            colours[which == number] = surface.colour
        lit = np.full(len(rays), True) if task.shaded else ~of_volume
        if task.light is None and not lit.any():
            return colours
        places = self.beams.places(rays, events.at[row, column])
        lamp, around = (np.ones(len(rays)),) * 2 if task.light is None else light_at(task.light, places)
        if lit.any():
            assert self.phong is not None
            self.counters["gradients"] += int(lit.sum())
            colours[lit] = self.phong(colours[lit], self.field.slopes(places[lit]), self.beams.along[rays[lit]], lamp[lit], around[lit])
        colours[~lit] *= (lamp * around)[~lit, None]
        return colours

    def _see(self, rays: Numbers, at: Floats) -> None:
        """Depth and normal of rays (n,) at samples (n,)."""
        self.depth[rays] = self.beams.depth[rays] + at * self.beams.step
        if not self.task.normal or not rays.size:
            return
        self.counters["gradients"] += len(rays)
        slopes = self.field.slopes(self.beams.places(rays, at)) / self.task.rays.grid.spacing
        # Towards the eye, of unit length.
        slopes = np.where(np.sum(slopes * self.beams.along[rays], axis=1, keepdims=True) > 0, -slopes, slopes)
        length = np.linalg.norm(slopes, axis=1, keepdims=True)
        self.normal[rays] = slopes / np.where(length > 0, length, 1.0)

    def _show_peaks(self) -> None:
        """The largest value along each ray, opaque, behind what surfaces there are."""
        assert self.task.table is not None
        known = np.flatnonzero(np.isfinite(self.peak))
        if self.task.depth or self.task.normal:
            # As if surfaces of little opacity were not there.
            front = known[self.clear[known] >= 0.5]
            self._see(front, self.peak_at[front])
        self.colour[known] += self.clear[known][:, None] * table_colours(self.task.table, self.peak[known])
        self.clear[known] = 0.0
