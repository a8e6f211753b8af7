"""The camera: where rays begin and where they go, in vertices of the volume.

Rays live in index space (x, y, z; the first vertex is 0), where the grid is even and a voxel is a
cube: the physical length of a direction is that of the direction times `spacing`. The camera itself
is in the physical coordinates of the series. A picture is thus the same as VTK's with that camera,
with uneven voxels and descending axes too.
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
"""Largest distance of coordinates from even ones without a warning, as a share of the extent."""
VIEWS: Mapping[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "iso": ((1, 1, 1), (0, 0, 1)),
    "xy": ((0, 0, 1), (0, 1, 0)),
    "yx": ((0, 0, -1), (1, 0, 0)),
    "xz": ((0, -1, 0), (0, 0, 1)),
    "zx": ((0, 1, 0), (1, 0, 0)),
    "yz": ((1, 0, 0), (0, 0, 1)),
    "zy": ((-1, 0, 0), (0, 1, 0)),
}
"""Views by name, as in PyVista: direction from the volume to the camera, and upward direction."""
MAX_POSITION = 1e100
"""Largest position that is drawn where it is; its reciprocal is the extent of the shortest axis."""
MAX_AXES_RATIO = 1e14
"""Largest ratio of the longest axis to the shortest vertex spacing.

The eye is a few times as far away as the axis is long, and there float64 tells apart 0.1 spacings.
"""
PARALLEL = 1e-6
"""Sine of the angle between view and upward direction below which the picture has no upright."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Grid:
    """The even grid of vertices that is drawn.

    An axis of one vertex has the mean spacing of the others and reaches half of it to both sides.

    Attributes:
        counts: vertices along x, y, z.
        origin: physical position (x, y, z) of the first vertex, stretched by `scale`.
        spacing: between two vertices (x, y, z), stretched; negative where coordinates descend.
        scale: factors by which the axes (x, y, z) are stretched.
    """

    counts: tuple[int, int, int]
    origin: Floats
    spacing: Floats
    scale: Vector = (1.0, 1.0, 1.0)

    @classmethod
    def of(cls, coords: Mapping[str, Coordinate], scale: Vector | None = None) -> Grid:
        """Make the grid of a volume's coordinates.

        Coordinates that are not even are spread evenly, with an FhashWarning.

        Args:
            coords: by axis.
            scale: factors by which the axes are stretched. If None, axes have the lengths of their
                coordinates, except an axis in other units than most have: its length cannot be
                compared, so its vertices are drawn as far apart as those of the others.

        Raises InputError where axes have lengths too different to place rays.
        """
        axes = [np.asarray(coords[axis].values, dtype=np.float64) for axis in "xyz"]
        spacing = np.full(3, np.nan)
        origin = np.array([values[0] if abs(values[0]) <= MAX_POSITION else 0.0 for values in axes])
        for number, values in enumerate(axes):
            if len(values) == 1:
                continue
            between, problem = _even_spacing(values)
            if between is None:
                spacing[number], origin[number] = 1.0, 0.0
            else:
                spacing[number] = between
            if problem:
                warnings.warn(
                    f"the coordinates {coords['xyz'[number]].name!r} of {'xyz'[number]} {problem}",
                    FhashWarning,
                    stacklevel=2,
                )
        single = np.isnan(spacing)
        factors = (
            _proportions([coords[axis] for axis in "xyz"], np.abs(spacing))
            if scale is None
            else np.array(scale, dtype=np.float64)
        )
        spacing[single] = (
            np.mean(np.abs(spacing * factors)[~single]) / factors[single]
            if not single.all()
            else 1.0
        )
        spacing *= factors
        _check_lengths(spacing, [len(values) for values in axes])
        return cls(
            counts=(len(axes[0]), len(axes[1]), len(axes[2])),
            origin=origin * factors,
            spacing=spacing,
            scale=(float(factors[0]), float(factors[1]), float(factors[2])),
        )

    @property
    def vertex_spacing(self) -> float:
        """The distance between vertices as one length: the geometric mean over the axes."""
        return float(np.exp(np.mean(np.log(np.abs(self.spacing)))))

    @property
    def bounds(self) -> Floats:
        """The box that is drawn in index space: float64 (3, 2), x, y, z."""
        return np.array(
            [[-0.5, 0.5] if count == 1 else [0.0, count - 1.0] for count in self.counts]
        )

    @property
    def corners(self) -> Floats:
        """The drawn box in physical coordinates (3, 2); descending on descending axes."""
        return self.origin[:, None] + self.bounds * self.spacing[:, None]


