"""Marching in numpy, one sample of every ray at a time: the same picture as the native library's, slower; in float64 throughout."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fhash_codec.render.beams import shares, slab
from fhash_codec.render.bricks import SIDE, Bricks
from fhash_codec.render.setting import Setting, empty_table
from fhash_codec.render.task import Frame, Lighting, Marched, Table, Task

__all__ = ["march_portable"]

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

BLOCK = 2**15
"""Rays at a time."""
TURNS = 60
"""Of the search for a root, at most."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Path:
    """Rays (n,) through a frame, in steps from the first sample.

    origin: (n, 3) of the first sample, step: (n, 3), in vertices of the frame. direction: (n, 3), unit vectors of the coordinates.
    begin: distance of the first sample from the eye. first, stop: samples that the frame has values of. last: the sample of the
    shorter step, as long as `rest` of a step. entered, leaving: where the ray enters and leaves what the frame has values of.
    """

    origin: Floats
    step: Floats
    direction: Floats
    begin: Floats
    first: Indices
    stop: Indices
    last: Indices
    rest: Floats
    entered: Floats
    leaving: Floats


def paths_of(setting: Setting, task: Task, pixels: Indices, ray: int) -> Path:
    """The paths of pixels (n,), counted in rows, of one of the `antialiasing`^2 rays of each."""
    width, height = task.rays.size
    rays = task.antialiasing
    across, down = pixels % width + (ray % rays + 0.5) / rays, pixels // width + (ray // rays + 0.5) / rays
    side = (2 * across / width - 1)[:, None] * setting.right + (1 - 2 * down / height)[:, None] * setting.up
    eye = setting.eye + (side if task.rays.parallel else 0 * side)
    direction = setting.forward + (0 * side if task.rays.parallel else side)
    direction = direction / np.linalg.norm(direction * setting.spacing, axis=1, keepdims=True)
    enter, leave = slab(eye, direction, setting.box)
    first, stop = slab(eye, direction, setting.seen)
    hit = (leave > enter) & (stop > first)
    enter, leave, first, stop = (np.where(hit, ends, 0.0) for ends in (enter, leave, first, stop))
    steps = (leave - enter) / task.step
    share = shares(pixels * rays * rays + ray) if task.jitter else np.full(len(pixels), 0.5)
    most = np.ceil(steps)
    begin = enter + share * task.step
    some = np.where(first > enter, np.clip(np.ceil((first - enter) / task.step - share), 0, most), 0)
    end = np.where(stop < leave, np.clip(np.floor((stop - enter) / task.step - share) + 1, 0, most), most)
    return Path(
        origin=eye + begin[:, None] * direction,
        step=direction * task.step,
        direction=direction * setting.spacing,
        begin=begin,
        first=some.astype(np.int64),
        stop=end.astype(np.int64),
        last=most.astype(np.int64) - 1,
        rest=steps - (most - 1),
        entered=(np.maximum(first, enter) - enter) / task.step - share,
        leaving=(np.minimum(stop, leave) - enter) / task.step - share,
    )


def trilinear(values: npt.NDArray[np.float32], places: Floats, gradient: bool = False) -> tuple[Floats, Floats | None]:
    """Values (n,) at places (n, 3) x, y, z, clamped, and gradients (n, 3) per vertex if wanted.

    NaN where a vertex of weight has no value; then the gradient is 0, as it is where any vertex of the cell has none.
    """
    counts = np.array(values.shape[::-1])
    places = np.clip(places, 0, counts - 1.0)
    cell = np.minimum(places.astype(np.int64), np.maximum(counts - 2, 0))
    part = places - cell
    reach = (counts > 1).astype(np.int64)
    found, slope = np.zeros(len(places)), np.zeros((len(places), 3))
    for corner in np.ndindex(2, 2, 2):
        at = cell + np.array(corner) * reach
        value = values[at[:, 2], at[:, 1], at[:, 0]].astype(np.float64)
        factors = np.where(corner, part, 1 - part)
        weight = factors.prod(axis=1)
        found += np.where(weight == 0, 0.0, weight * value)
        if gradient:
            for axis in range(3):
                slope[:, axis] += (2 * corner[axis] - 1) * np.delete(factors, axis, axis=1).prod(axis=1) * value
    return found, np.where(np.isnan(slope).any(axis=1, keepdims=True), 0.0, slope) if gradient else None


def looked_up(table: Table, low: float, high: float, values: Floats) -> tuple[Floats, Floats]:
    """Colours (n, 3) and extinctions (n,), 0 where a value is NaN; low, high: the table's ends in the unit of the values."""
    last = len(table.extinctions) - 1
    at = np.clip((np.nan_to_num(values, nan=low) - low) * (last / (high - low)), 0, last)
    entry = np.minimum(at.astype(np.int64), last - 1)
    part = at - entry
    extinction = table.extinctions[entry] * (1 - part) + table.extinctions[entry + 1] * part
    colour = table.colours[entry] * (1 - part[:, None]) + table.colours[entry + 1] * part[:, None]
    return colour, np.where(np.isnan(values), 0.0, extinction)


