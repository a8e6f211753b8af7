"""Cases of rays aim at vertices, faces and corners; their volumes are small."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.scenes import Camera
from fhash_codec.selftest.cases import rays

CASES = {case.name: case for case in rays.CASES}
GRID = Grid(counts=rays.SHAPE[:0:-1], origin=np.zeros(3), spacing=np.ones(3))


@pytest.mark.parametrize("view", rays.AXES)
def test_the_camera_along_an_axis_aims_at_vertices(view: str) -> None:
    camera = Camera.from_dict(rays._grid_camera(view))
    eyes, directions = Rays.of(camera, GRID, (9, 9)).pixels()
    along = int(np.argmax(np.abs(directions[4, 4])))
    across = [axis for axis in range(3) if axis != along]
    np.testing.assert_allclose(eyes[..., across], np.rint(eyes[..., across]), atol=1e-12)
    np.testing.assert_allclose(directions[..., across], 0.0, atol=1e-12)


def test_stairs_have_surfaces_through_vertices_and_along_faces() -> None:
    values = np.stack(list(CASES["surfaces-on-vertices"].make().frames()))
    assert set(values.ravel().tolist()) == set(map(float, range(8)))
    assert (values[0, -1] == 6.0).all()


def test_thin_volumes_have_one_vertex_along_their_axis() -> None:
    for axis, name in enumerate(("thin-z", "thin-y", "thin-x"), 1):
        assert CASES[name].make().shape[axis] == 1
    assert CASES["thin-all"].make().shape[1:] == (1, 1, 1)


def test_volumes_are_small() -> None:
    assert max(np.prod(case.make().shape) for case in rays.CASES) <= np.prod(rays.SHAPE)
