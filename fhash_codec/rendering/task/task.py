"""What a marcher is asked for, and what it gives: one task for every way to march, so that all make one picture.

Sample k of a ray lies `(k + 0.5) * step` behind the place where the ray enters the drawn box of the whole domain (`Grid.bounds`), or
`(k + its share) * step` with jitter; the last step is as long as what is left, so that the path through the box is exactly its length.
What a sample sees is the trilinear (between steps quadrilinear) value there; a sample whose cell has a vertex of weight without a value
sees nothing. Colour and extinction come from the table, linear between its entries; alpha = 1 - exp(-extinction * length).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.camera.camera import Grid, Rays

__all__ = [
    "Frame",
    "LightGrid",
    "Lighting",
    "Marched",
    "Surface",
    "Table",
    "Task",
    "extinctions_in",
]

Floats = npt.NDArray[np.float64]
Single = npt.NDArray[np.float32]


@dataclass(frozen=True, kw_only=True, eq=False)
class Table:
    """A transfer function at n values spread evenly from `low` to `high`; beyond the ends those of the ends.

    colours: float32 (n, 3), 0..1. extinctions: float64 (n,), per unit of the coordinates.
    """

    low: float
    high: float
    colours: Single
    extinctions: Floats


@dataclass(frozen=True, kw_only=True, eq=False)
class Lighting:
    """Phong, two-sided. lamp: unit vector (x, y, z) of the coordinates towards the light; None: from the camera along each ray.

    central: by differences between the places one vertex of the frame before and behind along each axis, not by the gradient of the cell.
    """

    ambient: float
    diffuse: float
    specular: float
    specular_power: float
    lamp: Floats | None
    central: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """An isosurface: value in data units, colour (3,) and opacity 0..1."""

    value: float
    colour: Floats
    opacity: float


DENSEST = 1e30
"""An extinction of which the smallest part is opaque."""


def extinctions_in(extinctions: Floats, length: float) -> Floats:
    """Extinctions in a length of the coordinates, DENSEST at most: infinite ones would give NaN between the entries of a table."""
    with np.errstate(over="ignore"):
        return np.minimum(extinctions * length, DENSEST)


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """Values float32 (z, y, x) of a step, NaN where there is none.

    first: vertex (z, y, x) of the domain that the first value is of. stride: vertices from one value to the next (level of detail).
    """

    values: Single
    first: tuple[int, int, int]
    stride: int = 1

    def bounds(self, grid: Grid) -> Floats:
        """The box (3, 2), x, y, z, in vertices of the domain, that there are values of.

        It reaches to the end of the domain where no more vertices of the frame would fit.
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
    """Shares 0..1 of the light that reach a place, float32 (z, y, x, 2): from the lamp, and from around; trilinear, clamped.

    first: vertex (x, y, z) of the domain that the first point lies at. cell: vertices from one point to the next.
    secondary_rays: that it took.
    """

    shares: Single
    first: Floats
    cell: float
    secondary_rays: int = 0


@dataclass(frozen=True, kw_only=True, eq=False)
class Task:
    """All that decides a picture once the scene met the file.

    Attributes:
        rays: in vertices of the domain. step: length in units of the coordinates. threshold: share of the light behind at which a ray ends.
        table: None where no volume is drawn, for surfaces alone.
        lighting: of the surfaces, and of the volume if `shaded`. light: what shadows and surroundings leave of it.
        maximum: the largest value along each ray, with the colour of the table and opaque, instead of the volume.
        depth, normal: buffers to fill. antialiasing: rays along a pixel's side. jitter: a share of its own for each ray's first sample.
        skipping: whether what cannot be seen is passed over.
    """

    rays: Rays
    step: float
    threshold: float
    table: Table | None
    lighting: Lighting | None = None
    shaded: bool = False
    light: LightGrid | None = None
    surfaces: tuple[Surface, ...] = ()
    maximum: bool = False
    depth: bool = False
    normal: bool = False
    antialiasing: int = 1
    jitter: bool = False
    skipping: bool = True


@dataclass(frozen=True, kw_only=True, eq=False)
class Marched:
    """A picture: rgba float32 (H, W, 4), multiplied by the opacity; depth (H, W), normal (H, W, 3) as `Image` has them, or None.

    counters: rays, passes (of all rays that are alive; for packets, of each packet), samples (values looked up), evaluations (of a network
    or lattice beyond the cache), gradients, secondary_rays, skipped_bricks.
    """

    rgba: Single
    depth: Single | None = None
    normal: Single | None = None
    counters: Mapping[str, int] = field(default_factory=dict)
