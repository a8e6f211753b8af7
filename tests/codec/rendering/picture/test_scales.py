"""Scales of axes: texts of the ends, and parts of edges in view."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.rendering.camera.camera import Rays
from fhash_codec.rendering.camera.grid import Grid
from fhash_codec.rendering.picture.scales import end_texts, overflow, scales
from fhash_codec.rendering.scene.scene import Camera
from fhash_formats.series import Coordinate

COORDS = {
    axis: Coordinate(name=axis, values=np.linspace(0, extent, 11), attributes={"units": "km"})
    for axis, extent in zip("xyz", (4, 3, 2), strict=True)
}


@pytest.mark.parametrize(
    ("first", "last", "texts"),
    [
        (0, 4, ("0", "4")),
        (88, -88, ("88", "-88")),
        (5, 5000, ("5", "5000")),
        (1234567.125, 1234890.5, ("1234567.1", "1234890.5")),
        (0.001, 0.0025, ("0.001", "0.0025")),
        (0.1 + 0.2, 1, ("0.3", "1")),
        (3, 3, ("3", "3")),
        (-0.00001, 1, ("0", "1")),
        (1e12, 1.0001e12, ("1e+12", "1.0001e+12")),
        (0, 3e-9, ("0", "3e-09")),
    ],
)
def test_ends_are_told_apart_in_few_letters(
    first: float, last: float, texts: tuple[str, str]
) -> None:
    assert end_texts(first, last) == texts


def test_every_axis_has_a_name_and_two_ends() -> None:
    rays = Rays.of(Camera(), Grid.of(COORDS), (400, 400))
    labels, wanted = scales(rays, (50, 50, 450, 450), (0, 0, 500, 500), COORDS, 12, breaking=0)
    assert wanted == 9
    assert sorted(label.lines[0] for label in labels) == sorted(
        ["x [km]", "y [km]", "z [km]", "0", "0", "0", "4", "3", "2"]
    )
    assert overflow(labels, (0, 0, 500, 500)) == (0, 0, 0, 0)
    assert np.count_nonzero(overflow(labels, (100, 100, 400, 400))) == 3
    broken, _ = scales(rays, (50, 50, 450, 450), (0, 0, 500, 500), COORDS, 12, breaking=1)
    assert ("x", "[km]") in [label.lines for label in broken]


def test_ends_that_are_out_of_view_have_no_number() -> None:
    grid, view = Grid.of(COORDS), (0.0, 0.0, 400.0, 400.0)
    near = Rays.of(Camera(view="xz", zoom=3), grid, (400, 400))
    labels, _ = scales(near, view, view, COORDS, 12, breaking=0)
    assert not labels
    beside = Rays.of(
        Camera(view="xz", zoom=3, focal_point=(0.0, 1.5, 0.0), position=(0.0, -15.0, 0.0)),
        grid,
        (400, 400),
    )
    texts = [label.lines[0] for label in scales(beside, view, view, COORDS, 12, breaking=0)[0]]
    assert sorted(texts) == ["0", "0", "x [km]", "z [km]"]
