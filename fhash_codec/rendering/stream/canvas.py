"""The picture of streamed rays: events joined front to back and lit, and the other buffers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fhash_codec.rendering.stream.beams import Beams
from fhash_codec.rendering.stream.fields import Field
from fhash_codec.rendering.stream.phong import LightAt, Phong
from fhash_codec.rendering.task.arrays import Array
from fhash_codec.rendering.task.palette import Palette
from fhash_codec.rendering.task.task import Task

__all__ = ["Canvas", "Events"]


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
