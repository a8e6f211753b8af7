"""Streamed rays: lines through the volume, their leaps, and the picture that their events make."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from fhash_codec.rendering.bricks import SIDE, Bricks, Palette
from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.light import flatness, slope_scale
from fhash_codec.rendering.march_task import GRADES, NUMPY, Array, Arrays, LightGrid, Lighting, Task
from fhash_codec.rendering.stream_fields import Field, central_slopes

ENDLESS = 2.0**62
"""A number of samples that no ray reaches."""
NEAR = 1e-7
"""Largest distance from a face, in vertices, that is taken for rounding. Rounding moves a place by
less, even where the camera is far away.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Beams:
    """The samples of many rays.

    Sample k of a ray lies at origin + k * pace, or at the nearest place to that at which the field
    has values; where planes cut the box, none lies behind the place where its ray leaves. Places
    between samples have fractions of k. All attributes but `step` and `cut` are arrays of `arrays`,
    float64 unless said otherwise.

    Attributes:
        origin: (n, 3), place of sample 0, x, y, z in vertices of the domain.
        pace: (n, 3), from one sample to the next.
        begin, end: int64 (n,), the samples between which the field can have values, half-open.
        entered, leaving: (n,), where the ray enters and leaves the bounds of the field, in samples.
        last: int64 (n,), the last sample of the whole path.
        rest: (n,), length of the last sample's step, in steps.
        depth: (n,), of sample 0 from the eye, in units of the coordinates.
        along: (n, 3), unit vectors in physical directions.
        step: length from one sample to the next, in units of the coordinates.
        bounds: (3, 2), box in which the field has values.
        inside: (3, 2), the same box, but for faces that a clip makes within the field: behind one
            lies a cell that is not seen, and no sample takes its gradient.
        cut: whether planes cut the box.
    """

    arrays: Arrays
    origin: Array
    pace: Array
    begin: Array
    end: Array
    entered: Array
    leaving: Array
    last: Array
    rest: Array
    depth: Array
    along: Array
    step: float
    bounds: Array
    inside: Array
    cut: bool = False

    @classmethod
    def of(cls, task: Task, within: Array, rows: range, arrays: Arrays = NUMPY) -> Beams:
        """The rays of rows of the picture; the rays of a pixel follow one another.

        within: box (3, 2) in which the field has values.
        """
        xp = arrays.xp
        (width, _), rays_of_pixel = task.rays.size, task.antialiasing**2
        number = rows.start * width * rays_of_pixel + arrays.range(
            len(rows) * width * rays_of_pixel
        )
        eye, direction = _lines(task.rays, number, task.antialiasing, arrays)
        spacing = arrays.array(task.rays.grid.spacing)
        box = arrays.array(task.bounds)
        low = xp.maximum(within[:, 0], box[:, 0])
        # Where nothing is left, nothing, and no box that is turned over.
        high = xp.maximum(xp.minimum(within[:, 1], box[:, 1]), low)
        inner = xp.maximum(xp.where(high < within[:, 1], high - NEAR / 2, high), low)
        inside = xp.stack([low, inner], axis=1)
        within = xp.stack([low, high], axis=1)
        path = _paths(eye, direction, box, within, arrays.array(task.planes), arrays)
        steps = (path.leave - path.enter) / task.step
        count = xp.ceil(xp.clip(steps, None, ENDLESS))
        share = shares(number, arrays) if task.jitter else arrays.full(len(number), 0.5)
        depth = path.enter + share * task.step
        entered, leaving = (
            (place - path.enter) / task.step - share for place in (path.first, path.stop)
        )
        begin = xp.where(path.first > path.enter, xp.ceil(entered), 0.0)
        end = xp.where(path.stop < path.leave, xp.floor(leaving) + 1, count)
        none = 0 * count
        return cls(
            arrays=arrays,
            origin=eye + depth[:, None] * direction,
            pace=direction * task.step,
            begin=arrays.to_int64(xp.clip(begin, none, count)),
            end=arrays.to_int64(xp.where(path.hit, xp.clip(end, none, count), 0.0)),
            entered=entered,
            leaving=leaving,
            last=arrays.to_int64(count) - 1,
            rest=steps - (count - 1),
            depth=depth,
            along=direction * spacing,
            step=task.step,
            bounds=within,
            inside=inside,
            cut=len(task.planes) > 0,
        )

    def places(self, rays: Array, at: Array) -> Array:
        """Places (n, ..., 3) at samples (n, ...) of rays (n,), clipped to the field's bounds."""
        extra = (1,) * (at.ndim - 1)
        origin, pace = (ends[rays].reshape(-1, *extra, 3) for ends in (self.origin, self.pace))
        if self.cut:
            at = self.arrays.xp.minimum(
                self.arrays.to_float64(at), self.leaving[rays].reshape(-1, *extra)
            )
        return self.arrays.xp.clip(
            origin + at[..., None] * pace, self.inside[:, 0], self.inside[:, 1]
        )

    def borders(self, rays: Array, at: Array) -> Array:
        """`places` for the samples at which rays enter or leave, snapped onto the faces.

        Otherwise rounding decides whether a ray meets an isosurface that coincides with a face.
        """
        xp, places = self.arrays.xp, self.places(rays, at)
        for face in (self.bounds[:, 0], self.bounds[:, 1]):
            places = xp.where(xp.abs(places - face) < NEAR, face, places)
        return places


