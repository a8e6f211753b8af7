"""Settings between those of two scenes."""

from __future__ import annotations

from fhash_codec.rendering.animation.mixing import mixed
from fhash_codec.rendering.scene.scene import Camera, Isosurface, Scene


def test_mixing_keeps_order_and_kinds() -> None:
    one, other = (
        Isosurface(value=1.0, colour="white", opacity=1.0),
        Isosurface(value=3.0, colour="black", opacity=0.0),
    )
    between = mixed((one,), (other,), 0.25)
    assert between == (Isosurface(value=1.5, colour="#bfbfbf", opacity=0.75),)
    assert mixed("viridis", "plasma", 0.5) == "viridis"
    assert mixed(None, one, 0.9) is None
    assert mixed(one, other, 1.0) is other


def test_points_that_ascend_still_do_between() -> None:
    first, second = ((0.0, 0.0), (1.0, 0.2), (5.0, 0.3)), ((-4.0, 1.0), (4.0, 0.0), (4.5, 0.1))
    for weight in (0.1, 0.5, 0.9):
        values = [value for value, _ in mixed(first, second, weight)]
        assert values == sorted(values)


def test_time_and_camera_stay_those_of_the_first_scene() -> None:
    first = Scene(camera=Camera(azimuth=10.0), step=1.0, background="#000000")
    second = Scene(camera=Camera(azimuth=50.0), step=2.0, background="#ffffff")
    between = mixed(first, second, 0.5)
    assert (between.camera, between.step) == (first.camera, 1.0)
    assert between.background == "#808080"


def test_tuples_of_other_lengths_are_not_mixed() -> None:
    assert mixed((1.0, 2.0), (3.0,), 0.5) == (1.0, 2.0)
