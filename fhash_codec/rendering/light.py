"""Light in a volume: gradients for shading, shadows of a lamp, occlusion of the surroundings."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from fhash_codec import native
from fhash_codec.native import pointer
from fhash_codec.rendering.bricks import Bricks
from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.march_task import (
    GRADES,
    Frame,
    Grading,
    LightGrid,
    Lighting,
    Table,
    Task,
    Units,
    extinctions_in,
)
from fhash_codec.rendering.scenes import (
    AmbientOcclusion,
    Effects,
    Scene,
    Shading,
    Shadows,
    TransferFunctionSpec,
)
from fhash_codec.rendering.transfer_function import about
from fhash_codec.rendering.view import Body
from fhash_codec.volume import Volume
from fhash_formats.errors import InputError
from fhash_formats.support.threads import in_threads
from fhash_formats.support.values import Double, Single

FLATTEST = 1e-6
"""Gradient, as a share of the value range per vertex, at which shading has faded by half. The
rounding of the values and the errors of the file raise it.
"""
QUIETEST = 1e-3
"""Noise of gradients, as a share of the value range per vertex, that values need not be smoothed
for.
"""
LEFT = 0.24
"""Noise of the gradients of values that a Gaussian has smoothed, with a deviation of 1 vertex, for
a difference of neighbours of 1: three standard deviations of errors that are even between the
bounds (0.29) and the same along one axis, as those of coding often are (0.2 along the two others).
"""
FALL = 2.0
"""Power of the deviation by which that noise falls."""
DEVIATIONS = (0.8, 2.5)
"""Smallest and largest deviation of the Gaussian, in vertices. Grids hardly have a smaller one; a
larger one would shade by what lies too far away.
"""
STEEPEST = 1e18
"""Largest gradient. The squares of larger ones overflow float32."""


def flatness(
    low: float, high: float, least: float, most: float, noise: float = 0.0
) -> tuple[float, float]:
    """The range that gradients are shares of, and the gradient at which shading has faded by half.

    low, high: ends of the table, whose range it is.
    least, most: extreme values of the frame. Their rounding to float32 makes gradients of noise,
    which must not be lit.
    noise: difference of two neighbouring vertices up to which it is taken for an error of coding.
    Where it is large, gradients are those of smoothed values, and little of the noise is left.
    """
    span = max(high - low, (most - least) * 1e-15) or 1.0
    rounding = 4 * 2.0**-23 * max(abs(least), abs(most))
    share, deviation = noise / span, smoothing(span, noise)
    left = LEFT * share * deviation**-FALL if deviation else share
    return span, max(FLATTEST, min(max(rounding / span, left), 1.0))


def smoothing(span: float, noise: float) -> float:
    """The deviation of the Gaussian, in vertices, that values are smoothed by before shading.

    It is 0 where nothing needs to be smoothed, and else just large enough that QUIETEST is left of
    the noise, within DEVIATIONS.

    span: the range that gradients are shares of.
    noise: difference of two neighbouring vertices that errors of coding can make.
    """
    if noise <= QUIETEST * span:
        return 0.0
    deviation = min(LEFT * noise / span, 1.0) / QUIETEST
    return float(np.clip(deviation ** (1 / FALL), *DEVIATIONS))


def slope_scale(grid: Grid, span: float, least: float, most: float) -> Double:
    """Factors (3,), x, y, z, from differences between vertices to gradients.

    A gradient is a share of `span` in the distance of two vertices. The factors are clipped so that
    the largest possible difference, from `least` to `most`, gives at most STEEPEST. That changes
    factors only where the vertex spacings of the axes differ so much that the direction of the
    gradient stays the same.
    """
    with np.errstate(over="ignore", divide="ignore"):
        limit = STEEPEST / np.float64(most - least)
        factors: Double = np.clip(grid.vertex_spacing / (span * grid.spacing), -limit, limit)
    return factors


LEAST_TOP = 1e-300
"""Least gradient of the last factor in marched units, so that there are numbers to divide by it."""


def grading_of(
    spec: TransferFunctionSpec, volume: Volume, units: Units, grid: Grid
) -> Grading | None:
    """The opacity by gradient that a scene asks for; None without it.

    A gradient of a scene is a share of the series' value range in the distance of two vertices, the
    geometric mean of the spacings. Raises InputError for points that do not ascend and for factors
    beyond 0 to 1.
    """
    points = np.array(spec.gradient_opacity, dtype=np.float64).reshape(-1, 2)
    if not len(points) or spec.nothing:
        return None
    if np.any(np.diff(points[:, 0]) <= 0):
        raise InputError(
            "the gradients of 'gradient_opacity' do not ascend; each must be above the one before"
        )
    if not 0 < points[:, 1].max() <= 1:
        raise InputError(
            f"the factors of 'gradient_opacity' reach to {points[:, 1].max():g}; allowed: 0 to 1, "
            "one of them above 0"
        )
    top = float(points[-1, 0]) or 1.0
    low, high = volume.value_range.low, volume.value_range.high
    ends = units.to([low, high] if low < high else about(low))
    return Grading(
        factors=np.interp(np.linspace(0.0, top, GRADES + 1), points[:, 0], points[:, 1]),
        top=max(top * float(ends[1] - ends[0]) / grid.vertex_spacing, LEAST_TOP),
    )


def factors_at_vertices(values: Single, grading: Grading, spacing: Double) -> Single:
    """Factors (z, y, x) of the extinction at the vertices of a frame, 0 where a value is missing.

    Gradients are central differences. Where a neighbour is missing they are the difference to the
    other one.

    Args:
        values: float32 (z, y, x), contiguous, in marched units.
        grading: factors by the size of the gradient.
        spacing: (3,), x, y, z, distance of two vertices of the frame, in the coordinates.
    """
    # A finite scale: a gradient of 0 stays one.
    with np.errstate(over="ignore"):
        scale = np.minimum(GRADES / grading.top / np.abs(spacing), np.finfo(np.float64).max)
    library = native.library()
    table = np.append(grading.factors, grading.factors[-1]).astype(np.float32)
    out = np.empty(values.shape, dtype=np.float32)

    def layer(z: int) -> None:
        given = (pointer(values), values.shape, pointer(scale), pointer(table), GRADES + 1)
        library.fhash_march_factors(*given, z, z + 1, pointer(out))

    list(in_threads(layer, range(len(values))))
    return out


Result = TypeVar("Result")

MAX_STEPS = 16
"""Steps from a point to the end of its surroundings, at most."""
SIDES = np.array(
    [
        side
        for side in itertools.product((-1.0, 0.0, 1.0), repeat=3)
        if sum(map(abs, side)) in (1, 3)
    ]
)
"""Unit vectors towards the surroundings: the 6 faces and the 8 corners of a cube."""
SIDES /= np.linalg.norm(SIDES, axis=1, keepdims=True)


def light_grid(
    frame: Frame,
    task: Task,
    *,
    shadows: Shadows | None = None,
    lamp: Double | None = None,
    ambient_occlusion: AmbientOcclusion | None = None,
    bricks: Bricks | None = None,
) -> LightGrid:
    """Shares of the light that reach places of a frame, the strengths of both effects included.

    The light does not depend on the camera, but for a lamp that moves with it.

    The points of the grid lie a whole number of the frame's vertices apart, as near to the
    resolution of the shadows as that allows.

    task: of a marcher, without light. What its clip leaves takes light away, as far as its table
        and its opacity by gradient let it.
    lamp: unit vector (x, y, z) of the coordinates towards the light; shadows need one.
    bricks: of the frame. They keep what the next picture needs again; None keeps nothing.
    """
    grid, table, body, grading = task.rays.grid, task.table, task.body, task.grading
    resolution = shadows.resolution if shadows is not None else Shadows().resolution
    across = max(1, round(resolution / frame.stride))
    if table is None or not table.extinctions.any():
        first = np.array(frame.first[::-1], dtype=np.float64)
        return LightGrid(shares=np.ones((1, 1, 1, 2), dtype=np.float32), first=first, cell=1.0)
    # In lengths of a vertex: float32 has no room for those of all coordinates.
    unit = grid.vertex_spacing
    table = replace(table, extinctions=extinctions_in(table.extinctions, unit))
    cell = float(across * frame.stride)
    cache = _Cache(
        bricks,
        (
            *(table.low, table.high, table.extinctions.tobytes(), across, grid.spacing.tobytes()),
            None if body is None else (body.bounds.tobytes(), body.planes.tobytes()),
            None if grading is None else (grading.top, grading.factors.tobytes()),
        ),
    )
    extinction, first = cache(
        "extinction", (), lambda: _extinction_of(frame, grid, table, across, body, grading)
    )
    points = _Points(extinction=extinction, spacing=grid.spacing, cell=cell, unit=unit)
    shares = np.ones((*extinction.shape, 2), dtype=np.float32)
    rays = 0
    if shadows is not None and lamp is not None:
        passed = cache("lamp", lamp.tobytes(), lambda: points.from_lamp(lamp))
        shares[..., 0] = 1 - np.float32(shadows.strength) * (1 - passed)
        rays += extinction.size
    if ambient_occlusion is not None:
        radius = ambient_occlusion.radius
        around = cache("around", radius, lambda: points.from_around(radius))
        shares[..., 1] = 1 - np.float32(ambient_occlusion.strength) * (1 - around)
        rays += extinction.size * len(SIDES)
    return LightGrid(shares=np.clip(shares, 0, 1), first=first, cell=cell, secondary_rays=rays)


@dataclass(frozen=True)
class _Cache:
    """The light of one transfer function that bricks keep; without bricks nothing is kept."""

    bricks: Bricks | None
    key: tuple[object, ...]

    def __call__(self, kind: str, key: object, compute: Callable[[], Result]) -> Result:
        """The result of a function, as `Bricks.remembered` has it; the last one of each kind."""
        if self.bricks is None:
            return compute()
        return self.bricks.remembered(f"light: {kind}", (*self.key, key), compute, most=1)


def _extinction_of(
    frame: Frame, grid: Grid, table: Table, across: int, body: Body | None, grading: Grading | None
) -> tuple[Single, Double]:
    """Extinctions on the grid with a point every `across` vertices, and the first point (x, y, z).

    Gradients are those of the whole frame: a clip makes none.
    """
    values = np.ascontiguousarray(frame.values, dtype=np.float32)
    factors = None
    if grading is not None:
        factors = factors_at_vertices(values, grading, grid.spacing * frame.stride)
    if body is not None:
        frame, spans = _clipped(frame, body)
        values = np.ascontiguousarray(frame.values, dtype=np.float32)
        factors = None if factors is None else np.ascontiguousarray(factors[spans])
    first = np.array(frame.first[::-1], dtype=np.float64)
    return _extinction(values, table, across, factors), first


def _clipped(frame: Frame, body: Body) -> tuple[Frame, tuple[slice, ...]]:
    """The vertices around a body alone, without values at those outside it, and their spans."""
    first, stride = np.array(frame.first), frame.stride
    low, high = body.extent[::-1].T
    start = np.clip(np.floor((low - first) / stride), 0, np.array(frame.values.shape) - 1)
    stop = np.clip(np.ceil((high - first) / stride) + 1, start + 1, frame.values.shape)
    spans = tuple(slice(int(begin), int(end)) for begin, end in zip(start, stop, strict=True))
    places = np.meshgrid(
        *(
            begin + np.arange(span.start, span.stop) * stride
            for begin, span in zip(first, spans, strict=True)
        ),
        indexing="ij",
    )
    inside = body.holds(np.stack(places[::-1], axis=-1).astype(np.float64))
    z, y, x = (int(begin + span.start * stride) for begin, span in zip(first, spans, strict=True))
    values = np.where(inside, frame.values[spans], np.float32(np.nan))
    return Frame(values=values, first=(z, y, x), stride=stride), spans


@dataclass(frozen=True, kw_only=True, eq=False)
class _Points:
    """The points of a light grid.

    Attributes:
        extinction: float32 (z, y, x), per `unit`.
        spacing: (3,), x, y, z, distance of two vertices of the domain, in the coordinates.
        cell: vertices of the domain from one point to the next.
        unit: length in the coordinates.
    """

    extinction: Single
    spacing: Double
    cell: float
    unit: float

    def from_lamp(self, lamp: Double) -> Single:
        """Shares of a lamp's light that reach the points; lamp: unit vector towards it."""
        step = np.asarray(lamp, dtype=np.float64) / (self.spacing * self.cell)
        step /= np.abs(step).max()
        with np.errstate(divide="ignore", over="ignore"):
            out = np.ceil(np.array(self.extinction.shape[::-1]) / np.abs(step))
        return self._passed(step, int(out.min()) + 1)  # then every point has left the grid

    def from_around(self, radius: float) -> Single:
        """Shares of the light that reaches the points from as far as `radius`, in vertices."""
        count = min(max(2, round(radius / self.cell)), MAX_STEPS)
        around = np.zeros(self.extinction.shape, dtype=np.float32)
        for side in SIDES:
            around += self._passed(side * radius / (count * self.cell), count)
        return around / np.float32(len(SIDES))

    def _passed(self, step: Double, count: int) -> Single:
        """Share of the light that passes `count` steps (x, y, z, in cells) from each point."""
        sums = _sums(self.extinction, step, count)
        return _left(sums, float(np.linalg.norm(step * self.spacing * self.cell)) / self.unit)


