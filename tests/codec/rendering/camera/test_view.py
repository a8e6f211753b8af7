"""The part of a volume that is in view, and the size of a pixel there."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec import Scene, Volume
from fhash_codec.rendering.camera.camera import Grid, Rays
from fhash_codec.rendering.camera.view import part_in_view, pixel_vertices
from fhash_codec.rendering.picture.planning import plan_picture
from fhash_codec.rendering.scene.scene import Camera


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