@dataclass(frozen=True, kw_only=True, eq=False)
class Rays:
    """A ray through the middle of every pixel, in index space.

    Pixel (i, j) of a picture of W x H, i from the left and j from the top, has
    u = 2 (i + 0.5) / W - 1 and w = 1 - 2 (j + 0.5) / H. Its ray is

    - perspective: origin = eye, direction = forward + u right + w up,
    - parallel: origin = eye + u right + w up, direction = forward.

    Other u and w are allowed too, as for several rays of one pixel.

    Attributes:
        eye: position of the camera (x, y, z), float64.
        right: from the middle of the picture to its right edge (x, y, z).
        up: from the middle of the picture to its upper edge (x, y, z).
        forward: direction of view (x, y, z), of physical length 1.
        parallel: whether the projection is parallel.
        size: W, H.
        grid: the vertices that the index space is of.
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
        """Place the rays of a camera; raises InputError without a direction or an upright."""
        low, high = grid.corners[:, 0], grid.corners[:, 1]
        middle = low / 2 + high / 2
        radius = float(np.linalg.norm((grid.bounds[:, 1] - grid.bounds[:, 0]) * grid.spacing / 2))
        focal = middle if camera.focal_point is None else np.array(camera.focal_point)
        aspect = size[0] / size[1]
        # Half the picture's height at a distance of 1; VTK narrows the angle by the zoom instead,
        # which is the same for small ones.
        half = float(np.tan(np.radians(camera.view_angle) / 2))
        narrow = float(np.sin(np.arctan(half * min(aspect, 1.0))))
        away, distance = _towards_camera(camera, focal, radius, radius / narrow)
        upward = np.array(VIEWS[camera.view][1], dtype=np.float64)
        if camera.view_up is not None:
            upward = np.array(camera.view_up)
        turn, right = _upright(away, upward)
        away, right = (_turned(axis, turn, camera.azimuth) for axis in (away, right))
        # The upward direction rises with the camera, so that no elevation leaves the picture
        # without an upright.
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
        # Measured from the first vertex: where coordinates are large beside the volume, a sum with
        # them would lose the eye's place.
        start = (
            grid.bounds.mean(axis=1) * spacing
            if camera.focal_point is None
            else focal - grid.origin
        )
        return cls(
            eye=(start + away * distance) / spacing,
            right=right * half * aspect / spacing,
            up=up * half / spacing,
            forward=-away / spacing,
            parallel=camera.projection == "parallel",
            size=size,
            grid=grid,
        )

    def rays(self, u: npt.ArrayLike, w: npt.ArrayLike) -> tuple[Floats, Floats]:
        """Origins and directions (..., 3) in index space of places in the picture.

        Args:
            u: -1..1 from the left edge to the right one.
            w: -1..1 from the lower edge to the upper one.
        """
        across = (
            np.asarray(u, dtype=np.float64)[..., None] * self.right
            + np.asarray(w, dtype=np.float64)[..., None] * self.up
        )
        if self.parallel:
            return self.eye + across, np.broadcast_to(self.forward, across.shape)
        return np.broadcast_to(self.eye, across.shape), self.forward + across

    def pixels(self) -> tuple[Floats, Floats]:
        """Origins and directions (H, W, 3) of the rays through the middle of every pixel."""
        width, height = self.size
        u = 2 * (np.arange(width) + 0.5) / width - 1
        w = 1 - 2 * (np.arange(height) + 0.5) / height
        return self.rays(*np.meshgrid(u, w))

    def project(self, points: Floats) -> tuple[Floats, Floats]:
        """Project points (..., 3) of index space into the picture.

        A point that is not in front of a perspective camera has a distance of at most 0 and pixels
        that mean nothing.

        Returns:
            Pixels (..., 2) from the left and from the top, the middle of the first at 0.5, and the
            distance (...) in front of the camera along the direction of view, in units of the
            coordinates.
        """
        spacing = self.grid.spacing
        from_eye = (points - self.eye) * spacing
        right, up, forward = (axis * spacing for axis in (self.right, self.up, self.forward))
        depth = from_eye @ forward
        scale = np.ones_like(depth) if self.parallel else np.where(depth > 0, depth, 1.0)
        u = from_eye @ right / (right @ right) / scale
        w = from_eye @ up / (up @ up) / scale
        width, height = self.size
        return np.stack([(u + 1) / 2 * width, (1 - w) / 2 * height], axis=-1), depth


def _even_spacing(values: Floats) -> tuple[float | None, str]:
    """The spacing of two coordinates or more, None if there is none, and a problem, '' if none."""
    # Products of a few lengths, and squares of distances, stay far from the ends of float64. NaN
    # is not ordinary, either.
    ordinary = bool(np.all(np.abs(values) <= MAX_POSITION))
    extent = float(values[-1] - values[0]) if ordinary else 0.0
    if abs(extent) < 1 / MAX_POSITION:
        return None, "are no positions along a line; vertices are drawn one unit apart"
    spacing = extent / (len(values) - 1)
    even = np.linspace(values[0], values[-1], len(values))
    if np.max(np.abs(values - even)) <= TOLERANCE * abs(extent):
        return spacing, ""
    return spacing, "are not evenly spaced; they are drawn as if they were"


def _check_lengths(spacing: Floats, counts: Sequence[int]) -> None:
    """Raise InputError where one axis is too long for the vertex spacing of another."""
    longest = float(np.max(np.abs(spacing) * counts))
    shortest = float(np.min(np.abs(spacing)))
    if longest > MAX_AXES_RATIO * shortest:
        raise InputError(
            f"the longest axis of the volume is {longest:.3g}, and vertices of the shortest are "
            f"{shortest:.3g} apart: no ray can be placed that finely, at most "
            f"{MAX_AXES_RATIO:.0e} times; stretch the axes with 'scale'"
        )


def _proportions(coords: Sequence[Coordinate], spacing: Floats) -> Floats:
    """Factors (3,) that draw vertices of axes in uncommon units as far apart as the others.

    Axes in the commonest units keep their lengths. Where an axis has no units, all do.

    Args:
        coords: of x, y, z.
        spacing: between vertices, at least 0; NaN for an axis of one vertex, which does not count.
    """
    units = [str(coordinate.attributes.get("units", "")).strip() for coordinate in coords]
    extended = np.isfinite(spacing)
    extended_units = [unit for unit, counts in zip(units, extended, strict=True) if counts]
    factors = np.ones(3)
    if len(set(extended_units)) < 2 or "" in extended_units:
        return factors
    usual = max(extended_units, key=extended_units.count)
    is_usual = np.array([unit == usual for unit in units])
    across = float(np.mean(spacing[extended & is_usual]))
    other = extended & ~is_usual
    factors[other] = across / spacing[other]
    return factors


def _towards_camera(
    camera: Camera, focal: Floats, radius: float, distance: float
) -> tuple[Floats, float]:
    """The unit vector from the focal point towards the camera, before it turns, and its distance.

    Args:
        camera: of the scene.
        focal: the focal point.
        radius: of the volume.
        distance: of a camera without a position.

    Raises InputError for a camera that stands at its focal point.
    """
    away = np.array(VIEWS[camera.view][0], dtype=np.float64)
    if camera.position is not None:
        away = np.array(camera.position) - focal
        distance = float(np.linalg.norm(away))
        # Below what float64 tells apart at these coordinates there is no direction either.
        if distance <= 1e-12 * max(radius, float(np.max(np.abs(focal)))):
            raise InputError(
                f"camera: position and focal_point are the same, {_text(focal)}; move one of them"
            )
    return away / np.linalg.norm(away), distance


def _upright(away: Floats, upward: Floats) -> tuple[Floats, Floats]:
    """The upward direction as given and the direction to the right, as unit vectors.

    Raises InputError for an upward direction without a length or along the direction of view.
    """
    # Scaled first, since the squares of the largest numbers are beyond float64.
    unit = upward / max(float(np.abs(upward).max()), 1.0)
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
    """Turn a vector about a unit axis, by Rodrigues' formula."""
    angle = np.radians(degrees)
    return np.asarray(
        vector * np.cos(angle)
        + np.cross(axis, vector) * np.sin(angle)
        + axis * (axis @ vector) * (1 - np.cos(angle)),
        dtype=np.float64,
    )


def _text(vector: Floats) -> str:
    return ", ".join(f"{number:g}" for number in vector)
