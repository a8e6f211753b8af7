"""Rays: the camera of VTK in index space, whatever the voxels."""

from __future__ import annotations

import itertools
import warnings
from typing import Any

import numpy as np
import pytest

from fhash_codec.rendering.camera.camera import VIEWS, Grid, Rays
from fhash_codec.rendering.scene.scene import Camera
from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.series import Coordinate


def grid(**axes: Any) -> Grid:
    values = {"x": range(11), "y": range(11), "z": range(11), **axes}
    return Grid.of(
        {
            axis: Coordinate(name=axis, values=np.array(list(at), dtype=np.float64))
            for axis, at in values.items()
        }
    )


CUBE = grid()
UNEVEN = grid(x=np.linspace(100, 103, 7), y=np.linspace(5, -5, 21), z=[0.0, 0.5])


def physical(rays: Rays, u: float, w: float) -> tuple[np.ndarray, np.ndarray]:
    origin, direction = rays.rays(u, w)
    return rays.grid.origin + origin * rays.grid.spacing, direction * rays.grid.spacing


def test_where_the_vertices_are() -> None:
    assert UNEVEN.counts == (7, 21, 2)
    np.testing.assert_allclose(UNEVEN.spacing, [0.5, -0.5, 0.5])
    np.testing.assert_allclose(UNEVEN.origin, [100, 5, 0])
    np.testing.assert_array_equal(UNEVEN.bounds, [[0, 6], [0, 20], [0, 1]])
    np.testing.assert_allclose(UNEVEN.corners, [[100, 103], [5, -5], [0, 0.5]])
    assert UNEVEN.vertex_spacing == pytest.approx(0.5)


def test_an_axis_of_one_vertex_is_as_thick_as_the_others_mean() -> None:
    flat = grid(z=[7.0], x=np.linspace(0, 30, 11))
    np.testing.assert_allclose(flat.spacing, [3, 1, 2])
    np.testing.assert_allclose(flat.bounds[2], [-0.5, 0.5])
    np.testing.assert_allclose(flat.corners[2], [6, 8])
    np.testing.assert_allclose(
        grid(x=[1.0], y=[2.0], z=[3.0]).corners, [[0.5, 1.5], [1.5, 2.5], [2.5, 3.5]]
    )


def test_an_axis_in_other_units_is_drawn_in_the_proportions_of_its_vertices() -> None:
    def in_units(
        z: str, x: str = "degrees", scale: tuple[float, float, float] | None = None
    ) -> Grid:
        units = {"x": x, "y": "degrees", "z": z}
        axes = {
            axis: np.arange(5.0) * step
            for axis, step in {"x": 0.25, "y": -0.75, "z": 100.0}.items()
        }
        return Grid.of(
            {
                axis: Coordinate(name=axis, values=axes[axis], attributes={"units": units[axis]})
                for axis in axes
            },
            scale,
        )

    stretched = in_units("m")
    np.testing.assert_allclose(stretched.spacing, [0.25, -0.75, 0.5])
    np.testing.assert_allclose(stretched.scale, [1, 1, 0.005])
    for same in (in_units("degrees"), in_units("")):
        np.testing.assert_array_equal(same.spacing, [0.25, -0.75, 100.0])
        assert same.scale == (1, 1, 1)
    # If all three units differ, that of x counts.
    np.testing.assert_allclose(in_units("m", x="s").spacing, [0.25, -0.25, 0.25])
    given = in_units("m", scale=(1, 2, 0.01))
    np.testing.assert_allclose(given.spacing, [0.25, -1.5, 1.0])
    assert given.scale == (1, 2, 0.01)


def test_a_stretched_grid_keeps_its_corners_apart_by_the_factors() -> None:
    axes = {axis: Coordinate(name=axis, values=np.linspace(3, 5, 6)) for axis in "xyz"}
    np.testing.assert_allclose(
        Grid.of(axes, (1, 2, 3)).corners, Grid.of(axes).corners * np.array([[1], [2], [3]])
    )
    flat = axes | {"z": Coordinate(name="z", values=np.array([4.0]))}
    np.testing.assert_allclose(Grid.of(flat, (1, 3, 7)).spacing, [0.4, 1.2, 0.8])


