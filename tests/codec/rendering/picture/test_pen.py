"""The pen: inks that suit a background, and texts that stay in the picture."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.rendering.colour.colours import named_map
from fhash_codec.rendering.picture.pen import DARK, LIGHT, Pen


@pytest.mark.parametrize(
    ("background", "dark"),
    [("white", True), ("transparent", True), ("#102030", False), ("yellow", True), ("blue", False)],
)
def test_the_ink_is_told_apart_from_the_background(background: str, dark: bool) -> None:
    pen = Pen(64, 64, background)
    np.testing.assert_array_equal(pen.ink, DARK if dark else LIGHT)
    np.testing.assert_array_equal(pen.halo, LIGHT if dark else DARK)


@pytest.mark.parametrize("place", [(-500.0, 20.0), (20.0, -500.0), (900.0, 900.0), (48.0, 48.0)])
def test_a_text_is_moved_into_the_picture(place: tuple[float, float]) -> None:
    pen = Pen(96, 96, "white")
    pen.text(place, "x = 3", "mm")
    (_, halo), (_, letters) = pen.written()
    middle = Pen(96, 96, "white")
    middle.text((48.0, 48.0), "x = 3", "mm")
    _, (_, expected) = middle.written()
    assert letters.sum() == pytest.approx(expected.sum(), rel=0.1)
    assert not halo[[0, -1]].any()
    assert not halo[:, [0, -1]].any()


def test_no_edges_are_no_lines() -> None:
    assert not Pen(8, 6, "white").lines([]).any()
    assert Pen(8, 6, "white").lines([]).shape == (6, 8)


def test_a_colour_bar_stays_in_small_pictures_too() -> None:
    for width, height in ((8, 8), (40, 300), (300, 40)):
        colours, opacity = Pen(width, height, "white").colour_bar(named_map("viridis"), "u [m/s]")
        assert colours.shape == (height, width, 3)
        assert opacity.shape == (height, width)
        assert opacity.max() == 1
