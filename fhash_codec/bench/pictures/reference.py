"""A picture by VTK's conventions in numpy and float64, which explains how VTK's pictures differ.

Three things differ. VTK takes samples at whole steps from the entry of a ray, `march` in the middle
of steps. VTK's gradients are central differences over two vertices, those of `march` are of the
cell. VTK's highlights follow the mirrored ray (Phong). All else is as in `march`.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.march_task import Lighting, Task

__all__ = ["vtk_picture"]

Floats = npt.NDArray[np.float64]
Single = npt.NDArray[np.float32]

DARK = 1e-5
"""Share of the light at which a ray ends."""


def vtk_picture(values: Single, task: Task) -> Single:
    """Draw a task without surfaces over a whole frame (z, y, x) of finite values; picture (H, W,
    4).

    A lit task is lit from the camera.
    """
    assert task.table is not None
    rays = task.rays
    origin, along = (
        np.array(np.broadcast_to(part.reshape(-1, 3), (rays.size[0] * rays.size[1], 3)))
        for part in rays.pixels()
    )
    along = along / np.linalg.norm(along * rays.grid.spacing, axis=1, keepdims=True)
    bounds = rays.grid.bounds
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (bounds[None] - origin[..., None]) / along[..., None]
    enter = np.maximum(np.nanmax(ends.min(axis=-1), axis=1), 0.0)
    leave = np.nanmin(ends.max(axis=-1), axis=1)
    colour, clear = np.zeros((len(along), 3)), np.ones(len(along))
    entries = np.linspace(task.table.low, task.table.high, len(task.table.extinctions))
    number = 0
    while True:
        alive = np.flatnonzero((enter + number * task.step < leave) & (clear > DARK))
        if not alive.size:
            break
        places = origin[alive] + (enter[alive] + (number + 1) * task.step)[:, None] * along[alive]
        places = np.clip(places, bounds[:, 0], bounds[:, 1])
        found = _trilinear(values, places)
        shade = np.stack(
            [np.interp(found, entries, channel) for channel in task.table.colours.T], axis=-1
        )
        length = np.minimum(task.step, leave[alive] - enter[alive] - number * task.step)
        opacity = -np.expm1(-np.interp(found, entries, task.table.extinctions) * length)
        if task.shaded and task.lighting is not None:
            shade = _lit(
                shade,
                _central(values, places) / rays.grid.spacing,
                along[alive] * rays.grid.spacing,
                task.lighting,
            )
        colour[alive] += (clear[alive] * opacity)[:, None] * shade
        clear[alive] *= 1 - opacity
        number += 1
    rgba = np.concatenate([colour, 1 - clear[:, None]], axis=1)
    return rgba.reshape(rays.size[1], rays.size[0], 4).astype(np.float32)


def _trilinear(values: Single, places: Floats) -> Floats:
    """Values at places (n, 3), x, y, z in vertices, clamped to the frame."""
    last = np.array(values.shape[::-1]) - 1
    at = np.clip(places, 0, last)
    low = np.minimum(at.astype(np.int64), np.maximum(last - 1, 0))
    share, high = at - low, np.minimum(low + 1, last)
    total = np.zeros(len(places))
    for corner in np.ndindex(2, 2, 2):
        index = np.where(corner, high, low)
        weight = np.prod(np.where(corner, share, 1 - share), axis=1)
        total += weight * values[index[:, 2], index[:, 1], index[:, 0]]
    return total


def _central(values: Single, places: Floats) -> Floats:
    """Differences (n, 3) over the vertex before and the vertex behind, per vertex."""
    return np.stack(
        [
            (_trilinear(values, places + one) - _trilinear(values, places - one)) / 2
            for one in np.eye(3)
        ],
        axis=-1,
    )


def _lit(shade: Floats, gradient: Floats, along: Floats, lighting: Lighting) -> Floats:
    """Phong's model with the light at the eye.

    The mirrored ray and the way back to the eye enclose twice the angle to the normal.
    """
    length = np.linalg.norm(gradient, axis=1)
    known = length > 0
    cosine = np.where(
        known, np.abs(np.sum(gradient * along, axis=1)) / np.where(known, length, 1.0), 0.0
    )
    mirrored = (
        np.where(known, np.maximum(2 * cosine * cosine - 1, 0.0), 0.0) ** lighting.specular_power
    )
    lit = (
        shade * (lighting.ambient + lighting.diffuse * cosine)[:, None]
        + (lighting.specular * mirrored)[:, None]
    )
    return np.minimum(lit, 1.0)
