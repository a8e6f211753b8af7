"""The camera: where rays begin and where they go, in vertices of the volume.

Rays live in index space (x, y, z; the first vertex is 0), where the grid is even and a voxel is a cube: a physical length along
a direction is that of the direction times `spacing`. The camera itself is in the physical coordinates of the series, so that a
picture is as VTK's of the same camera, uneven voxels and descending axes included.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.scene.scene import Camera
from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.series import Coordinate

__all__ = ["Grid", "Rays"]

Floats = npt.NDArray[np.float64]
Vector = tuple[float, float, float]

TOLERANCE = 1e-3
"""Of an axis's extent: coordinates further from even ones are drawn as even ones with a warning."""
VIEWS: Mapping[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "iso": ((1, 1, 1), (0, 0, 1)),
    "xy": ((0, 0, 1), (0, 1, 0)),
    "yx": ((0, 0, -1), (1, 0, 0)),
    "xz": ((0, -1, 0), (0, 0, 1)),
    "zx": ((0, 1, 0), (1, 0, 0)),
    "yz": ((1, 0, 0), (0, 0, 1)),
    "zy": ((-1, 0, 0), (0, 1, 0)),
}
"""Direction from the volume towards the camera, and what is upwards, as PyVista has them."""
LONGEST = 1e100
"""Largest position that is drawn where it is, and the reciprocal of the shortest axis."""
FARTHEST = 1e14
"""Lengths of a vertex spacing that a picture is across, at most: eyes are a few times as far away, and float64 tells 0.1 of one apart."""
PARALLEL = 1e-6
"""Sine of the angle between view and upward direction below which the picture has no upright."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Grid:
    """Where the vertices are: `counts`, `origin` of the first and `spacing` between two, each (x, y, z).

    Spacings are negative where coordinates descend. An axis of one vertex has the mean of the others' and reaches half of it
    to both sides. `scale` (x, y, z) is contained in both: by how much the axes are stretched.
    """

    counts: tuple[int, int, int]
    origin: Floats
    spacing: Floats
    scale: Vector = (1.0, 1.0, 1.0)

    @classmethod
    def of(cls, coords: Mapping[str, Coordinate], scale: Vector | None = None) -> Grid:
        """From a volume's coordinates; warns with FhashWarning where they are not even, and then spreads them evenly.

        scale: factors by which the axes are stretched. If None they have the lengths of their coordinates, but for an axis in other
        units than the most have, whose length cannot be compared: its vertices are drawn as far apart as those of the others.
        Raises InputError where axes are of lengths too different to place rays.
        """
        axes = [np.asarray(coords[axis].values, dtype=np.float64) for axis in "xyz"]
        spacing = np.full(3, np.nan)
        origin = np.array([values[0] if abs(values[0]) <= LONGEST else 0.0 for values in axes])
        for number, values in enumerate(axes):
            if len(values) == 1:
                continue
            # Not NaN, either. Products of a few lengths, and squares of distances, stay far from the ends of float64.
            ordinary = bool(np.all(np.abs(values) <= LONGEST))
            extent = values[-1] - values[0] if ordinary else 0.0
            if abs(extent) < 1 / LONGEST:
                spacing[number], origin[number] = 1.0, 0.0
                wrong = "are no positions along a line; vertices are drawn one unit apart"
            else:
                spacing[number] = extent / (len(values) - 1)
                if np.max(
                    np.abs(values - np.linspace(values[0], values[-1], len(values)))
                ) <= TOLERANCE * abs(extent):
                    continue
                wrong = "are not evenly spaced; they are drawn as if they were"
            warnings.warn(
                f"the coordinates {coords['xyz'[number]].name!r} of {'xyz'[number]} {wrong}",
                FhashWarning,
                stacklevel=2,
            )
        flat = np.isnan(spacing)
        factors = (
            _proportions([coords[axis] for axis in "xyz"], np.abs(spacing))
            if scale is None
            else np.array(scale, dtype=np.float64)
        )
        spacing[flat] = (
            np.mean(np.abs(spacing * factors)[~flat]) / factors[flat] if not flat.all() else 1.0
        )
        spacing *= factors
        longest, shortest = (
            float(np.max(np.abs(spacing) * [len(values) for values in axes])),
            float(np.min(np.abs(spacing))),
        )
        if longest > FARTHEST * shortest:
            raise InputError(
                f"the longest axis of the volume is {longest:.3g}, and vertices of the shortest are {shortest:.3g} apart: no ray can be "
                f"placed that finely, at most {FARTHEST:.0e} times; stretch the axes with 'scale'"
            )
        return cls(
            counts=(len(axes[0]), len(axes[1]), len(axes[2])),
            origin=origin * factors,
            spacing=spacing,
            scale=(float(factors[0]), float(factors[1]), float(factors[2])),
        )

    @property
    def vertex_spacing(self) -> float:
        """One length for the distance between vertices: the geometric mean of those along the axes."""
        return float(np.exp(np.mean(np.log(np.abs(self.spacing)))))

    @property
    def bounds(self) -> Floats:
        """The box that is drawn in index space: float64 (3, 2), x, y, z."""
        return np.array(
            [[-0.5, 0.5] if count == 1 else [0.0, count - 1.0] for count in self.counts]
        )

    @property
    def corners(self) -> Floats:
        """The same box in physical coordinates (3, 2); the second is the smaller on a descending axis."""
        return self.origin[:, None] + self.bounds * self.spacing[:, None]


@dataclass(frozen=True, kw_only=True, eq=False)
class Rays:
    """A ray through the middle of every pixel, in index space, float64 (3,) in x, y, z.

    Pixel (i, j), i from the left and j from the top, of `size` (W, H) has u = 2 (i + 0.5) / W - 1 and w = 1 - 2 (j + 0.5) / H.
    Perspective: origin = eye, direction = forward + u right + w up. Parallel: origin = eye + u right + w up, direction = forward.
    `forward` has a physical length of 1; u and w of any value, as in the parts of a pixel, are allowed.
    """

    eye: Floats
    right: Floats
    up: Floats
    forward: Floats
    parallel: bool
    size: tuple[int, int]
    grid: Grid

    @classmethod
    def of(cls, camera: Camera, grid: Grid, size: tuple[int, int]) -> Rays:
        """The rays of a camera; raises InputError where it has no direction or no upright."""
        low, high = grid.corners[:, 0], grid.corners[:, 1]
        middle = low / 2 + high / 2
        radius = float(np.linalg.norm((grid.bounds[:, 1] - grid.bounds[:, 0]) * grid.spacing / 2))
        focal = middle if camera.focal_point is None else np.array(camera.focal_point)
        aspect = size[0] / size[1]
        # Half the picture's height at a distance of 1; VTK narrows the angle by the zoom instead, which is the same for small ones.
        half = float(np.tan(np.radians(camera.view_angle) / 2))
        narrow = float(np.sin(np.arctan(half * min(aspect, 1.0))))
        away, upward = (np.array(part, dtype=np.float64) for part in VIEWS[camera.view])
        if camera.view_up is not None:
            upward = np.array(camera.view_up)
        distance = radius / narrow
        if camera.position is not None:
            away = np.array(camera.position) - focal
            distance = float(np.linalg.norm(away))
            # Below what float64 tells apart at these coordinates there is no direction either.
            if distance <= 1e-12 * max(radius, float(np.max(np.abs(focal)))):
                raise InputError(
                    f"camera: position and focal_point are the same, {_text(focal)}; move one of them"
                )
        away = away / np.linalg.norm(away)
        turn, right = _upright(away, upward)
        away, right = (_turned(part, turn, camera.azimuth) for part in (away, right))
        # The upward direction rises with the camera, so that no elevation leaves the picture without an upright.
        away = _turned(away, -right, camera.elevation)
        up = np.cross(away, right)
        if camera.projection == "parallel":
            half = (
                camera.parallel_scale
                if camera.parallel_scale is not None
                else radius / min(aspect, 1.0)
            )
        half /= camera.zoom
        spacing = grid.spacing
        # From the first vertex: where coordinates are large beside the volume, a sum with them would lose the eye's place.
        begin = (
            grid.bounds.mean(axis=1) * spacing
            if camera.focal_point is None
            else focal - grid.origin
        )
        return cls(
            eye=(begin + away * distance) / spacing,
            right=right * half * aspect / spacing,
            up=up * half / spacing,
            forward=-away / spacing,
            parallel=camera.projection == "parallel",
            size=size,
            grid=grid,
        )

    def rays(self, u: npt.ArrayLike, w: npt.ArrayLike) -> tuple[Floats, Floats]:
        """Origins and directions (..., 3) in index space of places in the picture, -1..1 to the right and upwards."""
        across = (
            np.asarray(u, dtype=np.float64)[..., None] * self.right
            + np.asarray(w, dtype=np.float64)[..., None] * self.up
        )
        if self.parallel:
            return self.eye + across, np.broadcast_to(self.forward, across.shape)
        return np.broadcast_to(self.eye, across.shape), self.forward + across

    def pixels(self) -> tuple[Floats, Floats]:
        """Origins and directions (H, W, 3) of every pixel's middle."""
        width, height = self.size
        u = 2 * (np.arange(width) + 0.5) / width - 1
        w = 1 - 2 * (np.arange(height) + 0.5) / height
        return self.rays(*np.meshgrid(u, w))

    def project(self, points: Floats) -> tuple[Floats, Floats]:
        """Where points (..., 3) of index space appear: pixels (..., 2) from the left and from the top, whose first has its middle at
        0.5, and their distance (...) in front of the camera along the middle of the view in units of the coordinates.

        A point that is not in front of a perspective camera has a distance of at most 0 and pixels that mean nothing.
        """
        spacing = self.grid.spacing
        from_eye = (points - self.eye) * spacing
        right, up, forward = (part * spacing for part in (self.right, self.up, self.forward))
        depth = from_eye @ forward
        scale = np.ones_like(depth) if self.parallel else np.where(depth > 0, depth, 1.0)
        u = from_eye @ right / (right @ right) / scale
        w = from_eye @ up / (up @ up) / scale
        width, height = self.size
        return np.stack([(u + 1) / 2 * width, (1 - w) / 2 * height], axis=-1), depth


