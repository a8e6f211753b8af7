"""The task of a marcher, and its result. All marchers take one task and make one picture.

Sample k of a ray lies `(k + 0.5) * step` behind the place where the ray enters the drawn box of the
whole domain (`Grid.bounds`), or the part of it that a clip leaves; with jitter `(k + a share of the
ray's own) * step`. The last step is as long as the rest of the path, so that the steps fill the
path through the box exactly.

A sample sees the trilinear value at its place, quadrilinear between time steps. A sample whose cell
has a vertex of weight without a value sees nothing. Colour and extinction come from the table,
linear between its entries; alpha = 1 - exp(-extinction * length).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.camera.camera import Grid, Rays
from fhash_codec.rendering.camera.clip import Body

__all__ = [
    "COUNTERS",
    "MAX_VALUES",
    "Frame",
    "Grading",
    "LightGrid",
    "Lighting",
    "Marched",
    "Surface",
    "Table",
    "Task",
    "complete",
    "extinctions_in",
    "rows",
]

Floats = npt.NDArray[np.float64]
Single = npt.NDArray[np.float32]


@dataclass(frozen=True, kw_only=True, eq=False)
class Table:
    """A transfer function at n values; beyond the ends the colour and extinction of the ends hold.

    Attributes:
        low, high: values of the first and the last entry; the others lie evenly between them.
        colours: float32 (n, 3), 0..1.
        extinctions: float64 (n,), per unit of the coordinates.
    """

    low: float
    high: float
    colours: Single
    extinctions: Floats


@dataclass(frozen=True, kw_only=True, eq=False)
class Lighting:
    """Phong's model, two-sided.

    Attributes:
        ambient, diffuse, specular: strengths of the three kinds of light.
        specular_power: exponent of the highlights.
        lamp: unit vector (x, y, z) of the coordinates towards the light; None for a light at the
            camera, along each ray.
        central: whether the gradient is that of central differences, over one vertex of the frame
            to both sides, and not that of the cell.
    """

    ambient: float
    diffuse: float
    specular: float
    specular_power: float
    lamp: Floats | None
    central: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """An isosurface: value in marched units, colour (3,), 0..1, and opacity 0..1."""

    value: float
    colour: Floats
    opacity: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Grading:
    """Factors of the extinction by the size of the gradient; beyond the last one it holds.

    Attributes:
        factors: float64 (GRADES + 1,), 0..1, at even gradients from 0 on, linear between them.
        top: gradient of the last one, above 0, in marched units per unit of the coordinates.
    """

    factors: Floats
    top: float


MAX_VALUES = 2**31 - 1
"""Values of a frame, at most: the native marcher's indices have 32 bits."""
GRADES = 1024
"""Intervals of the factors of a grading: FHASH_GRADES."""
DENSEST = 1e30
"""Largest extinction per length: its smallest part is opaque already."""


def extinctions_in(extinctions: Floats, length: float) -> Floats:
    """Extinctions per `length` from those per unit of the coordinates, DENSEST at most.

    Infinite extinctions would give NaN between the entries of a table.
    """
    with np.errstate(over="ignore"):
        return np.minimum(extinctions * length, DENSEST)


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """The values of one time step in a region.

    Attributes:
        values: float32 (z, y, x), NaN where there is none.
        first: vertex (z, y, x) of the domain at which the first value lies.
        stride: vertices of the domain from one value to the next (level of detail).
    """

    values: Single
    first: tuple[int, int, int]
    stride: int = 1

    def bounds(self, grid: Grid) -> Floats:
        """The box (3, 2), x, y, z, in vertices of the domain, in which the frame has values.

        It reaches to the end of the domain where no further vertex of the frame would fit.
        """
        first, counts = (
            np.array(self.first[::-1], dtype=np.float64),
            np.array(self.values.shape[::-1]),
        )
        ends = first + counts * self.stride
        low = np.where(first == 0, grid.bounds[:, 0], first)
        high = np.where(ends > np.array(grid.counts) - 1, grid.bounds[:, 1], ends - self.stride)
        return np.stack([low, high], axis=-1)


@dataclass(frozen=True, kw_only=True, eq=False)
class LightGrid:
    """Shares of the light that reach the points of a grid; trilinear between them, clamped beyond.

    Attributes:
        shares: float32 (z, y, x, 2), 0..1, of the light from the lamp and of that from around.
        first: vertex (x, y, z) of the domain at which the first point lies.
        cell: vertices of the domain from one point to the next.
        secondary_rays: number of rays that the grid took.
    """

    shares: Single
    first: Floats
    cell: float
    secondary_rays: int = 0


