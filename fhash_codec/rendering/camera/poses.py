"""The path of a camera through several poses.

The path is smooth in place, distance and direction; between two poses the speed is constant.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.camera.camera import VIEWS, Grid, Rays, view_of
from fhash_codec.rendering.camera.curves import pchip
from fhash_codec.rendering.camera.quaternions import from_matrix, spline, to_matrix
from fhash_codec.rendering.scene.scene import Camera

__all__ = ["CameraPath"]

Floats = npt.NDArray[np.float64]

PLACED = ("position", "focal_point", "view_up", "view")
"""Settings of a camera that say where it stands before its angles turn it."""
STEEP = 0.9998
"""Sine of the elevation above which a camera is too near the zenith to go around it, 1 degree."""


class _Pose(NamedTuple):
    """Physical focal point (3,), distance from it, and rotation (4,) as a quaternion."""

    focal: Floats
    distance: float
    rotation: Floats


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

    at: Floats
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
        place = self._angles(share) if self._is_turning() else self._place(share)
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

    def _place(self, share: float) -> dict[str, Any]:
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
            "position": _triple(focal + away * distance),
            "focal_point": _triple(focal),
            "view_up": _triple(up),
        }

    def _upright(self, rotations: Floats, share: float) -> tuple[Floats, Floats] | None:
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


def _triple(vector: Floats) -> tuple[float, float, float]:
    x, y, z = (float(number) for number in vector)
    return x, y, z
