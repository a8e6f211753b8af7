"""Pictures in float64, ray by ray, as `fhash_codec.rendering.march_task` defines them.

The oracle has no packets, skips no empty space and ends no ray early.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.march_task import Frame, Task

__all__ = ["reference_picture"]

Floats = npt.NDArray[np.float64]

SNAP = 1e-9
"""Distance from a vertex, in vertex spacings, below which a coordinate is that of the vertex."""
HALVINGS = 60
"""Bisections of the search for the position of a surface."""


def reference_picture(frame: Frame, task: Task) -> Floats:
    """The picture (H, W, 4) of an unshaded volume and surfaces of one colour each, with
    premultiplied opacity.

    Rays do not end at a threshold of opacity.
    """
    width, height = task.rays.size
    eyes, directions = task.rays.pixels()
    picture = np.zeros((height, width, 4))
    for pixel in np.ndindex(height, width):
        picture[pixel] = _ray(frame, task, eyes[pixel], directions[pixel])
    return picture


def _ray(frame: Frame, task: Task, eye: Floats, direction: Floats) -> Floats:
    grid = task.rays.grid
    direction = direction / np.linalg.norm(direction * grid.spacing)
    enter, leave = _within(eye, direction, grid.bounds)
    if not enter < leave:
        return np.zeros(4)
    steps = (leave - enter) / task.step
    count = int(np.ceil(steps))
    at = enter + (np.arange(count) + 0.5) * task.step
    lengths = np.full(count, task.step)
    lengths[-1] = (steps - (count - 1)) * task.step
    # Surfaces exist within the frame only, which may be smaller than the drawn box.
    counts = np.array(frame.values.shape[::-1])
    first = np.array(frame.first[::-1], dtype=np.float64)
    seen = np.where(
        (counts == 1)[:, None],
        grid.bounds,
        np.stack([first, first + (counts - 1) * frame.stride], axis=-1),
    )
    entered, left_at = _within(eye, direction, seen)

    def value(distances: npt.NDArray[np.floating[Any]]) -> Floats:
        return _trilinear(
            frame,
            np.clip(eye + distances[:, None] * direction, grid.bounds[:, 0], grid.bounds[:, 1]),
        )

    colour, left = np.zeros(3), 1.0
    values = value(at)
    # A sample beyond the box is seen only where the ray leaves the box within the frame.
    reached = np.minimum(at, leave)
    values[(reached < entered - SNAP) | (reached > left_at + SNAP)] = np.nan
    ends = np.concatenate(
        [[entered], np.clip(at, entered, max(entered, left_at)), [max(entered, left_at)]]
    )
    crossings = [_crossings(value, ends, value(ends), surface.value) for surface in task.surfaces]
    for sample in range(count + 1):
        # The surfaces between the previous sample and this one, nearest first, then the sample.
        between = sorted(
            (places[sample], number)
            for number, places in enumerate(crossings)
            if np.isfinite(places[sample])
        )
        for _, number in between:
            surface = task.surfaces[number]
            colour, left = (
                colour + left * surface.opacity * surface.colour,
                left * (1 - surface.opacity),
            )
        if sample < count and task.table is not None and not np.isnan(values[sample]):
            table = task.table
            entry = np.clip((values[sample] - table.low) / (table.high - table.low), 0, 1) * (
                len(table.extinctions) - 1
            )
            numbers = np.arange(len(table.extinctions))
            opacity = -np.expm1(-np.interp(entry, numbers, table.extinctions) * lengths[sample])
            emitted = np.array(
                [np.interp(entry, numbers, table.colours[:, channel]) for channel in range(3)]
            )
            colour, left = colour + left * opacity * emitted, left * (1 - opacity)
    return np.array([*colour, 1 - left])


def _within(eye: Floats, direction: Floats, bounds: Floats) -> tuple[float, float]:
    """The distances at which a ray enters a box (3, 2) in front of the eye and leaves it; both 0 if
    it misses the box."""
    enter, leave = 0.0, np.inf
    for axis, (low, high) in enumerate(bounds):
        if direction[axis] == 0:
            if not low <= eye[axis] <= high:
                return 0.0, 0.0
            continue
        one, two = sorted(
            ((low - eye[axis]) / direction[axis], (high - eye[axis]) / direction[axis])
        )
        enter, leave = max(enter, float(one)), min(leave, float(two))
    return (enter, leave) if enter < leave else (0.0, 0.0)


def _crossings(
    value: Callable[[Floats], Floats], ends: Floats, values: Floats, level: float
) -> Floats:
    """The position of an isosurface in each interval of a ray, (n - 1,); infinite where there is
    none or values are missing.

    Args:
        value: returns the values at distances along the ray.
        ends: distances (n,) of the ends of the intervals.
        values: values (n,) at these ends.
        level: value of the isosurface.
    """
    places = np.full(len(ends) - 1, np.inf)
    below = values < level
    finite = ~np.isnan(values)
    for number in np.flatnonzero((below[1:] != below[:-1]) & finite[1:] & finite[:-1]):
        near, far = ends[number], ends[number + 1]
        for _ in range(HALVINGS):
            middle = (near + far) / 2
            if (value(np.array([middle]))[0] < level) == below[number]:
                near = middle
            else:
                far = middle
        if not np.isnan(value(np.array([near, far]))).any():
            places[number] = far
    return places


def _trilinear(frame: Frame, places: Floats) -> Floats:
    """Values (n,) at places (n, 3), which are x, y, z in vertices of the domain.

    A value is NaN outside the frame, and where a vertex with a weight above 0 is NaN.
    """
    counts = np.array(frame.values.shape[::-1])
    local = (places - np.array(frame.first[::-1])) / frame.stride
    # A place on a face of the frame counts as on it, whatever its rounding.
    local = np.where(np.abs(local - np.rint(local)) < SNAP, np.rint(local), local)
    outside = np.any(((local < 0) | (local > counts - 1)) & (counts > 1), axis=1)
    local = np.clip(local, 0, counts - 1.0)
    before = np.minimum(local.astype(np.int64), np.maximum(counts - 2, 0))
    share = local - before
    after = np.minimum(before + 1, counts - 1)
    xs, ys, zs = (np.stack([before[:, axis], after[:, axis]]) for axis in range(3))
    corners = frame.values[zs[:, None, None], ys[None, :, None], xs[None, None, :]].astype(
        np.float64
    )
    # One axis after the other as a + s (b - a), which is exact between two equal values.
    for axis in (2, 1, 0):
        corners = _between(corners[0], corners[1], share[:, axis])
    return np.where(outside, np.nan, corners)


def _between(one: Floats, other: Floats, share: Floats) -> Floats:
    """Linear interpolation from one value to another; a NaN with the weight 0 does not matter."""
    return np.where(share == 0, one, np.where(share == 1, other, one + share * (other - one)))
