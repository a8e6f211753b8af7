"""The camera: where rays begin and where they go, and its path through several poses."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.grid import Grid, vector
from fhash_codec.rendering.scenes import Camera
from fhash_formats.errors import InputError
from fhash_formats.support.values import Double

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

    eye: Double
    right: Double
    up: Double
    forward: Double
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

    def rays(self, u: npt.ArrayLike, w: npt.ArrayLike) -> tuple[Double, Double]:
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

    def pixels(self) -> tuple[Double, Double]:
        """Origins and directions (H, W, 3) of the rays through the middle of every pixel."""
        width, height = self.size
        u = 2 * (np.arange(width) + 0.5) / width - 1
        w = 1 - 2 * (np.arange(height) + 0.5) / height
        return self.rays(*np.meshgrid(u, w))

    def project(self, points: Double) -> tuple[Double, Double]:
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

    'auto' is 'iso', but of a plane or a thin volume (`Grid.thin`) it is the view from above.
    """
    if name != AUTO:
        return name
    return "iso" if grid.thin is None else ("yz", "xz", "xy")[grid.thin]


USUAL_SIZE = 1024
"""Pixels of the longer side of a picture."""
LEAST_SIZE = 128
"""Pixels of the shorter side, at least."""


def usual_size(camera: Camera, grid: Grid) -> tuple[int, int]:
    """Pixels across and down where nobody says them: a plane seen from above fills its picture."""
    view = view_of(camera.view, grid)
    if camera.view != AUTO or not grid.flat or grid.counts.count(1) > 1:
        return USUAL_SIZE, USUAL_SIZE
    away, up = (np.abs(np.array(axis, dtype=np.float64)) for axis in VIEWS[view])
    extent = np.abs(np.diff(grid.corners, axis=1)[:, 0])
    sides = np.array([extent @ (1 - up - away), extent @ up])
    # even, as films need them
    across, down = np.maximum(2 * np.round(USUAL_SIZE / 2 * sides / sides.max()), LEAST_SIZE)
    return int(across), int(down)


def _half_height(grid: Grid, view: str, aspect: float) -> float:
    """Half the height of a picture that a plane or line fills when it is seen from above."""
    away, up = (np.abs(np.array(axis, dtype=np.float64)) for axis in VIEWS[view])
    extent = np.abs(np.diff(grid.corners, axis=1)[:, 0]) / 2
    return float(max(extent @ up, extent @ (1 - up - away) / aspect)) / FILLED


def _towards_camera(
    camera: Camera, view: str, focal: Double, radius: float, distance: float
) -> tuple[Double, float]:
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


def _upright(away: Double, upward: Double) -> tuple[Double, Double]:
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


def _turned(given: Double, axis: Double, degrees: float) -> Double:
    """Turn a vector about a unit axis, by Rodrigues' formula."""
    angle = np.radians(degrees)
    return np.asarray(
        given * np.cos(angle)
        + np.cross(axis, given) * np.sin(angle)
        + axis * (axis @ given) * (1 - np.cos(angle)),
        dtype=np.float64,
    )


def _text(numbers: Double) -> str:
    return ", ".join(f"{number:g}" for number in numbers)


def pchip(at: Double, values: Double, share: float) -> Double:
    """Interpolate values by a cubic that stays between the values on either side.

    Source: Fritsch and Butland, A Method for Constructing Local Monotone Piecewise Cubic
    Interpolants, 1984. At the ends the slope is that of the first and the last piece, so that two
    values are joined by a line.

    Args:
        at: shares (n,), strictly ascending.
        values: (n, k).
        share: between the first and the last of `at`.

    Returns:
        Values (k,).
    """
    if len(at) == 1:
        return np.asarray(values[0], dtype=np.float64)
    width = np.diff(at)[:, None]
    slope = np.diff(values, axis=0) / width
    tangents = np.concatenate([slope[:1], slope])
    if len(slope) > 1:
        first, second = 2 * width[1:] + width[:-1], width[1:] + 2 * width[:-1]
        same_sign = slope[:-1] * slope[1:] > 0
        with np.errstate(divide="ignore", invalid="ignore"):
            mean = (first + second) / (first / slope[:-1] + second / slope[1:])
        tangents[1:-1] = np.where(same_sign, mean, 0.0)
    piece = int(np.clip(np.searchsorted(at, share, side="right") - 1, 0, len(slope) - 1))
    h = float(width[piece, 0])
    t = (share - float(at[piece])) / h
    low, high = values[piece], values[piece + 1]
    return np.asarray(
        (1 + 2 * t) * (1 - t) ** 2 * low
        + t * (1 - t) ** 2 * h * tangents[piece]
        + t * t * (3 - 2 * t) * high
        + t * t * (t - 1) * h * tangents[piece + 1],
        dtype=np.float64,
    )


