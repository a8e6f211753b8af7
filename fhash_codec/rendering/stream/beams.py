"""The rays of a picture as lines through the volume, and their leaps over invisible bricks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fhash_codec.rendering.camera.camera import Rays
from fhash_codec.rendering.task.arrays import NUMPY, Array, Arrays
from fhash_codec.rendering.task.bricks import SIDE, Bricks
from fhash_codec.rendering.task.task import Task

__all__ = ["ENDLESS", "Beams", "Leaping", "shares", "slab"]

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