def test_coordinates_that_are_no_places_are_told() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        grid(x=np.arange(11) + 0.009 * (np.arange(11) == 5))
        assert grid(x=np.arange(11) ** 2).spacing[0] == 1
    with pytest.warns(FhashWarning, match="'x' of x neither ascend nor descend throughout"):
        assert grid(x=[0, 2, 1]).spacing[0] == 1
    for wrong in (
        [1.0, 1.0],
        [np.nan, 1.0],
        [0.0, np.inf],
        [np.inf, np.inf],
        [-1e308, 1e308],
        [0.0, 1e101],
        [1e150, 1.1e150],
        [0.0, 1e-101],
    ):
        with pytest.warns(FhashWarning, match="'y' of y are no positions along a line"):
            assert grid(y=wrong).spacing[1] == 1


@pytest.mark.parametrize("projection", ["perspective", "parallel"])
@pytest.mark.parametrize("where", [CUBE, UNEVEN], ids=["cube", "uneven"])
@pytest.mark.parametrize("view", VIEWS)
def test_views_by_name(view: str, where: Grid, projection: str) -> None:
    rays = Rays.of(Camera(view=view, projection=projection), where, (300, 200))
    away, upward = (np.array(part, dtype=np.float64) for part in VIEWS[view])
    middle = where.corners.mean(axis=1)
    eye, forward = physical(rays, 0, 0)
    np.testing.assert_allclose(forward, -away / np.linalg.norm(away), atol=1e-12)
    np.testing.assert_allclose(np.cross(eye - middle, away), 0, atol=1e-9)
    # Upwards in space is upwards in the picture, and right is right of it.
    (right, _, up), _ = rays.project(
        (middle + np.stack([np.cross(upward, away), 0 * away, upward]) * 0.1 - where.origin)
        / where.spacing
    )
    assert right[0] > 150
    assert right[1] == pytest.approx(100)
    assert up[1] < 100
    assert up[0] == pytest.approx(150)


def test_named_views_are_those_of_pyvista() -> None:
    rays = Rays.of(Camera(view="xy"), CUBE, (100, 100))
    assert rays.forward.tolist() == [0, 0, -1]
    assert np.all(rays.right[1:] == 0)
    assert rays.right[0] > 0
    assert rays.up[1] > 0
    descending = Rays.of(Camera(view="xy"), grid(z=range(10, -1, -1)), (100, 100))
    assert descending.forward.tolist() == [0, 0, 1]
    assert descending.eye[2] < 0


@pytest.mark.parametrize("size", [(200, 100), (100, 200), (128, 128)])
@pytest.mark.parametrize("projection", ["perspective", "parallel"])
def test_the_sphere_about_the_volume_fills_the_picture(
    projection: str, size: tuple[int, int]
) -> None:
    for view, where in itertools.product(("iso", "yz"), (CUBE, UNEVEN)):
        rays = Rays.of(Camera(view=view, projection=projection), where, size)
        corners = np.array(list(itertools.product(*where.bounds)))
        pixels, depth = rays.project(corners)
        assert np.all(depth > 0)
        assert np.all((pixels >= 0) & (pixels <= size))
        middle = where.corners.mean(axis=1)
        radius = np.linalg.norm(where.corners[:, 1] - middle)
        narrow = 0 if size[0] <= size[1] else 1
        origin, direction = physical(rays, *((1, 0) if narrow == 0 else (0, 1)))
        distance = np.linalg.norm(np.cross(middle - origin, direction)) / np.linalg.norm(direction)
        assert distance == pytest.approx(radius)


