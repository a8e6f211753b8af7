"""The camera: where rays begin and where they go, in vertices of the volume.

Rays live in index space (x, y, z; the first vertex is 0), where the grid is even and a voxel is a
cube: the physical length of a direction is that of the direction times `spacing`. The camera itself
is in the physical coordinates of the series. A picture is thus the same as VTK's with that camera,
with uneven voxels and descending axes too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.camera.grid import Grid
from fhash_codec.rendering.scene.scene import Camera
from fhash_formats.errors import InputError

__all__ = ["Grid", "Rays", "view_of"]

Floats = npt.NDArray[np.float64]
Vector = tuple[float, float, float]

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
AUTO = "auto"
"""Name of the view that depends on the volume, see `view_of`."""
FILLED = 0.98
"""Share of the picture, across or down, that a plane seen from above fills."""
PARALLEL = 1e-6
"""Sine of the angle between view and upward direction below which the picture has no upright."""


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
        view = view_of(camera.view, grid)
        radius = float(np.linalg.norm((grid.bounds[:, 1] - grid.bounds[:, 0]) * grid.spacing / 2))
        focal = middle if camera.focal_point is None else np.array(camera.focal_point)
        aspect = size[0] / size[1]
        # Half the picture's height at a distance of 1; VTK narrows the angle by the zoom instead,
        # which is the same for small ones.
        half = float(np.tan(np.radians(camera.view_angle) / 2))
        narrow = float(np.sin(np.arctan(half * min(aspect, 1.0))))
        distance, parallel_half = radius / narrow, radius / min(aspect, 1.0)
        if camera.view == AUTO and grid.flat:
            parallel_half = _half_height(grid, view, aspect)
            thickness = float(np.abs(np.diff(grid.corners, axis=1)[:, 0] @ VIEWS[view][0]))
            distance = parallel_half / half + thickness / 2
        away, distance = _towards_camera(camera, view, focal, radius, distance)
        upward = np.array(VIEWS[view][1], dtype=np.float64)
        if camera.view_up is not None:
            upward = np.array(camera.view_up)
        turn, right = _upright(away, upward)
        away, right = (_turned(axis, turn, camera.azimuth) for axis in (away, right))
        # The upward direction rises with the camera, so that no elevation leaves the picture
        # without an upright.
        away = _turned(away, -right, camera.elevation)
        up = np.cross(away, right)
        if camera.projection == "parallel":
            half = camera.parallel_scale if camera.parallel_scale is not None else parallel_half
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


def view_of(name: str, grid: Grid) -> str:
    """The key of VIEWS that the name of a view stands for.

    'auto' is 'iso', but the view along an axis of one vertex: the plane is seen from above.
    """
    if name != AUTO:
        return name
    for axis, view in ((2, "xy"), (1, "xz"), (0, "yz")):
        if grid.counts[axis] == 1:
            return view
    return "iso"


def _half_height(grid: Grid, view: str, aspect: float) -> float:
    """Half the height of a picture that a plane or line fills when it is seen from above."""
    away, up = (np.abs(np.array(axis, dtype=np.float64)) for axis in VIEWS[view])
    extent = np.abs(np.diff(grid.corners, axis=1)[:, 0]) / 2
    return float(max(extent @ up, extent @ (1 - up - away) / aspect)) / FILLED


def _towards_camera(
    camera: Camera, view: str, focal: Floats, radius: float, distance: float
) -> tuple[Floats, float]:
    """The unit vector from the focal point towards the camera, before it turns, and its distance.

    Args:
        camera: of the scene.
        view: key of VIEWS.
        focal: the focal point.
        radius: of the volume.
        distance: of a camera without a position.

    Raises InputError for a camera that stands at its focal point.
    """
    away = np.array(VIEWS[view][0], dtype=np.float64)
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
