"""Clips, the part in view, and the edges of the box."""

from __future__ import annotations

import itertools
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from fhash_codec import EncodeConfig, Scene, Volume, encode
from fhash_codec import open as open_volume
from fhash_codec.rendering import grid as module
from fhash_codec.rendering import render
from fhash_codec.rendering.cameras import VIEWS, CameraPath, Rays, pchip, usual_size, view_of
from fhash_codec.rendering.grid import Axis, Grid, downward, drawn_counts
from fhash_codec.rendering.plan import plan_picture
from fhash_codec.rendering.scenes import Camera, Clip
from fhash_codec.rendering.view import (
    Body,
    edges,
    outer_edges,
    pixel_vertices,
    region_in_view,
    region_of_body,
)
from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.series import Coordinate

GRID = Grid(
    counts=(11, 21, 31),
    origin=np.array([5.0, 4.0, -3.0]),
    spacing=np.array([0.1, -0.2, 1.0]),
    scale=(1.0, 1.0, 2.0),
)
"""x 5 to 6, y 4 down to 0, z -1.5 to 13.5, which is stretched to twice that."""


def body_of(grid: Grid = GRID, **settings: Any) -> Body:
    return Body.of(Clip.from_dict(settings), grid)


def test_ends_are_those_of_the_series_and_snap_to_vertices() -> None:
    body = body_of(x=[5.3, None], y=[1.0, 3.0], z=[0.25, 99])
    np.testing.assert_array_equal(body.bounds, [[3, 10], [5, 15], [3.5, 30]])
    np.testing.assert_array_equal(body.extent, body.bounds)
    assert not len(body.planes)


def test_planes_are_those_of_the_series() -> None:
    by_point = body_of(planes=[{"point": [5.5, 2.0, 6.0], "normal": [1, 0.5, 0.1]}])
    by_offset = body_of(planes=[{"normal": [2, 1, 0.2], "offset": 11 + 2 + 1.2}])
    np.testing.assert_allclose(by_point.planes, by_offset.planes)
    places = np.random.default_rng(1).uniform(0, GRID.counts, (500, 3))
    x, y, z = (places * GRID.spacing + GRID.origin).T / np.array([[1], [1], [2]])
    inside = (x - 5.5) + 0.5 * (y - 2) + 0.1 * (z - 6) >= 0
    within = np.all(places <= np.array(GRID.counts) - 1, axis=1)
    np.testing.assert_array_equal(by_point.holds(places), inside & within)


def test_an_axis_of_one_vertex_is_kept_whole() -> None:
    grid = Grid(counts=(5, 5, 1), origin=np.array([0.0, 0, 7]), spacing=np.ones(3))
    assert body_of(grid, z=[6.9, 7.1]).bounds[2].tolist() == [-0.5, 0.5]
    with pytest.raises(InputError, match=r"z 7\.1 to 8 leaves nothing"):
        body_of(grid, z=[7.1, 8])


@pytest.mark.parametrize(
    ("settings", "part"),
    [
        ({"x": [6.5, 7]}, r"x 6\.5 to 7 leaves nothing of the volume, which has x 5 to 6"),
        ({"y": [None, -1]}, "y the end to -1 leaves nothing"),
        ({"planes": [{"normal": [1, 0, 0], "offset": 6.1}]}, "planes leave nothing"),
    ],
)
def test_what_leaves_nothing_is_refused(settings: dict[str, Any], part: str) -> None:
    with pytest.raises(InputError, match=part):
        body_of(**settings)


def test_a_clip_that_only_touches_leaves_an_empty_picture() -> None:
    assert body_of(x=[6, 7]).bounds[0].tolist() == [10, 10]


