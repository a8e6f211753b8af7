"""Sample streaming: all rays of a picture take samples together, in passes.

The model is evaluated for a whole pass at once. Plain streaming takes one sample of every ray that
is alive in a pass. Adaptive ray marching takes more samples the fewer rays are left, N_s =
clamp(N_r / N_alive, 1, 64) of each ray (paper, algorithm 1).

Both make the same picture, with numpy bit for bit: every number of a sample is computed without the
other samples of the pass (stream_fields.py).

A pass is computed where the field has its values: by numpy on the host, or by torch on a device.
From a device only counts come back before the picture is finished. The host waits for a few of them
in each pass: those that the size of further arrays depends on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np

from fhash_codec.progress import Progress, silent
from fhash_codec.rendering.bricks import SIDE, Palette
from fhash_codec.rendering.light import flatness, slope_scale, smoothing
from fhash_codec.rendering.march_task import (
    Array,
    Arrays,
    LightGrid,
    Lighting,
    Marched,
    Surface,
    Table,
    Task,
    complete,
)
from fhash_codec.rendering.stream_fields import Beams, Factors, Field, Leaping, central_slopes

MAX_SAMPLES = 64
"""Samples of a ray in a pass, at most, as in the paper."""
BAND = 1 << 20
"""Rays that are marched at a time; a larger picture is made in bands of rows."""


def stream(
    field: Field,
    task: Task,
    *,
    adaptive: bool,
    budget: int | None = None,
    progress: Progress = silent,
) -> Marched:
    """March a task's rays through a field, in the field's arrays.

    adaptive: whether to march adaptively; else a pass takes one sample of each ray.
    budget: N_r, samples of a pass of adaptive marching; None for the number of rays.
    Raises InputError where the memory of a device is not enough.
    """
    task = task.marched
    width, height = task.rays.size
    arrays, rays_of_pixel = field.arrays, task.antialiasing**2
    rows = max(1, BAND // (width * rays_of_pixel))
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
                marcher.canvas, (band.stop - band.start, width, rays_of_pixel)
            )
    return Marched(
        rgba=rgba,
        depth=depth if task.depth else None,
        normal=normal if task.normal else None,
        counters=counters,
    )


def _report(progress: Progress, first: int, height: int, done: int, total: int) -> None:
    """Report the rays of a band that are done, as a share of the whole picture."""
    progress("marching", first * total + (height - first) * done, height * total, "")


def _pixels(canvas: Canvas, shape: tuple[int, int, int]) -> tuple[Array, Array, Array]:
    """Colour, depth and normal of pixels, on the host, from rays (rows, width, rays of a pixel).

    The colour is the mean of a pixel's rays; depth and normal are those of the nearest ray.
    """
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
    """The state of a band's rays.

    Attributes:
        next: int64 (n,), the next sample of each ray.
        end: int64 (n,), where each ray ends; with surfaces one place behind the last sample, which
            is the end of the path.
        from_: (n,), the last place that was looked at, in samples.
        before: (n,), the value there. Both are NaN before a ray begins and after it leapt.
        projection: what rays show instead of the volume, None for the volume.
        factors: opacity by gradient, None without it.
    """

    def __init__(self, field: Field, task: Task, beams: Beams) -> None:
        arrays, count = field.arrays, len(beams.end)
        self.field, self.task, self.beams, self.arrays = field, task, beams, arrays
        self.palette = None if task.table is None else Palette.of(task.table, arrays)
        self.canvas = Canvas(field, task, beams, self.palette)
        self.leaping = Leaping.of(field, task)
        # A step longer than a brick could pass through one in which a surface lies, on its way from
        # one in which nothing is visible to another.
        shortest = field.stride * float(np.min(np.abs(task.rays.grid.spacing)))
        short = task.step <= SIDE * shortest
        self.skipping = task.skipping and (short or not task.surfaces)
        # Between two samples in cells without a surface there may be a cell with one: pictures with
        # surfaces look at whole bricks.
        by_cells = self.skipping and not task.surfaces and not task.projection
        self.cells = field.visible(self.palette) if by_cells and self.palette is not None else None
        behind = (beams.leaving > arrays.to_float64(beams.end) - 1) & (beams.end > beams.begin)
        self.end = beams.end + arrays.to_int64(behind) if task.surfaces else beams.end
        self._one = arrays.full((), 1.0)
        self.next = arrays.copy(beams.begin)
        self.from_, self.before = arrays.copy(beams.entered), arrays.full(count, np.nan)
        self.projection = (
            Projection(task.projection, task.table, count, arrays)
            if task.projection and task.table is not None
            else None
        )
        self.factors = None if task.grading is None else Factors(field, task, task.grading)
        self.counters = complete({"rays": int(arrays.xp.count_nonzero(beams.end > beams.begin))})

    def march(self, adaptive: bool, budget: int | None, report: Callable[[int, int], None]) -> None:
        """Take passes until no ray is alive. report: function of the rays done and their number."""
        # N_r counts all rays that the camera sends, also those that miss.
        budget = len(self.next) if budget is None else budget
        (alive,) = self.arrays.nonzero(self.next < self.end)
        total = max(len(alive), 1)
        while len(alive):
            self._leap(alive)
            left = self.end[alive] - self.next[alive]
            count, longest = self.arrays.counts(self.arrays.xp.count_nonzero(left > 0), left.max())
            alive = alive[self.arrays.chosen(left > 0, count)]
            if count:
                pace = int(min(max(budget // count, 1), MAX_SAMPLES)) if adaptive else 1
                self._pass(alive, min(pace, longest))
                self._end_finished(alive)
            report(total - count, total)
        if self.projection is not None:
            self.canvas.show_values(self.projection.values, self.projection.at)

    def _end_finished(self, alive: Array) -> None:
        """Let rays end that no light comes through, or whose projection no sample can change."""
        finished = self.canvas.clear[alive] < self.task.threshold
        if self.projection is not None:
            finished = finished | self.projection.finished(alive)
        self.next[alive] = self.arrays.xp.where(finished, self.end[alive], self.next[alive])

    def _leap(self, alive: Array) -> None:
        """Move rays on to their next sample in a brick that matters, or to their end."""
        if not self.skipping:
            return
        arrays, xp = self.arrays, self.arrays.xp
        going = self.next[alive] < self.end[alive]
        if self.task.surfaces:
            # A surface may lie between the last sample inside a brick and the first one outside it.
            near = going & ~xp.isnan(self.from_[alive])
            some = arrays.candidates(near)
            at = arrays.kept(near, self.from_[alive[some]], 0.0)
            near[some] &= self.leaping.matters(self.beams.places(alive[some], at))
            going = going & ~near
        some = arrays.candidates(going)
        leapers = alive[some]
        before = self.next[leapers]
        reached, leaps = self.leaping.leap(
            self.beams.origin[leapers],
            self.beams.pace[leapers],
            before,
            self.end[leapers],
            going[some],
        )
        self.counters["skipped_bricks"] += leaps
        if self.task.surfaces:
            for array in (self.before, self.from_):
                array[leapers] = xp.where(reached > before, np.nan, array[leapers])
        self.next[leapers] = reached

    def _pass(self, alive: Array, pace: int) -> None:
        """Take `pace` samples of each ray."""
        arrays = self.arrays
        sample = self.next[alive][:, None] + arrays.range(pace)
        places = self.beams.places(alive, sample)
        requested = self._requested(sample < self.beams.end[alive][:, None], places)
        values = self._looked_up(places, requested)
        self.counters["passes"] += 1
        self.next[alive] += pace
        if self.projection is not None:
            assert self.palette is not None
            length = self._length(alive, sample)
            opacity = self._opacity(self.palette, alive, sample, values)
            self.projection.add(alive, sample, values, length, opacity)
        if self.task.surfaces or self.projection is None:
            self.canvas.add(alive, self._events(alive, sample, values))

    def _requested(self, within: Array, places: Array) -> Array:
        """The samples (rays, samples) of a pass whose values are needed.

        within: the samples that lie on their rays' paths. places: (rays, samples, 3).
        """
        if self.cells is not None:
            flat = within.reshape(-1)
            some = self.arrays.candidates(flat)
            flat[some] &= self._visible(places.reshape(-1, 3)[some])
            return within
        if not self.skipping or within.shape[1] == 1:
            return within
        needed = self.leaping.matters(places)
        if self.task.surfaces:
            # A surface may lie between a sample in a brick that matters and the sample before or
            # after it, which is in none.
            matters, needed[:, 0] = self.arrays.copy(needed), True
            needed[:, :-1] = needed[:, :-1] | matters[:, 1:]
            needed[:, 1:] = needed[:, 1:] | matters[:, :-1]
        return within & needed

    def _visible(self, places: Array) -> Array:
        """Whether places (n, 3) lie in visible cells."""
        assert self.cells is not None
        z, y, x = self.cells.shape
        at = self.arrays.to_int64((places - self.field.first) / self.field.stride)
        i, j, k = (
            self.arrays.xp.clip(at[:, axis], 0, size - 1) for axis, size in enumerate((x, y, z))
        )
        return self.arrays.xp.take(self.cells, (k * y + j) * x + i)

    def _looked_up(self, places: Array, wanted: Array) -> Array:
        """Values (rays, samples) at places (rays, samples, 3), counted; NaN where not wanted."""
        arrays, flat = self.arrays, wanted.reshape(-1)
        some, values = arrays.candidates(flat), arrays.full(flat.shape, np.nan)
        counted = flat[some]
        values[some] = looked_up = self.field.values(places.reshape(-1, 3)[some], counted)
        self._count(counted, looked_up)
        return values.reshape(wanted.shape)

    def _count(self, counted: Array, values: Array) -> None:
        """Count the samples of a mask (n,), and those of them that have a value."""
        count = self.arrays.xp.count_nonzero
        self.counters["samples"] += count(counted)
        self.counters["evaluations"] += count(counted & ~self.arrays.xp.isnan(values))

    def _events(self, alive: Array, sample: Array, values: Array) -> Events:
        """The events of a pass. sample: int64 (rays, samples). values: (rays, samples)."""
        task, arrays, xp = self.task, self.arrays, self.arrays.xp
        surfaces, rows = len(task.surfaces), len(alive)
        shape = (*sample.shape, surfaces + 1)
        opacity = arrays.full(shape, 0.0)
        at = arrays.to_float64(xp.broadcast_to(sample[..., None], shape))
        which = xp.broadcast_to(arrays.range(surfaces + 1), shape)
        if task.surfaces:
            at[..., :-1], opacity[..., :-1], number = self._crossings(alive, sample, values)
            which = xp.concatenate([number, which[..., -1:]], axis=2)
        if self.palette is not None and not task.projection:
            opacity[..., -1] = self._opacity(self.palette, alive, sample, values)
        return Events(
            opacity=opacity.reshape(rows, -1),
            at=at.reshape(rows, -1),
            which=which.reshape(rows, -1),
            values=values,
        )

    def _crossings(self, alive: Array, sample: Array, values: Array) -> tuple[Array, Array, Array]:
        """The surfaces before each sample, as `crossings` has them.

        Before the first sample of a ray they are looked for from where it enters the field, behind
        the last one to where it leaves.
        """
        beams, arrays, xp = self.beams, self.arrays, self.arrays.xp
        leaving, places = beams.leaving[alive][:, None], arrays.to_float64(sample)
        to = xp.minimum(places, leaving)
        beyond = (places >= leaving) & (sample < self.end[alive][:, None])
        before = self.before[alive]
        entering = xp.isnan(before)
        first = arrays.to_float64(self.next[alive] - sample.shape[1] - 1)
        first = xp.where(entering, xp.maximum(first, beams.entered[alive]), self.from_[alive])
        at = xp.concatenate([first[:, None], to], axis=1)
        wanted = xp.concatenate([entering[:, None], beyond], axis=1)
        known = xp.concatenate([before[:, None], values], axis=1)
        looked_up = self._looked_up(beams.borders(alive, at), wanted)

        def between(row: Array, place: Array, counted: Array) -> Array:
            looked_up = self.field.values(beams.places(alive[row], place))
            self._count(counted, looked_up)
            return looked_up

        known = xp.where(wanted, looked_up, known)
        result = crossings(between, at, known, self.task.surfaces, arrays)
        self.before[alive], self.from_[alive] = known[:, -1], to[:, -1]
        return result

    def _length(self, alive: Array, sample: Array) -> Array:
        """Lengths (rays, samples) of steps, in steps: 1, and the rest of the path for the last."""
        beams, xp = self.beams, self.arrays.xp
        return xp.where(sample == beams.last[alive][:, None], beams.rest[alive][:, None], self._one)

    def _opacity(self, palette: Palette, alive: Array, sample: Array, values: Array) -> Array:
        """Opacities (rays, samples), 0 where there is no value. The last step may be shorter."""
        arrays, xp = self.arrays, self.arrays.xp
        flat = values.reshape(-1)
        known = ~xp.isnan(flat)
        some = arrays.candidates(known)
        length = self._length(alive, sample).reshape(-1)[some] * self.task.step
        depth = palette.extinction(arrays.kept(known, flat[some], palette.low)) * length
        depth = arrays.kept(known, depth, 0.0)
        if self.factors is not None:
            (thick,) = arrays.nonzero(depth > 0)
            number = arrays.range(len(flat))[some][thick]
            at = arrays.to_float64(sample.reshape(-1)[number])
            rays = alive[number // sample.shape[1]]
            depth[thick] *= self.factors(self.beams.places(rays, at))
            self.counters["gradients"] += len(thick)
        opacity = arrays.full(flat.shape, 0.0)
        opacity[some] = -xp.expm1(-depth)
        return opacity.reshape(values.shape)


class Projection:
    """The projected values of rays as far as they are marched.

    Attributes:
        at: (n,), places of the values, in samples; of the first value for the mean.
    """

    def __init__(self, kind: str, table: Table, count: int, arrays: Arrays) -> None:
        self._kind, self._ends, self._arrays = kind, (table.low, table.high), arrays
        self.at = arrays.full(count, 0.0)
        # The best rank so far: of a maximum the value, of a minimum the value times -1, of an
        # attenuated maximum the share of the colours that is left; for the mean minus the place.
        self._best = arrays.full(count, 0.0 if kind == "attenuated" else -np.inf)
        # The light that is left, for the attenuated maximum; sum and length for the mean.
        self._light = arrays.full(count, 1.0)
        self._sum, self._length = arrays.full(count, 0.0), arrays.full(count, 0.0)

    @property
    def values(self) -> Array:
        """Values (n,) that the rays show; not finite where a ray met none."""
        xp, nothing = self._arrays.xp, self._arrays.full((), np.nan)
        if self._kind == "minimum":
            return -self._best
        if self._kind == "average":
            seen = self._length > 0
            return xp.where(seen, self._sum / xp.where(seen, self._length, 1.0), nothing)
        if self._kind == "attenuated":
            low, high = self._ends
            return xp.where(self._best > 0, low + self._best * (high - low), nothing)
        return self._best

    def finished(self, alive: Array) -> Array:
        """Whether rays (n,) cannot meet a value any more that they would show."""
        if self._kind == "attenuated":
            return self._light[alive] <= self._best[alive]
        return self._best[alive] == np.inf  # never

    def add(
        self, alive: Array, sample: Array, values: Array, length: Array, opacity: Array
    ) -> None:
        """Add the samples of a pass.

        Args:
            alive: numbers (rays,) of the rays.
            sample: int64 (rays, samples), numbers of the samples.
            values: (rays, samples), NaN where there is none.
            length: (rays, samples), of the steps, in steps.
            opacity: (rays, samples), 0 where there is no value.
        """
        arrays, xp = self._arrays, self._arrays.xp
        known, place = ~xp.isnan(values), arrays.to_float64(sample)
        if self._kind == "average":
            weight = xp.where(known, length, 0.0)
            for column in range(sample.shape[1]):  # so the sum does not depend on the passes
                self._sum[alive] += weight[:, column] * xp.nan_to_num(values[:, column])
                self._length[alive] += weight[:, column]
            rank = xp.where(known, -place, -np.inf)
        elif self._kind == "attenuated":
            low, high = self._ends
            share = xp.clip((xp.nan_to_num(values) - low) / (high - low), 0.0, 1.0)
            left = xp.cumprod(
                xp.concatenate([self._light[alive][:, None], 1 - opacity], axis=1), axis=1
            )
            self._light[alive] = left[:, -1]
            rank = xp.where(known, share * left[:, :-1], 0.0)
        else:
            sign = -1.0 if self._kind == "minimum" else 1.0
            rank = xp.where(known, sign * values, -np.inf)
        best = xp.argmax(rank, axis=1)[:, None]
        rank, place = (arrays.take_along(array, best, 1)[:, 0] for array in (rank, place))
        best_before, at_before = self._best[alive], self.at[alive]
        better = rank > best_before
        self._best[alive] = xp.where(better, rank, best_before)
        self.at[alive] = xp.where(better, place, at_before)


CLOSE = 1e-8
"""Distance, in samples. A root is found when the last turn moved it by no more, or when the
interval that holds it is no wider.
"""
MAX_TURNS = 60
"""Turns of the search for a root, at most."""


def crossings(
    values: Callable[[Array, Array, Array], Array],
    at: Array,
    steps: Array,
    surfaces: Sequence[Surface],
    arrays: Arrays,
) -> tuple[Array, Array, Array]:
    """The crossings before each sample of a pass, the nearest first, as many as surfaces.

    values: function of rows (n,) of the pass, places (n,) in samples, and which of them count, bool
        (n,); values (n,) there.
    at: (rays, 1 + samples), places of the samples and, first, of the one before the pass.
    steps: (rays, 1 + samples), the values there, NaN where there is none.

    Returns their places in samples of the ray, their opacities, 0 where there is no crossing, and
    the numbers of the surfaces, int64, each (rays, samples, surfaces).
    """
    xp = arrays.xp
    shape = (len(at), at.shape[1] - 1, len(surfaces))
    places, opacity = arrays.full(shape, np.inf), arrays.full(shape, 0.0)
    before, after = steps[:, :-1], steps[:, 1:]
    both = ~xp.isnan(before) & ~xp.isnan(after)
    crossed = [both & ((before < each.value) != (after < each.value)) for each in surfaces]
    row, column, number = arrays.nonzero(xp.stack(crossed, axis=2))
    if len(row):
        level, share = (arrays.full(len(row), 0.0) for _ in range(2))
        for count, surface in enumerate(surfaces):
            level = xp.where(number == count, surface.value, level)
            share = xp.where(number == count, surface.opacity, share)

        def above(chosen: Array, place: Array, counted: Array) -> Array:
            return values(row[chosen], place, counted) - level[chosen]

        ends = before[row, column] - level, after[row, column] - level
        root = _roots(above, at[row, column], at[row, column + 1], *ends, arrays)
        exists = xp.isfinite(root)
        places[row, column, number] = xp.where(exists, root, np.inf)
        opacity[row, column, number] = xp.where(exists, share, 0.0)
    which = xp.argsort(places, axis=2, stable=True)
    places, opacity = (arrays.take_along(array, which, 2) for array in (places, opacity))
    return xp.where(xp.isfinite(places), places, 0.0), opacity, which


def _roots(
    function: Callable[[Array, Array, Array], Array],
    near: Array,
    far: Array,
    at_near: Array,
    at_far: Array,
    arrays: Arrays,
) -> Array:
    """Roots of a function between places, where its values have two signs.

    function: values (m,) for numbers (m,) of the roots searched for, places (m,), and which of them
        are searched for still, bool (m,).
    near, far: places (n,) around the roots. at_near, at_far: values (n,) there.
    The result is NaN where the search met a place without a value.
    """
    xp = arrays.xp
    near, far, at_near, at_far = (arrays.copy(array) for array in (near, far, at_near, at_far))
    root = xp.where(at_far == 0, far, near)
    (going,) = arrays.nonzero((at_near != 0) & (at_far != 0))
    for _ in range(0, MAX_TURNS, arrays.turns):
        if not len(going):
            break
        active = going >= 0
        for _ in range(arrays.turns):
            place = far[going] - at_far[going] * (far[going] - near[going]) / (
                at_far[going] - at_near[going]
            )
            place = arrays.kept(active, place, far[going])
            value = function(going, place, active)
            root[going] = arrays.kept(active, xp.where(xp.isnan(value), np.nan, place), root[going])
            same = (value < 0) == (at_far[going] < 0)
            moved = xp.abs(place - far[going])
            # The end that stays twice has its value halved, so that the other one moves, too.
            halved = xp.where(same, at_near[going] / 2, at_far[going])
            at_near[going] = arrays.kept(active, halved, at_near[going])
            near[going] = arrays.kept(active, xp.where(same, near[going], far[going]), near[going])
            far[going] = place
            at_far[going] = arrays.kept(active, value, at_far[going])
            active = (
                active
                & (moved > CLOSE)
                & (xp.abs(far[going] - near[going]) > CLOSE)
                & (value != 0)
                & ~xp.isnan(value)
            )
        going = going[arrays.nonzero(active)]
    return root


@dataclass(frozen=True, kw_only=True, eq=False)
class Events:
    """Events along the rays of a pass, the nearest first: surfaces, then the sample behind them.

    With s surfaces a ray has s + 1 events for each sample.

    Attributes:
        opacity: (rays, events), 0 where there is nothing.
        at: (rays, events), places in samples of the ray.
        which: int64 (rays, events), number of the surface; s for the volume.
        values: (rays, samples), values of the samples.
    """

    opacity: Array
    at: Array
    which: Array
    values: Array


class Canvas:
    """The picture of a band of rays as far as it is marched.

    Attributes:
        colour: (n, 3), colours, multiplied by the opacity.
        clear: (n,), share of the light behind that comes through.
        depth: (n,), distance from the eye; infinity where nothing was seen.
        normal: (n, 3), unit vectors towards the eye; 0 where nothing was seen.
        gradients: number of gradients that were evaluated.
    """

    def __init__(self, field: Field, task: Task, beams: Beams, palette: Palette | None) -> None:
        self.field, self.task, self.beams, self.palette = field, task, beams, palette
        self.arrays = field.arrays
        count = len(beams.end)
        self.colour, self.clear = self.arrays.full((count, 3), 0.0), self.arrays.full(count, 1.0)
        self.depth, self.normal = self.arrays.full(count, np.inf), self.arrays.full((count, 3), 0.0)
        self.gradients = 0
        self._phong = Phong.of(task, field)
        self._light = None if task.light is None else LightAt(task.light, self.arrays)
        self._surfaces = [self.arrays.array(surface.colour, "float64") for surface in task.surfaces]
        self._spacing = self.arrays.array(task.rays.grid.spacing)

    def add(self, alive: Array, events: Events) -> None:
        """Join the events of a pass to its rays, front to back. alive: numbers of the rays."""
        arrays, xp = self.arrays, self.arrays.xp
        per_sample = len(self._surfaces) + 1
        # Light behind each event; the first column is what was left before the pass.
        left = xp.cumprod(
            xp.concatenate([self.clear[alive][:, None], 1 - events.opacity], axis=1), axis=1
        )
        # A ray ends after a sample, never between a surface and the sample behind it.
        ended = left[:, :-1:per_sample] < self.task.threshold
        ended[:, 0] = False
        ended = xp.broadcast_to(ended[..., None], (*ended.shape, per_sample)).reshape(
            events.opacity.shape
        )
        weight = xp.where(ended, 0.0, left[:, :-1] * events.opacity)
        after = xp.where(ended, np.inf, left[:, 1:])
        self.clear[alive] = xp.amin(after, axis=1)
        row, column = arrays.nonzero(weight)
        if not len(row):
            return
        # One event of a ray after the other: so the sum does not depend on the number of passes.
        arrays.add_rows(
            self.colour,
            alive[row],
            self._colours(alive[row], events, row, column) * weight[row, column][:, None],
        )
        if self.task.depth or self.task.normal:
            behind = after < 0.5
            (new,) = arrays.nonzero(xp.isinf(self.depth[alive]) & xp.any(behind, axis=1))
            event = xp.argmax(arrays.to_int64(behind[new]), axis=1)
            self.see(alive[new], arrays.take_along(events.at[new], event[:, None], 1)[:, 0])

    def see(self, rays: Array, at: Array) -> None:
        """Set depth and normal of rays (n,) at samples (n,)."""
        xp = self.arrays.xp
        self.depth[rays] = self.beams.depth[rays] + at * self.beams.step
        if not self.task.normal or not len(rays):
            return
        self.gradients += len(rays)
        slopes = self.field.slopes(self.beams.places(rays, at)) / self._spacing
        # Towards the eye, of unit length.
        slopes = xp.where(
            xp.sum(slopes * self.beams.along[rays], axis=1)[:, None] > 0, -slopes, slopes
        )
        length = xp.sqrt(xp.sum(slopes * slopes, axis=1))[:, None]
        self.normal[rays] = slopes / xp.where(length > 0, length, 1.0)

    def show_values(self, values: Array, at: Array) -> None:
        """Draw one value along each ray, opaque, behind the surfaces that are there.

        values: (n,); rays whose value is not finite show nothing.
        at: (n,), their places in samples.
        """
        assert self.palette is not None
        (shown,) = self.arrays.nonzero(self.arrays.xp.isfinite(values))
        if self.task.depth or self.task.normal:
            # As if surfaces of little opacity were not there.
            front = shown[self.clear[shown] >= 0.5]
            self.see(front, at[front])
        self.colour[shown] += self.clear[shown][:, None] * self.palette.colour(values[shown])
        self.clear[shown] = 0.0

    def _colours(self, rays: Array, events: Events, row: Array, column: Array) -> Array:
        """Lit colours (n, 3) of events (row, column) of rays (n,)."""
        arrays, which = self.arrays, events.which[row, column]
        colours = self._unlit(events, row, column, which)
        lit = self._lit(which)
        if self._light is None and lit is None:
            return colours
        places = self.beams.places(rays, events.at[row, column])
        lamp, around = (
            (arrays.full(len(rays), 1.0),) * 2 if self._light is None else self._light(places)
        )
        result = colours * (lamp * around)[:, None]
        if lit is not None:
            assert self._phong is not None
            self.gradients += len(places[lit])
            slopes = self._phong.slopes(places[lit])
            result[lit] = self._phong(
                colours[lit], slopes, self.beams.along[rays[lit]], lamp[lit], around[lit]
            )
        return result

    def _lit(self, which: Array) -> Array | None:
        """Index of the events that are lit by their gradient; None where none is."""
        if self.task.shaded:
            return slice(None)
        if not self._surfaces:
            return None
        (lit,) = self.arrays.nonzero(which < len(self._surfaces))
        return lit if len(lit) else None

    def _unlit(self, events: Events, row: Array, column: Array, which: Array) -> Array:
        """Colours (n, 3) of events without light."""
        arrays, surfaces = self.arrays, len(self._surfaces)
        if self.palette is not None and not surfaces:
            return self.palette.colour(events.values[row, column])
        colours = arrays.full((len(row), 3), 0.0)
        if self.palette is not None:
            of_volume = which == surfaces
            some = arrays.candidates(of_volume)
            values = events.values[row[some], column[some] // (surfaces + 1)]
            values = arrays.kept(of_volume, values, self.palette.low)
            colours[some] = self.palette.colour(values)
        for number, colour in enumerate(self._surfaces):
            colours = arrays.xp.where((which == number)[:, None], colour, colours)
        return colours


@dataclass(frozen=True, kw_only=True, eq=False)
class Phong:
    """Phong's model, two-sided, with the vector halfway between light and eye (Blinn).

    Attributes:
        lamp: (3,), unit vector towards the light, or None for a light at the eye.
        scale: (3,), factors from derivatives by x, y, z per vertex to gradients, which are shares
            of the table's range per vertex spacing.
        floor: gradient at which the light from a direction has faded by half, so that the noise of
            rounding is not lit.
        field: whose gradients are taken where `differences` is None or has none.
        differences: the field whose central differences are taken.
    """

    arrays: Arrays
    lighting: Lighting
    lamp: Array | None
    scale: Array
    floor: float
    field: Field
    differences: Field | None

    @classmethod
    def of(cls, task: Task, field: Field) -> Phong | None:
        """The model of a task, with the same scales as the native marcher's; None without light."""
        lighting, arrays = task.lighting, field.arrays
        if lighting is None:
            return None
        least, most = field.bricks.value_range
        low, high = (least, most) if task.table is None else (task.table.low, task.table.high)
        span, floor = flatness(low, high, least, most, task.noise)
        deviation = smoothing(span, task.noise)
        smooth = field.smoothed(deviation, task.error) if deviation else None
        return cls(
            arrays=arrays,
            lighting=lighting,
            lamp=None if lighting.lamp is None else arrays.array(lighting.lamp, "float64"),
            scale=arrays.array(slope_scale(task.rays.grid, span, least, most)),
            floor=floor,
            field=field,
            differences=smooth or (field if lighting.central else None),
        )

    def slopes(self, places: Array) -> Array:
        """Derivatives (n, 3) by x, y and z per vertex, for shading."""
        if self.differences is None:
            return self.field.slopes(places)
        return central_slopes(self.differences, places, self.field)

    def __call__(
        self, colours: Array, slopes: Array, along: Array, lamp: Array, around: Array
    ) -> Array:
        """Lit colours (n, 3): ambient and scattered light in the colour, mirrored light in white.

        Where the gradient vanishes, only the ambient light is left.

        slopes: derivatives (n, 3) by x, y, z per vertex.
        along: unit vectors (n, 3) of the rays.
        lamp, around: shares (n,) of the light that arrive from the lamp and from around.
        """
        xp, lighting = self.arrays.xp, self.lighting
        gradient = slopes * self.scale
        normal = gradient / xp.sqrt(xp.sum(gradient * gradient, axis=1) + self.floor**2)[:, None]
        towards = -along if self.lamp is None else xp.broadcast_to(self.lamp, along.shape)
        half = towards - along
        length = xp.sqrt(xp.sum(half * half, axis=1))[:, None]
        # Light from straight behind has no highlight.
        half = xp.where(length > 1e-6, half / xp.where(length > 1e-6, length, 1.0), 0.0)
        scattered = xp.clip(xp.abs(xp.sum(normal * towards, axis=1)), None, 1.0)
        mirrored = (
            xp.clip(xp.abs(xp.sum(normal * half, axis=1)), None, 1.0) ** lighting.specular_power
        )
        share = around * lighting.ambient + lamp * scattered * lighting.diffuse
        return colours * share[:, None] + (lamp * mirrored * lighting.specular)[:, None]