@dataclass(frozen=True, kw_only=True, eq=False)
class Task:
    """Everything that decides a picture of a given frame or model.

    Attributes:
        rays: the rays of the pixels, in vertices of the domain.
        step: length from one sample to the next, in units of the coordinates.
        threshold: a ray ends where less than this share of the light behind comes through.
        table: transfer function; None where no volume is drawn, for surfaces alone.
        lighting: lighting of the surfaces, and of the volume if `shaded`.
        shaded: whether the volume is lit.
        light: shares of the light that shadows and surroundings leave.
        surfaces: isosurfaces.
        projection: 'maximum', 'minimum', 'average' or 'attenuated' to draw that value along each
            ray, opaque in the colour of the table, instead of the volume; '' for the volume.
        attenuation: of the attenuated maximum, per unit of the coordinates.
        grading: opacity by gradient, that of `lighting`, or of the cell without one.
        body: the part of the drawn box that is marched; all of it if None.
        depth, normal: whether to fill these buffers.
        antialiasing: rays along a pixel's side.
        jitter: whether the first sample of each ray is shifted by a share of the ray's own.
        skipping: whether rays leap over invisible bricks.
        noise: difference of two neighbouring vertices, in marched units, below which shading fades.
        error: largest error of a value, in marched units: smoothed values stay within it.
    """

    rays: Rays
    step: float
    threshold: float
    table: Table | None
    lighting: Lighting | None = None
    shaded: bool = False
    light: LightGrid | None = None
    surfaces: tuple[Surface, ...] = ()
    projection: str = ""
    attenuation: float = 0.0
    grading: Grading | None = None
    body: Body | None = None
    depth: bool = False
    normal: bool = False
    antialiasing: int = 1
    jitter: bool = False
    skipping: bool = True
    noise: float = 0.0
    error: float = math.inf

    @property
    def bounds(self) -> Floats:
        """The box (3, 2), x, y, z, in vertices, that is drawn and in which steps are counted."""
        return self.rays.grid.bounds if self.body is None else self.body.bounds

    @property
    def planes(self) -> Floats:
        """The planes (n, 4) that cut the box, as `Body` has them."""
        return np.empty((0, 4)) if self.body is None else self.body.planes

    @property
    def visibility(self) -> tuple[object, ...]:
        """All that decides which values can be seen, as a key: table and values of surfaces."""
        surfaces = tuple(surface.value for surface in self.surfaces)
        if self.table is None:
            return surfaces
        return self.table.low, self.table.high, self.table.extinctions.tobytes(), *surfaces

    @property
    def marched(self) -> Task:
        """The task with the table that samples take: that of the projection, if there is one.

        A value counts for a projection where it has an extinction: any value for the maximum, the
        minimum and the mean. For the attenuated maximum the extinction grows with the value.
        """
        if not self.projection or self.table is None:
            return self
        shape = self.table.extinctions.shape
        extinctions = (
            np.linspace(0.0, self.attenuation, *shape)
            if self.projection == "attenuated"
            else np.full(shape, 1 / self.step)
        )
        return replace(self, table=replace(self.table, extinctions=extinctions))


@dataclass(frozen=True, kw_only=True, eq=False)
class Marched:
    """A finished picture.

    Attributes:
        rgba: float32 (H, W, 4), the colour multiplied by the opacity.
        depth: float32 (H, W), as `Image` has it, or None.
        normal: float32 (H, W, 3), as `Image` has it, or None.
        counters: amounts of work by the names of COUNTERS (below).
    """

    rgba: Single
    depth: Single | None = None
    normal: Single | None = None
    counters: Mapping[str, int] = field(default_factory=dict)


COUNTERS: Mapping[str, str] = MappingProxyType(
    {
        "rays": "that meet the volume",
        "passes": "of samples; for packets, those of each packet",
        "samples": "values looked up along rays",
        "evaluations": "of the network itself",
        "gradients": "at lit samples and surfaces",
        "secondary_rays": "towards light and surroundings",
        "skipped_bricks": "places where rays leapt over what cannot be seen",
        "decoded_vertices": "of the decoded frame, kept ones included",
    }
)
"""Names of the counters and what they count."""


def complete(*parts: Mapping[str, int]) -> dict[str, int]:
    """Sums of counters in the order of COUNTERS, 0 where none is given.

    Raises KeyError for a name that is not among COUNTERS.
    """
    total = dict.fromkeys(COUNTERS, 0)
    for part in parts:
        for name, count in part.items():
            total[name] += int(count)
    return total


def rows(counters: Mapping[str, int]) -> list[tuple[str, str, str]]:
    """Rows (name, count, what it counts) for people to read."""
    return [
        (name.replace("_", " "), f"{counters.get(name, 0):,}", text)
        for name, text in COUNTERS.items()
    ]
