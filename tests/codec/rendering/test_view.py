"""Clips, the part in view, and the edges of the box."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fhash_codec import Scene, Volume
from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.plan import plan_picture
from fhash_codec.rendering.scenes import Camera, Clip
from fhash_codec.rendering.view import (
    Body,
    edges,
    outer_edges,
    part_in_view,
    part_of_body,
    pixel_vertices,
)
from fhash_formats.errors import InputError
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
        region = part_in_view(rays, volume, body)
        assert region == part_of_body(volume, body, None)
        assert region.z[0] == low // tile[0] * tile[0]
        assert region.z[1] == min(-(-(int(np.ceil(high)) + 1) // tile[0]) * tile[0], 20)
        assert (region.y, region.x) == ((0, 24), (0, 28))
    assert part_of_body(volume, None, None) == ((0, 20), (0, 24), (0, 28))
    wider = part_of_body(volume, body_of(grid, z=[5, 7]), None, margin=20)
    assert wider.z == (0, 20)


def test_only_what_is_in_the_picture_is_decoded(volume: Volume) -> None:
    volume.chunks = (1, 4, 4, 4)
    domain = tuple((0, length) for length in volume.shape[1:])
    assert plan_picture(volume, Scene()).region == domain
    rays = Rays.of(
        Camera(view="xy", projection="parallel", zoom=12), Grid.of(volume.coords), (64, 64)
    )
    region = part_in_view(rays, volume)
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
    region = part_in_view(rays, volume)
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