SMALL = 1e-12
"""Angle in radians below which the sine is taken for the angle."""


def spline(at: Double, rotations: Double, share: float) -> Double:
    """Interpolate rotations smoothly, by the shorter turn between each two.

    The curve consists of cubic Bezier curves on the sphere of quaternions (Shoemake, Animating
    Rotation with Quaternion Curves, 1985).

    Args:
        at: shares (n,), strictly ascending, n >= 2.
        rotations: quaternions (n, 4) at these shares.
        share: between the first and the last of them.
    """
    rotations = rotations.copy()
    for number in range(1, len(rotations)):
        # A quaternion and its negative are one rotation; the nearer one is the shorter turn.
        if rotations[number] @ rotations[number - 1] < 0:
            rotations[number] *= -1
    width = np.diff(at)
    speeds = (
        np.array(
            [
                _log(_product(_inverse(first), second))
                for first, second in itertools.pairwise(rotations)
            ]
        )
        / width[:, None]
    )
    tangents = np.concatenate([speeds[:1], speeds])
    for number in range(1, len(speeds)):
        before, after = width[number - 1], width[number]
        tangents[number] = (after * speeds[number - 1] + before * speeds[number]) / (before + after)
    piece = int(np.clip(np.searchsorted(at, share, side="right") - 1, 0, len(speeds) - 1))
    h, (first, last) = width[piece], rotations[piece : piece + 2]
    points = [
        first,
        _product(first, _exp(tangents[piece] * h / 3)),
        _product(last, _exp(-tangents[piece + 1] * h / 3)),
        last,
    ]
    t = (share - float(at[piece])) / h
    # De Casteljau's algorithm, with arcs in place of lines.
    while len(points) > 1:
        points = [_between(start, end, t) for start, end in itertools.pairwise(points)]
    return np.asarray(points[0], dtype=np.float64)


def from_matrix(matrix: Double) -> Double:
    """Convert a rotation matrix (3, 3), by its largest component, which is never near 0.

    Source: Shepperd, Quaternion from Rotation Matrix, 1978.
    """
    trace = float(np.trace(matrix))
    candidates = np.array([trace, *np.diag(matrix)])
    largest = int(np.argmax(candidates))
    twice = (
        np.sqrt(max(1 - trace + 2 * candidates[largest], 0.0)) if largest else np.sqrt(1 + trace)
    )
    wx, wy, wz = (
        matrix[2, 1] - matrix[1, 2],
        matrix[0, 2] - matrix[2, 0],
        matrix[1, 0] - matrix[0, 1],
    )
    xy, xz, yz = (
        matrix[0, 1] + matrix[1, 0],
        matrix[0, 2] + matrix[2, 0],
        matrix[1, 2] + matrix[2, 1],
    )
    rows = ((0, wx, wy, wz), (wx, 0, xy, xz), (wy, xy, 0, yz), (wz, xz, yz, 0))
    rotation = np.array(rows[largest], dtype=np.float64) / (2 * twice)
    rotation[largest] = twice / 2
    return np.asarray(rotation / np.linalg.norm(rotation), dtype=np.float64)


def to_matrix(rotation: Double) -> Double:
    """Convert a quaternion to a rotation matrix (3, 3)."""
    w, x, y, z = rotation / np.linalg.norm(rotation)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _between(first: Double, second: Double, t: float) -> Double:
    """The rotation at `t`, 0..1, of the turn from one rotation to another."""
    return _product(first, _exp(t * _log(_product(_inverse(first), second))))


def _product(a: Double, b: Double) -> Double:
    return np.array(
        [a[0] * b[0] - a[1:] @ b[1:], *(a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:]))]
    )


def _inverse(a: Double) -> Double:
    return np.asarray(a * np.array([1.0, -1.0, -1.0, -1.0]), dtype=np.float64)


def _log(a: Double) -> Double:
    """Half the angle of a rotation, as a vector (3,) along its axis."""
    sine = float(np.linalg.norm(a[1:]))
    return np.asarray(
        a[1:] * (np.arctan2(sine, a[0]) / sine if sine > SMALL else 1.0), dtype=np.float64
    )


def _exp(half: Double) -> Double:
    """The rotation of twice the angle of a vector (3,) along its axis."""
    angle = float(np.linalg.norm(half))
    return np.array([np.cos(angle), *(half * (np.sin(angle) / angle if angle > SMALL else 1.0))])


PLACED = ("position", "focal_point", "view_up", "view")
"""Settings of a camera that say where it stands before its angles turn it."""
STEEP = 0.9998
"""Sine of the elevation above which a camera is too near the zenith to go around it, 1 degree."""


