"""The light on a sample: Phong's model by the gradient, what a light grid leaves of it, and the colours of a table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fhash_codec.render.fields import Field
from fhash_codec.render.setting import FLATTEST
from fhash_codec.render.task import LightGrid, Lighting, Table, Task

__all__ = ["Phong", "light_at", "table_colours"]

Floats = npt.NDArray[np.float64]


def table_colours(table: Table, values: Floats) -> Floats:
    """Colours (n, 3) of finite values (n,), linear between the entries of a table."""
    n = len(table.colours)
    entry = np.clip((values - table.low) / (table.high - table.low) * (n - 1), 0, n - 1)
    before = np.minimum(entry.astype(np.int64), n - 2)
    share = (entry - before)[:, None]
    return np.asarray(table.colours[before] * (1 - share) + table.colours[before + 1] * share, dtype=np.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class Phong:
    """Phong's model, two-sided, with the vector halfway between light and eye (Blinn).

    scale: from derivatives by x, y, z per vertex to gradients, of the table's range per vertex spacing. floor: the length of one at which
    the light from a direction is half gone, so that noise of rounding has none.
    """

    lighting: Lighting
    scale: Floats
    floor: float

    @classmethod
    def of(cls, task: Task, field: Field) -> Phong | None:
        """As every way to march has it (setting.py); None for a task without light."""
        if task.lighting is None:
            return None
        least, most = field.bricks.value_range
        low, high = (least, most) if task.table is None else (task.table.low, task.table.high)
        span = max(high - low, (most - least) * 1e-15) or 1.0
        noise = 4 * 2.0**-23 * max(abs(least), abs(most)) / span
        grid = task.rays.grid
        scale = field.stride * grid.vertex_spacing / (span * grid.spacing)
        return cls(lighting=task.lighting, scale=scale, floor=max(FLATTEST, min(noise, 1.0)))

    def __call__(self, colours: Floats, slopes: Floats, along: Floats, lamp: Floats, around: Floats) -> Floats:
        """Lit colours (n, 3): ambient and scattered light in the colour, mirrored light in white.

        slopes: derivatives (n, 3) by x, y, z per vertex. along: unit vectors (n, 3) of the rays. lamp, around: shares (n,) of the light
        that arrive. Where the gradient vanishes only the ambient light is left.
        """
        lighting = self.lighting
        gradient = slopes * self.scale
        normal = gradient / np.sqrt(np.sum(gradient * gradient, axis=1, keepdims=True) + self.floor**2)
        towards = -along if lighting.lamp is None else np.broadcast_to(lighting.lamp, along.shape)
        half = towards - along
        length = np.linalg.norm(half, axis=1, keepdims=True)
        # Light from straight behind has no highlight.
        half = np.where(length > 1e-6, half / np.where(length > 1e-6, length, 1.0), 0.0)
        scattered = np.minimum(np.abs(np.sum(normal * towards, axis=1)), 1.0)
        mirrored = np.minimum(np.abs(np.sum(normal * half, axis=1)), 1.0) ** lighting.specular_power
        share = lighting.ambient * around + lighting.diffuse * lamp * scattered
        return np.asarray(colours * share[:, None] + (lighting.specular * lamp * mirrored)[:, None], dtype=np.float64)


def light_at(grid: LightGrid, places: Floats) -> tuple[Floats, Floats]:
    """Shares (n,) of the light from the lamp and from around that reach places (n, 3), x, y, z in vertices; trilinear, clamped."""
    shares = grid.shares
    last = np.array(shares.shape[2::-1]) - 1
    at = np.clip((places - grid.first) / grid.cell, 0.0, last)
    low = np.minimum(at.astype(np.int64), np.maximum(last - 1, 0))
    x, y, z = (at - low).T
    high = np.minimum(low + 1, last)
    found = np.zeros((len(places), 2))
    for corner in np.ndindex(2, 2, 2):
        k, j, i = (np.where(up, high[:, axis], low[:, axis]) for up, axis in zip(corner, (2, 1, 0), strict=True))
        weight = (z if corner[0] else 1 - z) * (y if corner[1] else 1 - y) * (x if corner[2] else 1 - x)
        found += weight[:, None] * shares[k, j, i]
    return found[:, 0], found[:, 1]
