"""The light on a sample: Phong's model by the gradient, and the shares that a light grid leaves."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

from fhash_codec.rendering.stream.fields import Field, central_slopes
from fhash_codec.rendering.task.arrays import Array, Arrays
from fhash_codec.rendering.task.slopes import flatness, slope_scale
from fhash_codec.rendering.task.task import LightGrid, Lighting, Task

__all__ = ["LightAt", "Phong"]


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