class _Pose(NamedTuple):
    """Physical focal point (3,), distance from it, and rotation (4,) as a quaternion."""

    focal: Double
    distance: float
    rotation: Double


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraPath:
    """The camera at every share of an animation.

    Before the first pose and after the last one the camera rests there.

    Attributes:
        at: shares (n,) of the poses, strictly ascending.
        cameras: the poses, n of them.
        grid: of the volume.
        size: W, H of the picture.
    """

    at: Double
    cameras: tuple[Camera, ...]
    grid: Grid
    size: tuple[int, int]

    def camera(self, share: float) -> Camera:
        """The camera at a share of the animation; at the share of a pose the pose itself."""
        share = float(np.clip(share, self.at[0], self.at[-1]))
        exact = np.flatnonzero(self.at == share)
        if exact.size:
            return self.cameras[int(exact[0])]
        before = self.cameras[int(np.searchsorted(self.at, share)) - 1]
        place = self._angles(share) if self._is_turning() else self._position(share)
        return dataclasses.replace(before, **place, **self._lens(share))

    def _is_turning(self) -> bool:
        """Whether the poses differ only in their angles and lenses."""
        return all(
            getattr(camera, name) == getattr(self.cameras[0], name)
            for camera in self.cameras
            for name in PLACED
        )

    def _angles(self, share: float) -> dict[str, Any]:
        """Azimuth and elevation, followed as they are given, whole turns included."""
        angles = np.array([[camera.azimuth, camera.elevation] for camera in self.cameras])
        azimuth, elevation = pchip(self.at, angles, share)
        return {"azimuth": float(azimuth), "elevation": float(np.clip(elevation, -90, 90))}

    def _position(self, share: float) -> dict[str, Any]:
        """Position, focal point and upward direction; the distance changes by constant factors."""
        poses = [_pose(Rays.of(camera, self.grid, self.size), camera) for camera in self.cameras]
        places = np.array([[*pose.focal, np.log(pose.distance)] for pose in poses])
        place = pchip(self.at, places, share)
        focal, distance = place[:3], np.exp(place[3])
        rotations = np.array([pose.rotation for pose in poses])
        away, up = self._upright(rotations, share) or tuple(
            to_matrix(spline(self.at, rotations, share)).T[[2, 1]]
        )
        return {
            "azimuth": 0.0,
            "elevation": 0.0,
            "position": vector(focal + away * distance),
            "focal_point": vector(focal),
            "view_up": vector(up),
        }

    def _upright(self, rotations: Double, share: float) -> tuple[Double, Double] | None:
        """The direction towards a camera that goes around the upward direction and rises, and up.

        None unless all poses have the same upward direction and none looks along it.
        """
        ups = np.array(
            [
                camera.view_up or VIEWS[view_of(camera.view, self.grid)][1]
                for camera in self.cameras
            ],
            dtype=np.float64,
        )
        ups /= np.linalg.norm(ups, axis=1, keepdims=True)
        away = np.array([to_matrix(rotation)[:, 2] for rotation in rotations])
        up = ups[0]
        heights = away @ up
        if not np.allclose(ups, up) or np.max(np.abs(heights)) > STEEP:
            return None
        first = away[0] - heights[0] * up
        first /= np.linalg.norm(first)
        second = np.cross(up, first)
        around = np.unwrap(np.arctan2(away @ second, away @ first))
        angle, rise = pchip(self.at, np.stack([around, np.arcsin(heights)], axis=-1), share)
        return np.cos(rise) * (np.cos(angle) * first + np.sin(angle) * second) + np.sin(
            rise
        ) * up, up

    def _lens(self, share: float) -> dict[str, Any]:
        """Zoom, angle and parallel scale, as far as every pose gives them and they change."""
        lens = {}
        for name in ("zoom", "view_angle", "parallel_scale"):
            values = [getattr(camera, name) for camera in self.cameras]
            if None not in values and any(value != values[0] for value in values):
                lens[name] = float(np.exp(pchip(self.at, np.log(values)[:, None], share)[0]))
        return lens


def _pose(rays: Rays, camera: Camera) -> _Pose:
    """The pose of a camera, whose angles and view by name are already in its rays."""
    spacing = rays.grid.spacing
    eye = rays.eye * spacing + rays.grid.origin
    forward, up = rays.forward * spacing, rays.up * spacing
    focal = (
        np.array(camera.focal_point)
        if camera.focal_point is not None
        else rays.grid.corners.mean(axis=1)
    )
    up = up / np.linalg.norm(up)
    return _Pose(
        focal=focal,
        distance=float(np.linalg.norm(eye - focal)),
        rotation=from_matrix(np.stack([np.cross(forward, up), up, -forward], axis=1)),
    )