class LightAt:
    """A `LightGrid` in arrays of `arrays`, as a function of places."""

    def __init__(self, grid: LightGrid, arrays: Arrays) -> None:
        self._arrays, self._cell = arrays, float(grid.cell)
        self._shares = arrays.array(grid.shares, "float64")
        self._first = arrays.array(grid.first, "float64")
        self._last = arrays.array([count - 1.0 for count in grid.shares.shape[2::-1]])

    def __call__(self, places: Array) -> tuple[Array, Array]:
        """Shares (n,) of the light from the lamp and from around that reach places (n, 3).

        places: x, y, z in vertices of the domain. Shares are trilinear, clamped beyond the grid.
        """
        arrays, xp, last = self._arrays, self._arrays.xp, self._last
        at = xp.clip((places - self._first) / self._cell, 0 * last, last)
        before = xp.minimum(xp.floor(at), xp.clip(last - 1, 0.0, None))
        x, y, z = (at - before).T
        low, high = arrays.to_int64(before), arrays.to_int64(xp.minimum(before + 1, last))
        shares = arrays.full((len(places), 2), 0.0)
        for corner in product((0, 1), repeat=3):
            k, j, i = (
                (high if up else low)[:, axis] for up, axis in zip(corner, (2, 1, 0), strict=True)
            )
            weight = (
                (z if corner[0] else 1 - z)
                * (y if corner[1] else 1 - y)
                * (x if corner[2] else 1 - x)
            )
            shares += weight[:, None] * self._shares[k, j, i]
        return shares[:, 0], shares[:, 1]