def light_at(setting: Setting, task: Task, places: Floats) -> Floats:
    """Shares (n, 2) of the light from the lamp and from around at places of the frame."""
    if task.light is None:
        return np.ones((len(places), 2))
    at = places * setting.light_scale + setting.light_offset
    return np.stack([trilinear(task.light.shares[..., which], at)[0] for which in range(2)], axis=-1)


def shaded(colour: Floats, gradient: Floats, direction: Floats, light: Floats, lighting: Lighting, floor: float) -> Floats:
    """Colours (n, 3) under a light: two-sided Phong with the vector halfway between light and eye (Blinn).

    gradient: (n, 3), in the unit of `floor`, at which the light from a direction is half gone. direction: (n, 3) of the rays.
    """
    lamp = -direction if lighting.lamp is None else np.broadcast_to(lighting.lamp, direction.shape)
    half = lamp - direction
    size = np.linalg.norm(half, axis=1, keepdims=True)
    half = np.where(size > 1e-6, half / np.maximum(size, 1e-6), 0.0)
    one = 1 / np.sqrt((gradient**2).sum(axis=1) + floor**2)
    diffuse = lighting.diffuse * np.minimum(np.abs((gradient * lamp).sum(axis=1)) * one, 1.0)
    specular = lighting.specular * np.minimum(np.abs((gradient * half).sum(axis=1)) * one, 1.0) ** lighting.specular_power
    factor = lighting.ambient * light[:, 1] + light[:, 0] * diffuse
    return np.asarray(colour * factor[:, None] + (light[:, 0] * specular)[:, None], dtype=np.float64)


class _Block:
    """Rays on their way, and what they have seen."""

    def __init__(self, setting: Setting, task: Task, path: Path) -> None:
        count = len(path.first)
        self.setting, self.task, self.path = setting, task, path
        self.colour, self.left = np.zeros((count, 3)), np.ones(count)
        self.depth, self.normal = np.full(count, np.inf), np.zeros((count, 3))
        self.gradients = 0

    def places(self, rays: Indices, samples: Floats) -> Floats:
        return np.asarray(self.path.origin[rays] + samples[:, None] * self.path.step[rays], dtype=np.float64)

    def values(self, rays: Indices, samples: Floats) -> Floats:
        return trilinear(self.setting.values, self.places(rays, samples))[0]

    def lit(self, rays: Indices, samples: Floats, colour: Floats, shading: bool) -> Floats:
        """Colours under the light that reaches samples."""
        places = self.places(rays, samples)
        light = light_at(self.setting, self.task, places)
        if not shading or self.task.lighting is None:
            return np.asarray(colour * light.prod(axis=1, keepdims=True), dtype=np.float64)
        self.gradients += len(rays)
        gradient = trilinear(self.setting.values, places, gradient=True)[1]
        assert gradient is not None
        return shaded(colour, gradient * self.setting.gradient, self.path.direction[rays], light, self.task.lighting, self.setting.floor)

    def add(self, rays: Indices, samples: Floats, colour: Floats, opacity: Floats) -> None:
        """Behind all that was added before; one for each of the rays."""
        self.colour[rays] += (self.left[rays] * opacity)[:, None] * colour
        self.left[rays] *= 1 - opacity
        if self.task.depth or self.task.normal:
            half = (self.left[rays] < 0.5) & np.isinf(self.depth[rays])
            self.see(rays[half], samples[half])

    def see(self, rays: Indices, samples: Floats) -> None:
        """Depths and normals, towards the eye."""
        self.depth[rays] = self.path.begin[rays] + samples * self.task.step
        if not self.task.normal or not len(rays):
            return
        self.gradients += len(rays)
        gradient = trilinear(self.setting.values, self.places(rays, samples), gradient=True)[1]
        assert gradient is not None
        normal = gradient / self.setting.spacing
        size = np.linalg.norm(normal, axis=1)
        size = np.where((normal * self.path.direction[rays]).sum(axis=1) > 0, -size, size)
        self.normal[rays] = np.where(size[:, None] != 0, normal / np.where(size, size, 1.0)[:, None], 0.0)

    def cross(self, rays: Indices, low: Floats, high: Floats, before: Floats, now: Floats) -> None:
        """Surfaces between two samples of each ray, in the order in which it meets them."""
        roots = np.full((len(rays), len(self.setting.levels)), np.inf)
        for number, level in enumerate(self.setting.levels):
            some = np.flatnonzero(((before < level) != (now < level)) & ~np.isnan(before) & ~np.isnan(now))
            a, b = low[some].copy(), high[some].copy()
            for _ in range(TURNS):  # halving, which no shape of the field can lead astray
                middle = (a + b) / 2
                inside = (self.values(rays[some], middle) < level) == (before[some] < level)
                a, b = np.where(inside, middle, a), np.where(inside, b, middle)
            roots[some, number] = np.where(np.isnan(self.values(rays[some], b)), np.inf, b)
        order = np.argsort(roots, axis=1)
        for place in range(roots.shape[1]):
            which = order[:, place]
            at = roots[np.arange(len(rays)), which]
            for number, surface in enumerate(self.task.surfaces):
                met = np.flatnonzero((which == number) & np.isfinite(at))
                if len(met):
                    colour = np.broadcast_to(surface.colour, (len(met), 3))
                    lit = self.lit(rays[met], at[met], colour, True)
                    self.add(rays[met], at[met], lit, np.full(len(met), surface.opacity))


