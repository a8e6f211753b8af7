"""The picture of streamed rays: events joined front to back and lit, and the other buffers.

Light is Phong's model by the gradient, and the shares that a light grid leaves. Opacity may depend
on the gradient, too.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from fhash_codec.rendering.stream.beams import Beams
from fhash_codec.rendering.stream.fields import Field, central_slopes
from fhash_codec.rendering.task.arrays import Array, Arrays
from fhash_codec.rendering.task.palette import Palette
from fhash_codec.rendering.task.slopes import flatness, slope_scale
from fhash_codec.rendering.task.task import GRADES, LightGrid, Lighting, Task

__all__ = ["Canvas", "Events", "Factors", "LightAt", "Phong"]


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
