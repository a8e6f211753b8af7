"""The rays of a picture as lines through the volume: which samples each of them takes, and where those lie."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fhash_codec.render.task import Task

__all__ = ["Beams", "shares", "slab"]

Floats = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Beams:
    """Many rays. Sample k of one lies at origin + k * pace, within `bounds`; places between samples have fractions of k.

    Attributes:
        origin, pace: (n, 3), of sample 0 and from one sample to the next, x, y, z in vertices of the domain.
        begin, end: (n,), the samples between which the field can have values.
        entered, leaving: (n,), where the ray enters and leaves what the field has values of, in samples.
        last: (n,), the last sample of the whole path, and `rest` the length of its step in steps.
        depth: (n,), of sample 0 from the eye, in units of the coordinates. step: from one sample to the next in those.
        along: (n, 3), unit vectors in physical directions.
    """

    origin: Floats
    pace: Floats
    begin: Numbers
    end: Numbers
    entered: Floats
    leaving: Floats
    last: Numbers
    rest: Floats
    depth: Floats
    along: Floats
    step: float
    bounds: Floats

    @classmethod
    def of(cls, task: Task, within: Floats, rows: range) -> Beams:
        """The rays of rows of the picture, those of a pixel behind one another. within: box (3, 2) that the field has values of."""
        rays, side = task.rays, task.antialiasing
        width, height = rays.size
        j, i, part = (grid.ravel() for grid in np.meshgrid(rows, range(width), range(side * side), indexing="ij"))
        u = 2 * (i + (part % side + 0.5) / side) / width - 1
        w = 1 - 2 * (j + (part // side + 0.5) / side) / height
        eye, direction = rays.rays(u, w)
        direction = direction / np.linalg.norm(direction * rays.grid.spacing, axis=1, keepdims=True)
        enter, leave = slab(eye, direction, rays.grid.bounds)
        first, stop = slab(eye, direction, within)
        hit = (leave > enter) & (stop >= first)
        enter, leave, first, stop = (np.where(hit, end, 0.0) for end in (enter, leave, np.maximum(first, enter), np.minimum(stop, leave)))
        steps = (leave - enter) / task.step
        count = np.ceil(np.minimum(steps, 2.0**62)).astype(np.int64)
        share = shares((j * width + i) * side * side + part) if task.jitter else np.full(len(u), 0.5)
        depth = enter + share * task.step
        entered, leaving = ((place - enter) / task.step - share for place in (first, stop))
        begin = np.where(first > enter, np.ceil(entered), 0.0)
        end = np.where(stop < leave, np.floor(leaving) + 1, count)
        return cls(
            origin=eye + depth[:, None] * direction,
            pace=direction * task.step,
            begin=np.clip(begin, 0, count).astype(np.int64),
            end=np.where(hit, np.clip(end, 0, count), 0).astype(np.int64),
            entered=entered,
            leaving=leaving,
            last=count - 1,
            rest=steps - (count - 1),
            depth=depth,
            along=direction * rays.grid.spacing,
            step=task.step,
            bounds=rays.grid.bounds,
        )

    def places(self, rays: Numbers, at: npt.NDArray[np.int64] | Floats) -> Floats:
        """Places (n, ..., 3) at samples (n, ...) of rays (n,), within the box."""
        extra = (1,) * (at.ndim - 1)
        origin, pace = (part[rays].reshape(-1, *extra, 3) for part in (self.origin, self.pace))
        return np.clip(origin + at[..., None] * pace, self.bounds[:, 0], self.bounds[:, 1])


def slab(origin: Floats, direction: Floats, bounds: Floats) -> tuple[Floats, Floats]:
    """Where rays (n, 3) enter and leave a box (3, 2), in lengths of their direction; leaving is before entering where they miss it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (bounds[None] - origin[..., None]) / direction[..., None]
    inside = (origin >= bounds[:, 0]) & (origin <= bounds[:, 1])
    flat = direction == 0  # along a face: inside or not, without a division
    low = np.where(flat, np.where(inside, -np.inf, np.inf), ends.min(axis=-1))
    high = np.where(flat, np.where(inside, np.inf, -np.inf), ends.max(axis=-1))
    return np.maximum(low.max(axis=1), 0.0), high.min(axis=1)


def shares(numbers: Numbers) -> Floats:
    """A share 0..1 for each number: the hash lowbias32 of C. Wellons (public domain)."""
    x = numbers.astype(np.uint32)
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        x = (x ^ (x >> np.uint32(shift))) * np.uint32(factor)
    x ^= x >> np.uint32(16)
    return np.asarray((x + 0.5) / 2.0**32, dtype=np.float64)