def _proportions(coords: Sequence[Coordinate], spacing: Floats) -> Floats:
    """Factors (3,) that leave all axes of the commonest units as they are, and draw vertices of the others as far apart as those."""
    units = [str(each.attributes.get("units", "")).strip() for each in coords]
    known = [each for each, length in zip(units, spacing, strict=True) if np.isfinite(length)]
    factors = np.ones(3)
    if len(set(known)) < 2 or "" in known:
        return factors
    usual = max(known, key=known.count)
    across = float(
        np.mean(
            [
                length
                for each, length in zip(units, spacing, strict=True)
                if each == usual and np.isfinite(length)
            ]
        )
    )
    for axis, (each, length) in enumerate(zip(units, spacing, strict=True)):
        if each != usual and np.isfinite(length):
            factors[axis] = across / length
    return factors


def _upright(away: Floats, upward: Floats) -> tuple[Floats, Floats]:
    """Unit vectors: the upward direction as given, and the one to the right in the picture."""
    unit = upward / max(
        float(np.abs(upward).max()), 1.0
    )  # first, since the squares of the largest numbers go beyond float64
    length = float(np.linalg.norm(unit))
    if not length > 0 or not np.isfinite(length):
        raise InputError("camera: view_up has no length; give a direction such as 0, 0, 1")
    unit = unit / length
    right = np.cross(unit, away)
    if np.linalg.norm(right) < PARALLEL:
        raise InputError(
            f"camera: view_up {_text(upward)} is parallel to the direction of view; give another"
        )
    return unit, right / np.linalg.norm(right)


def _turned(vector: Floats, axis: Floats, degrees: float) -> Floats:
    """A vector turned about a unit axis, by Rodrigues' formula."""
    angle = np.radians(degrees)
    return np.asarray(
        vector * np.cos(angle)
        + np.cross(axis, vector) * np.sin(angle)
        + axis * (axis @ vector) * (1 - np.cos(angle)),
        dtype=np.float64,
    )


def _text(vector: Floats) -> str:
    return ", ".join(f"{part:g}" for part in vector)
