"""A camera's way through several poses: smooth in place, distance and direction, and with one speed between two of them."""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.camera.camera import VIEWS, Grid, Rays
from fhash_codec.rendering.scene.scene import Camera

__all__ = ["CameraPath", "pchip"]

Floats = npt.NDArray[np.float64]

PLACED = ("position", "focal_point", "view_up", "view")
"""Settings of a camera that say where it stands; where they are the same, the angles turn it from there."""
STEEP = 0.9998
"""Sine of the elevation, of about a degree from the zenith, above which there is no way around."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraPath:
    """Where a camera is at any share of an animation; before the first pose and after the last it rests there.

    at: shares (n,), strictly ascending. cameras: n of them.
    """

    at: Floats
    cameras: tuple[Camera, ...]
    grid: Grid
    size: tuple[int, int]

    def camera(self, share: float) -> Camera:
        """The camera at a share; on a pose that pose itself."""
        share = float(np.clip(share, self.at[0], self.at[-1]))
        exact = np.flatnonzero(self.at == share)
        if exact.size:
            return self.cameras[int(exact[0])]
        before = self.cameras[int(np.searchsorted(self.at, share)) - 1]
        lens = self._lens(share)
        if all(
            getattr(camera, name) == getattr(self.cameras[0], name)
            for camera in self.cameras
            for name in PLACED
        ):
            # Angles are followed as they are given, whole turns included.
            turned = pchip(
                self.at,
                np.array([[camera.azimuth, camera.elevation] for camera in self.cameras]),
                share,
            )
            return dataclasses.replace(
                before,
                azimuth=float(turned[0]),
                elevation=float(np.clip(turned[1], -90, 90)),
                **lens,
            )
        poses = [_pose(Rays.of(camera, self.grid, self.size), camera) for camera in self.cameras]
        place = pchip(
            self.at, np.array([[*focal, np.log(distance)] for focal, distance, _ in poses]), share
        )
        turns, focal = np.array([turn for _, _, turn in poses]), place[:3]
        away, up = self._upright(turns, share) or tuple(
            _matrix(_turning(self.at, turns, share)).T[[2, 1]]
        )
        return dataclasses.replace(
            before,
            azimuth=0.0,
            elevation=0.0,
            position=_triple(focal + away * np.exp(place[3])),
            focal_point=_triple(focal),
            view_up=_triple(up),
            **lens,
        )

    def _upright(self, turns: Floats, share: float) -> tuple[Floats, Floats] | None:
        """Direction towards the camera, and what is upwards, of cameras that all have the same above them: they go around it and rise.

        None where they have not, or where one looks along it.
        """
        ups = np.array(
            [camera.view_up or VIEWS[camera.view][1] for camera in self.cameras], dtype=np.float64
        )
        ups /= np.linalg.norm(ups, axis=1, keepdims=True)
        away = np.array([_matrix(turn)[:, 2] for turn in turns])
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
        """What changes of zoom, angle, and the scale of a parallel projection, if every camera gives one."""
        found = {}
        for name in ("zoom", "view_angle", "parallel_scale"):
            values = [getattr(camera, name) for camera in self.cameras]
            if None not in values and any(value != values[0] for value in values):
                found[name] = float(np.exp(pchip(self.at, np.log(values)[:, None], share)[0]))
        return found


def pchip(at: Floats, values: Floats, share: float) -> Floats:
    """The cubic through values (n, k) at shares (n,) that never leaves the values on either side.

    Fritsch and Butland, A Method for Constructing Local Monotone Piecewise Cubic Interpolants, 1984; at the ends the slope of the
    first and the last piece, so that two values are joined by a line.
    """
    if len(at) == 1:
        return np.asarray(values[0], dtype=np.float64)
    width = np.diff(at)[:, None]
    slope = np.diff(values, axis=0) / width
    tangents = np.concatenate([slope[:1], slope])
    if len(slope) > 1:
        first, second = 2 * width[1:] + width[:-1], width[1:] + 2 * width[:-1]
        same = slope[:-1] * slope[1:] > 0
        with np.errstate(divide="ignore", invalid="ignore"):
            mean = (first + second) / (first / slope[:-1] + second / slope[1:])
        tangents[1:-1] = np.where(same, mean, 0.0)
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


def _pose(rays: Rays, camera: Camera) -> tuple[Floats, float, Floats]:
    """Focal point, distance from it, and direction as a quaternion (w, x, y, z), all physical."""
    spacing = rays.grid.spacing
    eye, forward, up = (
        rays.eye * spacing + rays.grid.origin,
        rays.forward * spacing,
        rays.up * spacing,
    )
    focal = (
        np.array(camera.focal_point)
        if camera.focal_point is not None
        else rays.grid.corners.mean(axis=1)
    )
    up = up / np.linalg.norm(up)
    return (
        focal,
        float(np.linalg.norm(eye - focal)),
        _quaternion(np.stack([np.cross(forward, up), up, -forward], axis=1)),
    )


def _turning(at: Floats, turns: Floats, share: float) -> Floats:
    """A smooth way over directions: cubic Bezier curves on the sphere of quaternions (Shoemake 1985), each piece of the shorter turn."""
    turns = turns.copy()
    for number in range(1, len(turns)):
        if turns[number] @ turns[number - 1] < 0:
            turns[number] *= -1
    width = np.diff(at)
    speeds = (
        np.array(
            [_log(_product(_inverse(first), second)) for first, second in itertools.pairwise(turns)]
        )
        / width[:, None]
    )
    tangents = np.concatenate([speeds[:1], speeds])
    for number in range(1, len(speeds)):
        before, after = width[number - 1], width[number]
        tangents[number] = (after * speeds[number - 1] + before * speeds[number]) / (before + after)
    piece = int(np.clip(np.searchsorted(at, share, side="right") - 1, 0, len(speeds) - 1))
    h, (first, last) = width[piece], turns[piece : piece + 2]
    points = [
        first,
        _product(first, _exp(tangents[piece] * h / 3)),
        _product(last, _exp(-tangents[piece + 1] * h / 3)),
        last,
    ]
    t = (share - float(at[piece])) / h
    while len(points) > 1:
        points = [_between(one, other, t) for one, other in itertools.pairwise(points)]
    return np.asarray(points[0], dtype=np.float64)


def _between(one: Floats, other: Floats, t: float) -> Floats:
    return _product(one, _exp(t * _log(_product(_inverse(one), other))))


def _product(a: Floats, b: Floats) -> Floats:
    return np.array(
        [a[0] * b[0] - a[1:] @ b[1:], *(a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:]))]
    )


def _inverse(a: Floats) -> Floats:
    return np.asarray(a * np.array([1.0, -1.0, -1.0, -1.0]), dtype=np.float64)


def _log(a: Floats) -> Floats:
    """Half the turn of a unit quaternion as a vector along its axis."""
    sine = float(np.linalg.norm(a[1:]))
    return np.asarray(
        a[1:] * (np.arctan2(sine, a[0]) / sine if sine > 1e-12 else 1.0), dtype=np.float64
    )


def _exp(half: Floats) -> Floats:
    angle = float(np.linalg.norm(half))
    return np.array([np.cos(angle), *(half * (np.sin(angle) / angle if angle > 1e-12 else 1.0))])


def _quaternion(matrix: Floats) -> Floats:
    """Of a rotation (3, 3), by its largest part, which is never near 0 (Shepperd 1978)."""
    trace = float(np.trace(matrix))
    parts = np.array([trace, *np.diag(matrix)])
    largest = int(np.argmax(parts))
    whole = np.sqrt(max(1 - trace + 2 * parts[largest], 0.0)) if largest else np.sqrt(1 + trace)
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
    found = np.array(rows[largest], dtype=np.float64) / (2 * whole)
    found[largest] = whole / 2
    return np.asarray(found / np.linalg.norm(found), dtype=np.float64)


def _matrix(turn: Floats) -> Floats:
    w, x, y, z = turn / np.linalg.norm(turn)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _triple(vector: Floats) -> tuple[float, float, float]:
    x, y, z = (float(part) for part in vector)
    return x, y, z