def _sums(extinction: Single, step: Double, count: int) -> Single:
    """Sums of the extinction in the middle of `count` steps from each point."""
    library = native.library()
    sums = np.zeros(extinction.shape, dtype=np.float32)
    along = step.tolist()

    def layer(z: int) -> None:
        given = (pointer(extinction), extinction.shape, along, count)
        library.fhash_march_sum(*given, z, z + 1, pointer(sums))

    list(in_threads(layer, range(len(extinction))))
    return sums


def _left(sums: Single, length: float) -> Single:
    """Shares of the light that are left, exp(-length * sums), float32.

    A length beyond float32 is multiplied in float64, since infinity times 0 would be NaN.
    """
    factor = length if length < 1e30 else np.float64(length)
    with np.errstate(over="ignore"):  # then nothing is left, as it should be
        return np.asarray(np.exp(-factor * sums), dtype=np.float32)


def _extinction(values: Single, table: Table, across: int, factors: Single | None = None) -> Single:
    """Extinctions on a grid with a point every `across` vertices.

    Each is the mean of the vertices around the point, weighed by a tent, and times its factor.
    """
    points = tuple(-(-(size - 1) // across) + 1 for size in values.shape)
    library = native.library()
    last = len(table.extinctions) - 1
    out = np.empty(points, dtype=np.float32)
    entries = np.append(table.extinctions, table.extinctions[-1]).astype(np.float32)

    def layer(z: int) -> None:
        scratch = np.empty(values.shape[2], dtype=np.float32)
        library.fhash_march_extinction(
            *(pointer(values), values.shape, pointer(entries), last + 1),
            *(table.low, last / (table.high - table.low), across, points, z, z + 1),
            *map(pointer, (factors, out, scratch)),
        )

    list(in_threads(layer, range(points[0])))
    return out


SHOULDER = (-0.7, 1.0, 1.0)
"""Default direction towards the light of shadows: components right, up and towards the camera."""


def secondary_light(scene: Scene, grid: Grid) -> tuple[Shadows | None, AmbientOcclusion | None]:
    """The shadows and the ambient occlusion of a scene, None where they would change nothing."""
    effects = scene.effects
    if effects.projections or scene.transfer_function.nothing or grid.flat:
        # Only the volume takes light away, and only from what is drawn of it or in it. A plane is
        # drawn in its colours.
        return None, None
    shadows, occlusion = effects.shadows, effects.ambient_occlusion
    return (
        shadows if shadows and shadows.strength > 0 else None,
        occlusion if occlusion and occlusion.strength > 0 else None,
    )


def lamp_of(rays: Rays, shading: Shading | None, shadows: Shadows | None) -> Double | None:
    """The unit vector (x, y, z) towards the light, in the coordinates.

    None for the camera's light: it lies behind the camera, and its shadows cannot be seen.
    """
    light = shading.light if shading is not None and shading.light is not None else None
    if shadows is not None and shadows.light is not None:
        if light is not None and light != shadows.light:
            raise InputError(
                "shading and shadows name different lights; there is one lamp: "
                "leave 'light' out of one of them"
            )
        light = shadows.light
    if light is not None:
        direction = np.array(light)
        largest = float(np.abs(direction).max())
        if not largest > 0:
            raise InputError("light has no length; give a direction such as 1, 1, 2")
        # Scaled first, since the squares of the largest numbers are beyond float64.
        direction = direction / largest
        return np.asarray(direction / np.linalg.norm(direction), dtype=np.float64)
    return None if shadows is None else _shoulder_lamp(rays)


def _shoulder_lamp(rays: Rays) -> Double:
    """The unit vector (x, y, z) towards the default light of shadows, beside the camera."""
    spacing = rays.grid.spacing
    right, up, away = (
        axis / np.linalg.norm(axis)
        for axis in (rays.right * spacing, rays.up * spacing, -rays.forward * spacing)
    )
    lamp = SHOULDER[0] * right + SHOULDER[1] * up + SHOULDER[2] * away
    return np.asarray(lamp / np.linalg.norm(lamp), dtype=np.float64)


def coding_noise(volume: Volume) -> float:
    """The difference of two neighbouring vertices that the errors of a bounded file can make.

    Both vertices may be wrong by the largest error, in opposite directions. The noise is 0 for a
    file without a bound: its errors are small where the values are smooth.
    """
    config = volume.container.header.get("config", {})
    if config.get("max_error") is None and config.get("max_error_rel") is None:
        return 0.0
    largest = volume.container.header["quality"].get("max_abs_error")
    return 0.0 if largest is None else 2 * float(largest)


def shading_of(effects: Effects) -> Shading | None:
    """The shading of what is lit, None if nothing is; isosurfaces are always lit."""
    if effects.isosurfaces:
        return effects.shading or Shading()
    return None if effects.projections else effects.shading


def lighting_of(shading: Shading, lamp: Double | None) -> Lighting:
    """The coefficients of a shading, with its lamp; the camera's light if that is None."""
    return Lighting(
        ambient=shading.ambient,
        diffuse=shading.diffuse,
        specular=shading.specular,
        specular_power=shading.specular_power,
        lamp=lamp,
        central=shading.gradient == "central",
    )