@pytest.mark.parametrize("projection", ["perspective", "parallel"])
def test_a_box_has_its_twelve_edges_and_a_plane_cuts_more(projection: str) -> None:
    rays = Rays.of(Camera(azimuth=20.0, projection=projection), GRID, (60, 50))
    whole = Body(bounds=GRID.bounds, planes=np.empty((0, 4)))

    def ends(found: list[Any]) -> list[Any]:
        return sorted(
            (sorted(map(tuple, np.round(edge.ends, 6).tolist())), edge.fronts) for edge in found
        )

    assert ends(edges(rays, whole)) == ends(edges(rays))
    # A corner is cut off: three edges more, those of the new face.
    low = GRID.bounds[:, 0]
    plane = np.array([[*np.full(3, 3**-0.5), 3**-0.5 * (low.sum() + 4)]])
    assert len(edges(rays, Body(bounds=GRID.bounds, planes=plane))) == 15


def test_the_region_is_that_of_whole_tiles_around_the_clip(volume: Volume) -> None:
    grid = Grid.of(volume.coords)
    rays = Rays.of(Camera(), grid, (40, 40))
    tile = volume.chunks[1:]
    for low, high in ((0, 3), (5, 9), (17.5, 19)):
        body = body_of(grid, z=[low, high])
        region = region_in_view(rays, volume, body)
        assert region == region_of_body(volume, body, None)
        assert region.z[0] == low // tile[0] * tile[0]
        assert region.z[1] == min(-(-(int(np.ceil(high)) + 1) // tile[0]) * tile[0], 20)
        assert (region.y, region.x) == ((0, 24), (0, 28))
    assert region_of_body(volume, None, None) == ((0, 20), (0, 24), (0, 28))
    wider = region_of_body(volume, body_of(grid, z=[5, 7]), None, margin=20)
    assert wider.z == (0, 20)


def test_only_what_is_in_the_picture_is_decoded(volume: Volume) -> None:
    volume.chunks = (1, 4, 4, 4)
    domain = tuple((0, length) for length in volume.shape[1:])
    assert plan_picture(volume, Scene()).region == domain
    rays = Rays.of(
        Camera(view="xy", projection="parallel", zoom=12), Grid.of(volume.coords), (64, 64)
    )
    region = region_in_view(rays, volume)
    origins, _ = rays.pixels()
    for axis, (low, high) in zip((1, 0), region[1:], strict=True):
        assert low <= origins[..., axis].min()
        assert origins[..., axis].max() <= high - 1 or high == volume.shape[3 - axis]
    assert region[0] == domain[0]
    assert region[1] != domain[1]
    assert region[2] != domain[2]


@pytest.mark.parametrize("zoom", [1.0, 3.0, 40.0])
@pytest.mark.parametrize("projection", ["parallel", "perspective"])
def test_no_ray_meets_the_volume_outside_the_part_in_view(
    volume: Volume, projection: str, zoom: float
) -> None:
    volume.chunks = (1, 4, 4, 4)
    rays = Rays.of(
        Camera(projection=projection, zoom=zoom, azimuth=20), Grid.of(volume.coords), (24, 24)
    )
    region = region_in_view(rays, volume)
    origin, direction = rays.pixels()
    along = np.linspace(0, 3 * float(np.linalg.norm(rays.eye)), 4000)[:, None, None, None]
    places = origin + along * direction / np.linalg.norm(
        direction * rays.grid.spacing, axis=-1, keepdims=True
    )
    inside = np.all(
        (places >= rays.grid.bounds[:, 0]) & (places <= rays.grid.bounds[:, 1]), axis=-1
    )
    assert inside.any()
    for axis, (low, high) in zip((2, 1, 0), region, strict=True):
        assert low <= places[inside][:, axis].min()
        assert places[inside][:, axis].max() <= high - 1


def test_a_pixel_is_nothing_from_inside(volume: Volume) -> None:
    grid = Grid.of(volume.coords)
    assert (
        pixel_vertices(Rays.of(Camera(position=(5, 5, 5), focal_point=(9, 9, 9)), grid, (8, 8)))
        == 0
    )
    parallel = Rays.of(Camera(projection="parallel", parallel_scale=10), grid, (40, 40))
    assert pixel_vertices(parallel) == pytest.approx(0.5)


COORDS = {
    axis: Coordinate(name=axis, values=np.linspace(0, extent, 11), attributes={"units": "km"})
    for axis, extent in zip("xyz", (4, 3, 2), strict=True)
}


GRID_BOX = Grid.of(COORDS)


def test_edges_behind_a_perspective_camera_are_cut_off() -> None:
    rays = Rays.of(
        Camera(position=(2, 1, 1), focal_point=(4, 3, 1.1), view_up=(0, 0, 1), view_angle=60),
        GRID_BOX,
        (64, 64),
    )
    seen = edges(rays)
    assert 3 <= len(seen) < 12
    assert all(edge.fronts == 0 for edge in seen)
    assert any(not edge.uncut for edge in seen)
    assert all(np.all(np.isfinite(edge.ends)) for edge in seen)
    assert outer_edges(rays) == []


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


def test_an_axis_in_other_units_is_no_thinner_than_a_quarter() -> None:
    units = {"x": "degrees_east", "y": "degrees_north", "z": "hPa"}
    coords = {
        axis: Coordinate(name=axis, values=np.arange(float(count)), attributes={"units": unit})
        for (axis, unit), count in zip(units.items(), (41, 21, 3), strict=True)
    }
    np.testing.assert_allclose(Grid.of(coords).spacing, [1, 1, -5])


@pytest.mark.parametrize(
    ("axes", "view", "size"),
    [
        ({}, "iso", (1024, 1024)),
        ({"z": [0]}, "xy", (1024, 1024)),
        ({"z": [0], "y": range(3)}, "xy", (1024, 204)),
        ({"z": [0], "y": range(6)}, "xy", (1024, 512)),
        ({"x": [0], "y": range(6)}, "yz", (512, 1024)),
        ({"z": [0], "y": [0]}, "xy", (1024, 1024)),
        ({"z": [0, 0.6]}, "xy", (1024, 1024)),
        ({"y": [0, 0.3, 0.6]}, "xz", (1024, 1024)),
        ({"y": [0, 0.3, 0.7]}, "iso", (1024, 1024)),
    ],
)
def test_a_plane_or_a_thin_volume_is_seen_from_above(
    axes: dict[str, Any], view: str, size: tuple[int, int]
) -> None:
    where = grid(**axes)
    assert view_of("auto", where) == view
    assert usual_size(Camera(), where) == size
    assert usual_size(Camera(view="iso"), where) == (1024, 1024)
    if view != "iso":
        origins, directions = Rays.of(Camera(projection="parallel"), where, (8, 8)).pixels()
        assert np.count_nonzero(directions[0, 0]) == 1
        across = directions[0, 0] == 0
        edge = np.abs(origins * where.spacing).max(axis=(0, 1))[across]
        # the volume, 10 long, fills the picture; a thin one has room to be turned
        assert edge.max() < (13 if where.flat else 16)


def test_a_curvilinear_grid_has_its_north_up_and_its_east_right(tmp_path: Path) -> None:
    north = np.linspace(-60, 60, 8)[:, None] + np.linspace(0, 3, 12)
    east = np.linspace(355, 375, 12) % 360 + np.linspace(0, 1, 8)[:, None]
    north[:, 3] = np.nan
    values = np.random.default_rng(0).normal(size=(8, 12)).astype("f4")
    pictures = []
    for turn in (np.s_[:, :], np.s_[::-1, :], np.s_[:, ::-1]):
        array = xr.DataArray(
            values[turn],
            dims=("j", "i"),
            coords={
                "lat": (("j", "i"), north[turn], {"units": "degrees_north"}),
                "lon": (("j", "i"), east[turn], {"units": "degrees_east"}),
            },
            name="t",
        )
        encode(array, tmp_path / "a.fhz", EncodeConfig(max_error=0.0), force=True)
        with open_volume(tmp_path / "a.fhz") as volume:
            pictures.append(render(volume, Scene(size=(48, 32))).rgba)
    for other in pictures[1:]:
        np.testing.assert_allclose(other, pictures[0], atol=2e-3)
    assert np.ptp(pictures[0]) > 0.5


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


def test_the_cubic_never_overshoots() -> None:
    at, values = np.array([0.0, 0.1, 0.5, 0.6, 1.0]), np.array([[0.0], [1.0], [1.0], [5.0], [4.0]])
    curve = np.array([pchip(at, values, share)[0] for share in np.linspace(0, 1, 501)])
    assert curve.min() >= -1e-12
    assert curve.max() <= 5 + 1e-12
    inside = curve[(np.linspace(0, 1, 501) >= 0.1) & (np.linspace(0, 1, 501) <= 0.5)]
    np.testing.assert_allclose(inside, 1.0)
    for share, value in zip(at, values[:, 0], strict=True):
        assert pchip(at, values, share)[0] == pytest.approx(value)


def eye(camera: Camera, grid: Grid) -> np.ndarray:
    rays = Rays.of(camera, grid, (40, 30))
    return rays.eye * grid.spacing + grid.origin


def path_of(cameras: tuple[Camera, ...], grid: Grid, *at: float) -> CameraPath:
    """The path through poses, at the two ends unless it is said where."""
    return CameraPath(at=np.array(at or (0.0, 1.0)), cameras=cameras, grid=grid, size=(40, 30))


def test_two_poses_are_joined_at_one_speed(volume: Volume) -> None:
    grid = Grid.of(volume.coords)
    cameras = (Camera(view="xz"), Camera(view="yz"))
    path = path_of(cameras, grid)
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


def test_cameras_with_the_same_above_them_stay_upright(volume: Volume) -> None:
    grid = Grid.of(volume.coords)
    cameras = (
        Camera(view="iso"),
        Camera(position=(30.0, 2.0, 4.0)),
        Camera(view="yz", azimuth=160.0, elevation=-40.0),
    )
    path = path_of(cameras, grid, 0.0, 0.5, 1.0)
    for share in np.linspace(0, 1, 21):
        rays = Rays.of(path.camera(share), grid, (40, 30))
        assert (rays.right * grid.spacing)[2] == pytest.approx(0.0, abs=1e-9)
        assert (rays.up * grid.spacing)[2] > 0
    above = path_of((Camera(view="iso"), Camera(view="xz", elevation=90.0)), grid)
    for share in (0.5, 0.999):
        assert np.isfinite(eye(above.camera(share), grid)).all()


def test_angles_are_followed_as_given(volume: Volume) -> None:
    grid = Grid.of(volume.coords)
    cameras = (Camera(azimuth=0.0), Camera(azimuth=720.0, elevation=40.0))
    path = path_of(cameras, grid)
    assert path.camera(0.25) == Camera(azimuth=180.0, elevation=10.0)


def test_a_way_through_poses_is_smooth(volume: Volume) -> None:
    grid = Grid.of(volume.coords)
    cameras = (
        Camera(view="xz"),
        Camera(position=(30.0, 2.0, 4.0)),
        Camera(view="xy", zoom=2.0),
        Camera(view="zx", elevation=20.0),
    )
    path = path_of(cameras, grid, 0.0, 0.2, 0.7, 1.0)
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


def coordinate(values: Any, **attributes: Any) -> Coordinate:
    return Coordinate(name="a", values=np.asarray(values, dtype=np.float64), attributes=attributes)


@pytest.mark.parametrize(("off", "even"), [(0.0099, True), (0.0101, False)])
def test_coordinates_are_even_up_to_a_thousandth_of_their_extent(off: float, even: bool) -> None:
    values = np.arange(11.0)
    values[5] += off
    axis = Axis.of(coordinate(values))
    assert axis.even is even
    assert axis.problem == ""


@pytest.mark.parametrize("values", [[0, 1, 4, 9], [9, 4, 1, 0], [5, 10, 5000]])
def test_uneven_vertices_are_found_where_they_lie(values: list[float]) -> None:
    axis = Axis.of(coordinate(values))
    (count,) = drawn_counts([axis])
    places = axis.places(count)
    assert places[[0, -1]].tolist() == [0, len(values) - 1]
    assert np.all(np.diff(places) > 0)
    evenly = np.linspace(values[0], values[-1], count)
    np.testing.assert_allclose(np.interp(places, range(len(values)), values), evenly, rtol=1e-12)


def test_longitudes_go_on_beyond_the_whole_turn() -> None:
    axis = Axis.of(coordinate([350, 355, 0, 5], units="degrees_east"))
    assert axis.even
    np.testing.assert_allclose(axis.values, [350, 355, 360, 365])


@pytest.mark.parametrize("values", [[0, 2, 1], [0, 0, 1, 5], [np.nan, 1], [1, 1], [0, 1e101]])
def test_what_is_no_line_is_told(values: list[float]) -> None:
    axis = Axis.of(coordinate(values))
    assert axis.even
    assert axis.values.tolist() == list(range(len(values)))
    assert "vertices are drawn one unit apart" in axis.problem


def test_an_uneven_axis_is_drawn_with_its_smallest_distance_within_limits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    even = Axis.of(coordinate(range(10)))
    fine = Axis.of(coordinate([0, 1, 5, 10]))
    assert drawn_counts([fine, even]) == [11, 10]
    # Nearly even: twice as fine all the same, so that nothing is smeared.
    assert drawn_counts([Axis.of(coordinate([0, 1, 2.05, 3]))]) == [7]
    assert drawn_counts([Axis.of(coordinate([0, 1e-9, 1, 2]))]) == [3 * module.MOST_FINER + 1]
    many = np.arange(400.0) ** 2
    assert drawn_counts([Axis.of(coordinate(many))]) == [399 * 2 + 1]
    monkeypatch.setattr(module, "MAX_DRAWN", 60)
    assert drawn_counts([fine, even])[0] <= 6
    monkeypatch.setattr(module, "MAX_DRAWN", 10)
    assert drawn_counts([fine, even]) == [4, 10]


@pytest.mark.parametrize(
    ("attributes", "down"),
    [
        ({}, False),
        ({"units": "m"}, False),
        ({"positive": "down"}, True),
        ({"positive": "Down "}, True),
        ({"positive": "up", "standard_name": "depth"}, False),
        ({"standard_name": "depth"}, True),
        ({"standard_name": "height"}, False),
        ({"units": "hPa"}, True),
        ({"units": "Pa", "positive": "up"}, False),
    ],
)
def test_what_ascends_downwards(attributes: dict[str, str], down: bool) -> None:
    assert downward(coordinate([0, 1], **attributes)) is down


def test_an_uneven_axis_keeps_its_ends_and_needs_no_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        uneven = grid(x=np.arange(11) ** 2, y=-(np.arange(11.0) ** 1.5))
    assert uneven.counts == (101, 33, 11)
    assert uneven.series_counts == (11, 11, 11)
    np.testing.assert_allclose(uneven.corners, [[0, 100], [0, -(10**1.5)], [0, 10]])
    assert uneven.warp is not None
    np.testing.assert_allclose(uneven.warp.to_series(0, [0, 1, 4, 81]), [0, 1, 2, 9])
    assert uneven.warp.places[2] is None
    assert uneven.coarseness[0] == pytest.approx(19)
    assert uneven.coarseness[2] == 1
    # Opacities are of vertices of the series: the finer ones change nothing.
    assert uneven.series_spacing == pytest.approx((10 * 10**0.5 * 1) ** (1 / 3))
    assert grid().warp is None
    assert grid().series_spacing == grid().vertex_spacing