@pytest.mark.parametrize(
    "camera",
    [Camera(), Camera(projection="parallel", azimuth=30, elevation=-20), Camera(view="zx", zoom=3)],
)
@pytest.mark.parametrize("where", [CUBE, UNEVEN], ids=["cube", "uneven"])
def test_a_point_on_a_pixels_ray_is_seen_in_that_pixel(camera: Camera, where: Grid) -> None:
    rays = Rays.of(camera, where, (7, 5))
    origins, directions = rays.pixels()
    assert origins.shape == directions.shape == (5, 7, 3)
    pixels, depth = rays.project(origins + 12.5 * directions)
    j, i = np.meshgrid(np.arange(5), np.arange(7), indexing="ij")
    np.testing.assert_allclose(pixels, np.stack([i + 0.5, j + 0.5], axis=-1), atol=1e-9)
    np.testing.assert_allclose(depth, 12.5)


@pytest.mark.parametrize("projection", ["perspective", "parallel"])
def test_far_from_the_origin_the_rays_are_the_same(projection: str) -> None:
    fine = 2.0**-20 * np.arange(11)
    near, far = (
        Rays.of(Camera(projection=projection), grid(x=fine + at, y=fine - at, z=fine + at), (9, 9))
        for at in (0.0, 1e9)
    )
    for name in ("eye", "right", "up", "forward"):
        np.testing.assert_allclose(getattr(far, name), getattr(near, name), rtol=1e-9)


def test_turning_and_rising_as_vtk_does() -> None:
    def eye(**camera: Any) -> np.ndarray:
        rays = Rays.of(Camera(**camera), CUBE, (100, 100))
        away = rays.eye - 5
        return away / np.linalg.norm(away)

    np.testing.assert_allclose(eye(view="xy", azimuth=90), [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(eye(view="xy", elevation=90), [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(eye(view="xz", azimuth=90), [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(eye(azimuth=180), np.array([-1, -1, 1]) / np.sqrt(3), atol=1e-12)
    np.testing.assert_allclose(
        eye(elevation=np.degrees(np.arctan(np.sqrt(2)))), [0, 0, 1], atol=1e-12
    )


def test_a_camera_by_position() -> None:
    camera = Camera(position=(5, -20, 5), view_up=(0, 0, 2), view_angle=90)
    rays = Rays.of(camera, CUBE, (100, 50))
    np.testing.assert_allclose(rays.eye, [5, -20, 5])
    np.testing.assert_allclose(rays.forward, [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(rays.up, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(rays.right, [2, 0, 0], atol=1e-12)
    nearer = Rays.of(
        Camera(position=(5, -20, 5), view_up=(0, 0, 2), view_angle=90, zoom=4), CUBE, (100, 50)
    )
    np.testing.assert_allclose(nearer.up, [0, 0, 0.25], atol=1e-12)
    flat = Rays.of(
        Camera(position=(5, -20, 5), projection="parallel", parallel_scale=3.0), CUBE, (100, 50)
    )
    np.testing.assert_allclose(flat.up, [0, 0, 3], atol=1e-12)


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        (
            {"position": (1, 2, 3), "focal_point": (1, 2, 3)},
            "position and focal_point are the same, 1, 2, 3",
        ),
        ({"position": (5, 5, 5)}, "position and focal_point are the same"),
        (
            {"position": (1, 2, 9), "focal_point": (1, 2, 3), "view_up": (0, 0, 1)},
            "view_up 0, 0, 1 is parallel",
        ),
        (
            {"position": (1, 2, 9), "focal_point": (1, 2, 3), "view_up": (0, 0, -1e-200)},
            "no length",
        ),
        ({"view_up": (0, 0, 0)}, "view_up has no length"),
        ({"view_up": (1, 1, 1)}, "view_up 1, 1, 1 is parallel"),
        (
            {"position": (1e308, 1e308, 1e308), "focal_point": (-1e308, 0, 0)},
            r"position is 1e\+308; allowed: -1e\+100 to 1e\+100",
        ),
    ],
)
def test_cameras_without_a_picture(camera: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        Rays.of(Camera(**camera), CUBE, (10, 10))
    assert "\n" not in str(caught.value)
