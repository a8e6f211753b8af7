"""Pictures in float64, ray by ray, as `fhash_codec.rendering.task.task` defines them: no packets, no skipping, no early end of a ray."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.task.task import Frame, Task

__all__ = ["drawn"]

Floats = npt.NDArray[np.float64]

SNAP = 1e-9
"""Of a vertex spacing: nearer to a vertex, a coordinate is that of the vertex."""
HALVINGS = 60
"""Of the search for the place of a surface."""


def drawn(frame: Frame, task: Task) -> Floats:
    """The picture (H, W, 4) of an unshaded volume and surfaces of one colour each, multiplied by the opacity; without a threshold."""
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
    # Surfaces begin where the frame does.
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
    ends = np.concatenate(
        [[entered], np.clip(at, entered, max(entered, left_at)), [max(entered, left_at)]]
    )
    found = [_crossings(value, ends, value(ends), surface.value) for surface in task.surfaces]
    for sample in range(count + 1):
        # The surfaces between the sample before and this one, the nearest first, then the sample.
        between = sorted(
            (places[sample], number)
            for number, places in enumerate(found)
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
            own = np.array(
                [np.interp(entry, numbers, table.colours[:, channel]) for channel in range(3)]
            )
            colour, left = colour + left * opacity * own, left * (1 - opacity)
    return np.array([*colour, 1 - left])


def _within(eye: Floats, direction: Floats, bounds: Floats) -> tuple[float, float]:
    """Where a ray enters a box (3, 2) in front of the eye and where it leaves it, not before; both 0 where it misses it."""
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
    """Where a level lies between two places each (n - 1,), infinite where it does not, or where there is no value."""
    places = np.full(len(ends) - 1, np.inf)
    below = values < level
    known = ~np.isnan(values)
    for number in np.flatnonzero((below[1:] != below[:-1]) & known[1:] & known[:-1]):
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
    """Values (n,) at places (n, 3), x, y, z in vertices of the domain; NaN outside the frame and where a vertex of weight is."""
    counts = np.array(frame.values.shape[::-1])
    local = (places - np.array(frame.first[::-1])) / frame.stride
    # A place on a face of the frame is on it, whatever the rounding on the way there.
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
    # One axis after the other as a + s (b - a): between two equal values stands exactly that value.
    for axis in (2, 1, 0):
        corners = _between(corners[0], corners[1], share[:, axis])
    return np.where(outside, np.nan, corners)


def _between(one: Floats, other: Floats, share: Floats) -> Floats:
    """Linear from one to the other; what has no weight may have no value."""
    return np.where(share == 0, one, np.where(share == 1, other, one + share * (other - one)))
