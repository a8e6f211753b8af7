"""The pen: inks that suit a background, texts, lines, bars and legends in their places."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.rendering.camera.box import Edge
from fhash_codec.rendering.colour.colours import named_map
from fhash_codec.rendering.picture.layout import Bar, strips
from fhash_codec.rendering.picture.lettering import Label
from fhash_codec.rendering.picture.pen import DARK, LIGHT, Pen
from fhash_codec.rendering.scene.scene import Effects, LegendEntry


@pytest.mark.parametrize(
    ("background", "dark"),
    [("white", True), ("transparent", True), ("#102030", False), ("yellow", True), ("blue", False)],
)
def test_the_ink_is_told_apart_from_the_background(background: str, dark: bool) -> None:
    pen = Pen(64, 64, background)
    np.testing.assert_array_equal(pen.ink, DARK if dark else LIGHT)
    np.testing.assert_array_equal(pen.halo, LIGHT if dark else DARK)


def test_a_label_is_written_where_it_says() -> None:
    for upright in (False, True):
        label = Label(
            lines=("temperature", "[degree]"), centre=(60.0, 48.0), size=12, upright=upright
        )
        pen = Pen(128, 96, "white")
        pen.write(label)
        (_, halo), (_, letters) = pen.written()
        rows, columns = np.nonzero(halo)
        left, top, right, bottom = label.box
        assert left - 1 <= columns.min() < columns.max() <= right + 1
        assert top - 1 <= rows.min() < rows.max() <= bottom + 1
        assert bool(np.ptp(rows) > np.ptp(columns)) is upright
        assert 0 < letters.sum() < halo.sum()


def test_a_text_begins_at_its_place() -> None:
    pen = Pen(96, 96, "white")
    pen.text((20.0, 48.0), "x = 3", 12)
    rows, columns = np.nonzero(pen.written()[1][1])
    assert 20 <= columns.min() <= 24
    assert rows.mean() == pytest.approx(48, abs=2)


def test_lines_stay_in_their_view() -> None:
    pen = Pen(40, 30, "white")
    assert not pen.lines([], (0, 0, 40, 30)).any()
    edge = Edge(axis=0, ends=np.array([[-50.0, 5.0], [90.0, 5.0]]), fronts=1, uncut=True)
    drawn = pen.lines([edge], (10, 8, 20, 15))
    assert drawn.shape == (30, 40)
    rows, columns = np.nonzero(drawn)
    assert (columns.min(), columns.max()) == (10, 29)
    assert set(rows) <= {12, 13, 14}


@pytest.mark.parametrize("text", ["step 3   t = 1 s", "step 3   t = 1234567 seconds since 2001"])
def test_a_time_label_stays_in_its_strip(text: str) -> None:
    pen = Pen(130, 130, "white")
    pen.time_label((0.0, 0.0, 130.0, 20.0), text)
    rows, columns = np.nonzero(pen.written()[0][1])
    assert columns.max() < 129
    assert rows.max() <= 20


@pytest.mark.parametrize("side", [1, 2, 3, 9])
def test_a_colour_bar_is_cut_at_the_edges_of_a_tiny_picture(side: int) -> None:
    bar = Bar(box=(1, 2, 10, 18), marks=(), title=(), size=8)
    part = Pen(side, side, "white").colour_bar(bar, named_map("viridis"))
    whole = Pen(20, 20, "white").colour_bar(bar, named_map("viridis"))
    for layer, of_whole in zip(part, whole, strict=True):
        np.testing.assert_array_equal(layer, of_whole[:side, :side])


def test_a_colour_bar_and_a_legend_are_drawn_in_their_colours() -> None:
    colours = named_map("viridis").rescaled(0, 2)
    entry = LegendEntry(text="fast", colour="#ff0000")
    layout = strips((160, 120), Effects(colour_bar=True, legend=(entry,)), colours, "u [m/s]")
    assert layout.bar is not None
    assert layout.legend is not None
    pen = Pen(160, 120, "white")
    drawn, opacity = pen.colour_bar(layout.bar, colours)
    left, top, right, bottom = layout.bar.box
    middle = (left + right) // 2
    np.testing.assert_allclose(drawn[top, middle], colours(2.0), atol=0.05)
    np.testing.assert_allclose(drawn[bottom - 1, middle], colours(0.0), atol=0.05)
    assert opacity[:, : left - 2].max() == 0
    squares, opacity = pen.legend(layout.legend)
    at, row, _ = layout.legend.entries[0]
    np.testing.assert_allclose(squares[int(row) + 3, int(at) + 3], [1, 0, 0])
