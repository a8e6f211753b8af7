"""The path of a camera through poses."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from fhash_codec import Volume
from fhash_codec.rendering.camera.camera import Grid, Rays
from fhash_codec.rendering.camera.poses import CameraPath
from fhash_codec.rendering.scene.scene import (
    Camera,
)


def eye(camera: Camera, grid: Grid) -> np.ndarray:
    rays = Rays.of(camera, grid, (40, 30))
    return rays.eye * grid.spacing + grid.origin


def test_two_poses_are_joined_at_one_speed(volume: Volume) -> None:
    grid = Grid.of(volume.coords)
    cameras = (Camera(view="xz"), Camera(view="yz"))
    path = CameraPath(at=np.array([0.0, 1.0]), cameras=cameras, grid=grid, size=(40, 30))
    middle = grid.corners.mean(axis=1)
    directions = [eye(path.camera(share), grid) - middle for share in np.linspace(0, 1, 7)]
    lengths = np.linalg.norm(directions, axis=1)
    np.testing.assert_allclose(lengths, lengths[0], rtol=1e-9)
    turns = [
        np.degrees(np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b)))
        for a, b in itertools.pairwise(directions)
    ]
    np.testing.assert_allclose(turns, 15.0, rtol=1e-6)
    assert path.camera(0.0) is cameras[0]
    assert path.camera(2.0) is cameras[1]


def test_a_way_through_poses_is_smooth(volume: Volume) -> None:
    grid = Grid.of(volume.coords)
    cameras = (
        Camera(view="xz"),
        Camera(position=(30.0, 2.0, 4.0)),
        Camera(view="xy", zoom=2.0),
        Camera(view="zx", elevation=20.0),
    )
    path = CameraPath(at=np.array([0.0, 0.2, 0.7, 1.0]), cameras=cameras, grid=grid, size=(40, 30))
    for share, camera in zip(path.at, cameras, strict=True):
        for near in (max(share - 1e-7, 0), min(share + 1e-7, 1)):
            np.testing.assert_allclose(eye(path.camera(near), grid), eye(camera, grid), atol=1e-3)
    # Speeds on both sides of a pose are the same.
    for share in path.at[1:-1]:
        before, here, after = (
            eye(path.camera(share + shift), grid) for shift in (-1e-5, 0.0, 1e-5)
        )
        np.testing.assert_allclose(
            here - before, after - here, atol=2e-7 * np.linalg.norm(here), rtol=1e-2
        )
    zooms = [path.camera(share).zoom for share in np.linspace(0, 1, 50)]
    assert min(zooms) >= 1 - 1e-12
    assert max(zooms) <= 2 + 1e-12


def test_cameras_with_the_same_above_them_stay_upright(volume: Volume) -> None:
    grid = Grid.of(volume.coords)
    cameras = (
        Camera(view="iso"),
        Camera(position=(30.0, 2.0, 4.0)),
        Camera(view="yz", azimuth=160.0, elevation=-40.0),
    )
    path = CameraPath(at=np.array([0.0, 0.5, 1.0]), cameras=cameras, grid=grid, size=(40, 30))
    for share in np.linspace(0, 1, 21):
        rays = Rays.of(path.camera(share), grid, (40, 30))
        assert (rays.right * grid.spacing)[2] == pytest.approx(0.0, abs=1e-9)
        assert (rays.up * grid.spacing)[2] > 0
    above = CameraPath(
        at=np.array([0.0, 1.0]),
        cameras=(Camera(view="iso"), Camera(view="xz", elevation=90.0)),
        grid=grid,
        size=(40, 30),
    )
    for share in (0.5, 0.999):
        assert np.isfinite(eye(above.camera(share), grid)).all()


def test_angles_are_followed_as_given(volume: Volume) -> None:
    grid = Grid.of(volume.coords)
    cameras = (Camera(azimuth=0.0), Camera(azimuth=720.0, elevation=40.0))
    path = CameraPath(at=np.array([0.0, 1.0]), cameras=cameras, grid=grid, size=(40, 30))
    assert path.camera(0.25) == Camera(azimuth=180.0, elevation=10.0)
