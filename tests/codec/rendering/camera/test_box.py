"""The edges of the box in the picture."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.rendering.camera.box import edges, outer_edges
from fhash_codec.rendering.camera.camera import Grid, Rays
from fhash_codec.rendering.scene.scene import Camera
from fhash_formats.series import Coordinate

COORDS = {
    axis: Coordinate(name=axis, values=np.linspace(0, extent, 11), attributes={"units": "km"})
    for axis, extent in zip("xyz", (4, 3, 2), strict=True)
}


GRID = Grid.of(COORDS)


@pytest.mark.parametrize("projection", ["perspective", "parallel"])
@pytest.mark.parametrize("view", ["iso", "xy", "zx"])
def test_every_edge_has_its_side(view: str, projection: str) -> None:
    seen = edges(Rays.of(Camera(view=view, projection=projection), GRID, (64, 64)))
    assert len(seen) == 12
    assert {edge.axis for edge in outer_edges(Rays.of(Camera(), GRID, (64, 64)))} == {0, 1, 2}
    assert all(0 <= edge.fronts <= 2 for edge in seen)
    assert min(edge.fronts for edge in seen) == 0


def test_edges_behind_a_perspective_camera_are_cut_off() -> None:
    rays = Rays.of(
        Camera(position=(2, 1, 1), focal_point=(4, 3, 1.1), view_up=(0, 0, 1), view_angle=60),
        GRID,
        (64, 64),
    )
    seen = edges(rays)
    assert 3 <= len(seen) < 12
    assert all(edge.fronts == 0 for edge in seen)
    assert any(not edge.uncut for edge in seen)
    assert all(np.all(np.isfinite(edge.ends)) for edge in seen)
    assert outer_edges(rays) == []