def march_portable(frame: Frame, task: Task, bricks: Bricks) -> Marched:
    """The picture of a task, as `march` describes it."""
    setting = Setting.of(frame, task, bricks)
    matters = None
    if task.skipping and not task.maximum and not task.surfaces:
        matters = bricks.matters(task)
    width, height = task.rays.size
    rgba, depth, normal = np.zeros((height * width, 4)), np.full(height * width, np.inf), np.zeros((height * width, 3))
    counters = dict.fromkeys(("rays", "passes", "samples", "evaluations", "gradients", "secondary_rays", "skipped_bricks"), 0)
    for begin in range(0, width * height, BLOCK):
        pixels = np.arange(begin, min(begin + BLOCK, width * height))
        for ray in range(task.antialiasing**2):
            block = _Block(setting, task, paths_of(setting, task, pixels, ray))
            (_march_maximum if task.maximum else _march_block)(block, matters, counters)
            rgba[pixels] += np.concatenate([block.colour, 1 - block.left[:, None]], axis=1) / task.antialiasing**2
            nearer = block.depth < depth[pixels]
            depth[pixels[nearer]], normal[pixels[nearer]] = block.depth[nearer], block.normal[nearer]
            counters["gradients"] += block.gradients
    return Marched(
        rgba=rgba.reshape(height, width, 4).astype(np.float32),
        depth=depth.reshape(height, width).astype(np.float32) if task.depth else None,
        normal=normal.reshape(height, width, 3).astype(np.float32) if task.normal else None,
        counters=counters,
    )


def _march_block(block: _Block, matters: Mask | None, counters: dict[str, int]) -> None:
    setting, task, path = block.setting, block.task, block.path
    table = task.table or empty_table(setting.low, setting.high)
    alive = np.flatnonzero(path.stop > path.first)
    counters["rays"] += len(alive)
    before, since = np.full(len(path.first), np.nan), path.entered.copy()
    if task.surfaces:
        before[alive] = block.values(alive, path.entered[alive])
        counters["samples"] += len(alive)
    sample = path.first.copy()
    while len(alive):
        counters["passes"] += 1
        here = alive
        if matters is not None:
            places = np.clip(block.places(here, sample[here].astype(np.float64)), 0, np.array(setting.values.shape[::-1]) - 1.0)
            brick = np.minimum(places.astype(np.int64) // SIDE, np.array(matters.shape[::-1]) - 1)
            some = matters[brick[:, 2], brick[:, 1], brick[:, 0]]
            counters["skipped_bricks"] += int((~some).sum())
            here = here[some]
        at = sample[here].astype(np.float64)
        values = block.values(here, at)
        counters["samples"] += len(here)
        if task.surfaces:
            end = np.minimum(at, path.leaving[here])
            now = np.where(at <= path.leaving[here], values, block.values(here, end))
            block.cross(here, since[here], end, before[here], now)
            before[here], since[here] = now, end
        colour, extinction = looked_up(table, setting.low, setting.high, values)
        length = task.step * np.where(sample[here] == path.last[here], path.rest[here], 1.0)
        opacity = -np.expm1(-extinction * length)
        seen = opacity > 0
        lit = colour[seen]
        if task.shaded or task.light is not None:
            lit = block.lit(here[seen], at[seen], lit, task.shaded)
        block.add(here[seen], at[seen], lit, opacity[seen])
        sample[alive] += 1
        ending = alive[sample[alive] >= path.stop[alive]]
        if task.surfaces and len(ending):
            block.cross(ending, since[ending], path.leaving[ending], before[ending], block.values(ending, path.leaving[ending]))
        dark = (block.left[alive] < task.threshold) | (block.left[alive] == 0)
        alive = alive[(sample[alive] < path.stop[alive]) & ~dark]


def _march_maximum(block: _Block, _: Mask | None, counters: dict[str, int]) -> None:
    setting, task, path = block.setting, block.task, block.path
    alive = np.flatnonzero(path.stop > path.first)
    counters["rays"] += len(alive)
    best, where = np.full(len(path.first), -np.inf), np.zeros(len(path.first))
    sample = path.first.copy()
    while len(alive):
        counters["passes"] += 1
        counters["samples"] += len(alive)
        values = block.values(alive, sample[alive].astype(np.float64))
        better = values > best[alive]
        best[alive[better]], where[alive[better]] = values[better], sample[alive[better]]
        sample[alive] += 1
        alive = alive[sample[alive] < path.stop[alive]]
    rays = np.flatnonzero(best > -np.inf)
    table = task.table or empty_table(setting.low, setting.high)
    block.colour[rays] = looked_up(table, setting.low, setting.high, best[rays])[0]
    block.left[rays] = 0
    block.see(rays, where[rays])