def _lines(rays: Rays, number: Array, side: int, arrays: Arrays) -> tuple[Array, Array]:
    """Origins (n, 3) of rays and directions (n, 3) of unit length in the coordinates.

    number: int64 (n,), numbers of the rays: pixel by pixel, side * side rays for each.
    """
    xp, (width, height), rays_of_pixel = arrays.xp, rays.size, side * side
    pixel, within = number // rays_of_pixel, number % rays_of_pixel
    column = arrays.to_float64(pixel % width) + (arrays.to_float64(within % side) + 0.5) / side
    row = arrays.to_float64(pixel // width) + (arrays.to_float64(within // side) + 0.5) / side
    u, w = 2 * column / width - 1, 1 - 2 * row / height
    right, up, forward, eye, spacing = (
        arrays.array(vector)
        for vector in (rays.right, rays.up, rays.forward, rays.eye, rays.grid.spacing)
    )
    across = u[:, None] * right + w[:, None] * up
    eye, direction = (
        (eye + across, forward + 0 * across)
        if rays.parallel
        else (eye + 0 * across, forward + across)
    )
    return eye, direction / xp.sqrt(xp.sum((direction * spacing) ** 2, axis=1))[:, None]


class _Paths(NamedTuple):
    """Paths of rays, each (n,), as lengths in the coordinates from the rays' origins.

    enter, leave: where the drawn box begins and ends; 0 for rays that do not hit.
    first, stop: where the part of it begins and ends in which the field has values.
    hit: whether there is such a part.
    """

    enter: Array
    leave: Array
    first: Array
    stop: Array
    hit: Array


def _paths(
    eye: Array, direction: Array, box: Array, within: Array, planes: Array, arrays: Arrays
) -> _Paths:
    """The paths of rays through the drawn box and the field's box (3, 2) within it.

    planes: (n, 4), which cut the box.
    """
    xp = arrays.xp
    enter, leave = slab(eye, direction, box, arrays)
    for plane in planes:
        enter, leave = _half_space(eye, direction, plane, enter, leave, arrays)
    first, stop = slab(eye, direction, within, arrays)
    hit = (leave > enter) & (stop > first)
    first, stop = xp.maximum(first, enter), xp.minimum(stop, leave)
    enter, leave, first, stop = (xp.where(hit, end, 0.0) for end in (enter, leave, first, stop))
    return _Paths(enter, leave, first, stop, hit)


def _half_space(
    eye: Array, direction: Array, plane: Array, enter: Array, leave: Array, arrays: Arrays
) -> tuple[Array, Array]:
    """Narrow paths of rays to one side of a plane (4,)."""
    xp, endless = arrays.xp, arrays.full((), np.inf)
    distance = plane[3] - xp.sum(eye * plane[:3], axis=1)
    approach = xp.sum(direction * plane[:3], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = distance / approach
    behind = xp.where(distance > 0, endless, -endless)  # where the ray does not approach
    first = xp.where(approach > 0, at, xp.where(approach < 0, -endless, behind))
    return xp.maximum(enter, first), xp.minimum(leave, xp.where(approach < 0, at, endless))


def slab(origin: Array, direction: Array, bounds: Array, arrays: Arrays) -> tuple[Array, Array]:
    """Entry and exit of rays (n, 3) at a box (3, 2), in lengths of their direction.

    A ray that misses the box leaves it before it enters.
    """
    xp = arrays.xp
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = ((bounds[:, side] - origin) / direction for side in (0, 1))
    inside = (origin >= bounds[:, 0]) & (origin <= bounds[:, 1])
    flat = direction == 0  # along a face: inside or not, without a division
    endless = arrays.full((), np.inf)
    low = xp.where(flat, xp.where(inside, -endless, endless), xp.minimum(near, far))
    high = xp.where(flat, xp.where(inside, endless, -endless), xp.maximum(near, far))
    return xp.clip(xp.amax(low, axis=1), 0.0, None), xp.amin(high, axis=1)


def shares(numbers: Array, arrays: Arrays) -> Array:
    """A share 0..1 for each number: the hash lowbias32 of C. Wellons (public domain)."""
    x = numbers & 0xFFFFFFFF
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        # What overflows int64 is above the 32 bits that count.
        x = ((x ^ (x >> shift)) * factor) & 0xFFFFFFFF
    x = x ^ (x >> 16)
    return (arrays.to_float64(x) + 0.5) / 2.0**32


@dataclass(frozen=True, kw_only=True, eq=False)
class Leaping:
    """The bricks that matter, and how far away they are.

    Attributes:
        distance: int64 (z, y, x), of each brick to the nearest that matters, in bricks, a diagonal
            step counted as one.
        last: (3,), number (x, y, z) of the last brick.
        first: (3,), place (x, y, z) at which the first brick begins.
        side: side of a brick, in vertices of the domain.
    """

    arrays: Arrays
    distance: Array
    last: Array
    first: Array
    side: float

    @classmethod
    def of(cls, bricks: Bricks, task: Task, first: Array, arrays: Arrays) -> Leaping:
        """Leaping for a task: over bricks without a visible value and without a surface.

        task: with the table that samples take.
        """
        distance = bricks.distance(task)
        last = arrays.array(np.array(distance.shape[::-1]) - 1.0)
        return cls(
            arrays=arrays,
            distance=arrays.array(distance, "int64"),
            last=last,
            first=first,
            side=float(SIDE),
        )

    def matters(self, places: Array) -> Array:
        """Whether places (..., 3) lie in bricks that matter."""
        return self.distance[self._bricks(places)[1]] == 0

    def leap(
        self, origin: Array, pace: Array, sample: Array, end: Array, going: Array
    ) -> tuple[Array, Array | int]:
        """The next sample (n,) of each ray, from `sample` on, in a brick that matters, or `end`.

        Also returns the number of leaps that it took.

        origin: places (n, 3) of the samples 0. pace: (n, 3), from one sample to the next.
        going: bool (n,), rays that leap, all of those that the host picked; others stay.
        """
        arrays, xp = self.arrays, self.arrays.xp
        sample = arrays.copy(sample)
        pending = arrays.range(len(sample))
        leaps: Array | int = 0
        while len(pending):
            for _ in range(arrays.leaps):
                brick, index = self._bricks(
                    origin[pending] + sample[pending][:, None] * pace[pending]
                )
                away = self.distance[index]
                leaping = (away > 0) & going
                some = arrays.candidates(leaping)
                pending, brick, away = pending[some], brick[some], away[some][:, None]
                going = leaping[some]
                onward = xp.maximum(
                    self._beyond(origin[pending], pace[pending], brick, away), sample[pending] + 1
                )
                sample[pending] = arrays.kept(
                    going, xp.minimum(onward, end[pending]), sample[pending]
                )
                leaps += xp.count_nonzero(going)
                going = going & (sample[pending] < end[pending])
            (left,) = arrays.nonzero(going)
            pending, going = pending[left], going[left]
        return sample, leaps

    def _beyond(self, start: Array, step: Array, brick: Array, away: Array) -> Array:
        """The first sample (n,) of each ray beyond the cube of bricks in which none matters.

        start: places (n, 3) of the samples 0. step: (n, 3), from one sample to the next.
        brick: numbers (n, 3) of the bricks in the middle of the cubes.
        away: (n, 1), distances of these bricks to the nearest that matters.
        """
        xp = self.arrays.xp
        # The faces of the cube towards which the ray goes.
        face = (
            self.arrays.to_float64(xp.where(step > 0, brick + away, brick - away + 1)) * self.side
            + self.first
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = xp.clip(
                xp.amin(xp.where(step == 0, np.inf, (face - start) / step), axis=1), None, ENDLESS
            )
        return self.arrays.to_int64(xp.floor(reach)) + 1

    def _bricks(self, places: Array) -> tuple[Array, tuple[Array, Array, Array]]:
        """Numbers (..., 3), x, y, z, of the bricks at places, and their index (z, y, x)."""
        at = self.arrays.xp.floor((places - self.first) / self.side)
        brick = self.arrays.to_int64(self.arrays.xp.clip(at, 0 * self.last, self.last))
        return brick, (brick[..., 2], brick[..., 1], brick[..., 0])


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
            slopes = self._slopes(self._phong, places[lit])
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

    def _slopes(self, phong: Phong, places: Array) -> Array:
        """Slopes (n, 3) at places (n, 3) for shading, counted."""
        self.gradients += len(places)
        return phong.slopes(places)


@dataclass(frozen=True, kw_only=True, eq=False)
class Phong:
    """Phong's model, two-sided, with the vector halfway between light and eye (Blinn).

    Attributes:
        lamp: (3,), unit vector towards the light, or None for a light at the eye.
        scale: (3,), factors from derivatives by x, y, z per vertex to gradients, which are shares
            of the table's range per vertex spacing.
        floor: gradient at which the light from a direction has faded by half, so that the noise of
            rounding is not lit.
        field: whose gradients are taken.
        central: whether by central differences.
    """

    arrays: Arrays
    lighting: Lighting
    lamp: Array | None
    scale: Array
    floor: float
    field: Field
    central: bool

    @classmethod
    def of(cls, task: Task, field: Field) -> Phong | None:
        """The model of a task, with the same scales as the native marcher's; None without light."""
        lighting, arrays = task.lighting, field.arrays
        if lighting is None:
            return None
        least, most = field.bricks.value_range
        low, high = (least, most) if task.table is None else (task.table.low, task.table.high)
        span, floor = flatness(low, high, least, most, task.noise)
        return cls(
            arrays=arrays,
            lighting=lighting,
            lamp=None if lighting.lamp is None else arrays.array(lighting.lamp, "float64"),
            scale=arrays.array(slope_scale(task.rays.grid, span, least, most)),
            floor=floor,
            field=field,
            central=lighting.central,
        )

    def slopes(self, places: Array) -> Array:
        """Derivatives (n, 3) by x, y and z per vertex, for shading."""
        return central_slopes(self.field, places) if self.central else self.field.slopes(places)

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


class Factors:
    """The factors of a `Grading`, as a function of places in a field."""

    def __init__(self, field: Field, task: Task) -> None:
        assert task.grading is not None
        arrays = field.arrays
        self._field, self._arrays = field, arrays
        self._central = task.lighting is not None and task.lighting.central
        self._spacing = arrays.array(task.rays.grid.spacing)
        self._scale = GRADES / task.grading.top
        self._factors = arrays.array(
            np.append(task.grading.factors, task.grading.factors[-1]), "float64"
        )

    @classmethod
    def of(cls, task: Task, field: Field) -> Factors | None:
        """The factors of a task in a field; None where gradients decide on no opacity."""
        return None if task.grading is None else cls(field, task)

    def __call__(self, places: Array) -> Array:
        """Factors (n,) of the extinction at places (n, 3) of the domain."""
        xp = self._arrays.xp
        slopes = (
            central_slopes(self._field, places) if self._central else self._field.slopes(places)
        ) / self._spacing
        entry = xp.clip(xp.sqrt(xp.sum(slopes * slopes, axis=1)) * self._scale, 0.0, float(GRADES))
        before = self._arrays.to_int64(entry)
        low, high = xp.take(self._factors, before), xp.take(self._factors, before + 1)
        return low + (entry - self._arrays.to_float64(before)) * (high - low)
