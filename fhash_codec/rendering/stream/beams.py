"""The rays of a picture as lines through the volume: which samples each of them takes, and where those lie."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fhash_codec.rendering.task.arrays import NUMPY, Array, Arrays
from fhash_codec.rendering.task.task import Task

__all__ = ["Beams", "shares", "slab"]

ENDLESS = 2.0**62
"""Samples: more than a ray can have."""
NEAR = 1e-7
"""Vertices: rounding moves a place by less, even where the camera is far away."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Beams:
    """Many rays. Sample k of one lies at origin + k * pace, or the nearest place to that which the field has values of; places between
    samples have fractions of k.

    Attributes:
        origin, pace: (n, 3), of sample 0 and from one sample to the next, x, y, z in vertices of the domain.
        begin, end: (n,), int64, the samples between which the field can have values.
        entered, leaving: (n,), where the ray enters and leaves what the field has values of, in samples.
        last: (n,), int64, the last sample of the whole path, and `rest` the length of its step in steps.
        depth: (n,), of sample 0 from the eye, in units of the coordinates. step: from one sample to the next in those.
        along: (n, 3), unit vectors in physical directions. bounds: (3, 2), of the field. All but `step` are arrays of `arrays`, float64.
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

    @classmethod
    def of(cls, task: Task, within: Array, rows: range, arrays: Arrays = NUMPY) -> Beams:
        """The rays of rows of the picture, those of a pixel behind one another. within: box (3, 2) that the field has values of."""
        xp, rays, side = arrays.xp, task.rays, task.antialiasing
        (width, height), fine = rays.size, side * side
        number = rows.start * width * fine + arrays.range(len(rows) * width * fine)
        pixel, part = number // fine, number % fine
        u = 2 * (arrays.real(pixel % width) + (arrays.real(part % side) + 0.5) / side) / width - 1
        w = (
            1
            - 2 * (arrays.real(pixel // width) + (arrays.real(part // side) + 0.5) / side) / height
        )
        right, up, forward, eye, spacing = (
            arrays.array(part)
            for part in (rays.right, rays.up, rays.forward, rays.eye, rays.grid.spacing)
        )
        across = u[:, None] * right + w[:, None] * up
        eye, direction = (
            (eye + across, forward + 0 * across)
            if rays.parallel
            else (eye + 0 * across, forward + across)
        )
        direction = direction / xp.sqrt(xp.sum((direction * spacing) ** 2, axis=1))[:, None]
        bounds = arrays.array(rays.grid.bounds)
        enter, leave = slab(eye, direction, bounds, arrays)
        first, stop = slab(eye, direction, within, arrays)
        hit = (leave > enter) & (stop > first)
        ends = (enter, leave, xp.maximum(first, enter), xp.minimum(stop, leave))
        enter, leave, first, stop = (xp.where(hit, end, 0.0) for end in ends)
        steps = (leave - enter) / task.step
        count = xp.ceil(xp.clip(steps, None, ENDLESS))
        share = shares(number, arrays) if task.jitter else arrays.full(len(number), 0.5)
        depth = enter + share * task.step
        entered, leaving = ((place - enter) / task.step - share for place in (first, stop))
        begin = xp.where(first > enter, xp.ceil(entered), 0.0)
        end = xp.where(stop < leave, xp.floor(leaving) + 1, count)
        none = 0 * count
        return cls(
            arrays=arrays,
            origin=eye + depth[:, None] * direction,
            pace=direction * task.step,
            begin=arrays.whole(xp.clip(begin, none, count)),
            end=arrays.whole(xp.where(hit, xp.clip(end, none, count), 0.0)),
            entered=entered,
            leaving=leaving,
            last=arrays.whole(count) - 1,
            rest=steps - (count - 1),
            depth=depth,
            along=direction * spacing,
            step=task.step,
            bounds=within,
        )

    def places(self, rays: Array, at: Array) -> Array:
        """Places (n, ..., 3) at samples (n, ...) of rays (n,), within what the field has values of."""
        extra = (1,) * (at.ndim - 1)
        origin, pace = (part[rays].reshape(-1, *extra, 3) for part in (self.origin, self.pace))
        return self.arrays.xp.clip(
            origin + at[..., None] * pace, self.bounds[:, 0], self.bounds[:, 1]
        )

    def borders(self, rays: Array, at: Array) -> Array:
        """The same for where rays enter or leave: what rounding keeps off a face lies on it.

        Of a surface with the value of a whole face that decides whether it is met.
        """
        xp, places = self.arrays.xp, self.places(rays, at)
        for face in (self.bounds[:, 0], self.bounds[:, 1]):
            places = xp.where(xp.abs(places - face) < NEAR, face, places)
        return places


def slab(origin: Array, direction: Array, bounds: Array, arrays: Arrays) -> tuple[Array, Array]:
    """Where rays (n, 3) enter and leave a box (3, 2), in lengths of their direction; leaving is before entering where they miss it."""
    xp = arrays.xp
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = ((bounds[:, side] - origin) / direction for side in (0, 1))
    inside = (origin >= bounds[:, 0]) & (origin <= bounds[:, 1])
    flat = direction == 0  # along a face: inside or not, without a division
    whole, none = arrays.full((), np.inf), arrays.full((), -np.inf)
    low = xp.where(flat, xp.where(inside, none, whole), xp.minimum(near, far))
    high = xp.where(flat, xp.where(inside, whole, none), xp.maximum(near, far))
    return xp.clip(xp.amax(low, axis=1), 0.0, None), xp.amin(high, axis=1)


def shares(numbers: Array, arrays: Arrays) -> Array:
    """A share 0..1 for each number: the hash lowbias32 of C. Wellons (public domain)."""
    x = numbers & 0xFFFFFFFF
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        # What overflows int64 is above the 32 bits that count.
        x = ((x ^ (x >> shift)) * factor) & 0xFFFFFFFF
    x = x ^ (x >> 16)
    return (arrays.real(x) + 0.5) / 2.0**32
