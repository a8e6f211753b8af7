"""Layouts: nothing covers the volume, nothing is cut, at any size from 256 pixels."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from fhash_codec.rendering.camera.camera import Rays
from fhash_codec.rendering.camera.grid import Grid
from fhash_codec.rendering.colour.colours import named_map
from fhash_codec.rendering.picture.layout import TITLE_GAP, Layout, lay_out, quantity_of
from fhash_codec.rendering.picture.lettering import SMALLEST, Label, length, line_height
from fhash_codec.rendering.scene.scene import Camera, Effects, LegendEntry, Scene
from fhash_formats.series import Coordinate

SIZES = [(256, 256), (512, 512), (1024, 1024), (480, 270), (270, 480), (256, 700)]
Box = tuple[float, float, float, float]
LOW = 9.87e14
HIGH = 9.88e14


def coords(kind: str) -> dict[str, Coordinate]:
    def at(name: str, first: float, last: float, count: int, units: str) -> Coordinate:
        values = np.linspace(first, last, count)
        return Coordinate(name=name, values=values, attributes={"units": units})

    return {
        "plain": {axis: at(axis, -1, 1, 9, "m") for axis in "xyz"},
        "flat": {
            "x": at("longitude", 0, 358, 90, "degrees_east"),
            "y": at("latitude", 89, -89, 45, "degrees_north"),
            "z": at("level", 0, 0, 1, "1"),
        },
        "long": {
            "x": at("projection_x_coordinate", 1234567.125, 1234890.5, 20, "kilometres"),
            "y": at("projection_y_coordinate", -1234567.1, -1234890.5, 20, "kilometres"),
            "z": at("geopotential_height_above_ellipsoid", 1e5, 1.003e5, 20, "kilometres"),
        },
    }[kind]


EVERYTHING = Effects(
    box=True,
    axes=True,
    colour_bar=True,
    time_label=True,
    legend=(
        LegendEntry(text="sea_water_temperature 12.5 to 13.75 degree_Celsius", colour="red"),
        LegendEntry(text="sea_water_temperature = 20 degree_Celsius", colour="blue"),
    ),
)


def laid_out(
    kind: str,
    size: tuple[int, int],
    effects: Effects = EVERYTHING,
    quantity: str = "atmosphere_mass_content_of_cloud_condensed_water [kg m-2 s-1]",
    **camera: Any,
) -> tuple[Layout, Rays]:
    axes = coords(kind)
    scene = Scene(size=size, effects=effects, camera=Camera(**camera))
    colours = named_map("viridis").rescaled(LOW, HIGH)
    return lay_out(scene, Grid.of(axes), axes, colours, quantity)


def covered(layout: Layout, rays: Rays) -> np.ndarray:
    """The pixels (H, W) of the picture whose rays meet the drawn box."""
    origins, directions = rays.pixels()
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (rays.grid.bounds.T[:, None, None] - origins) / directions
    enter = np.nanmax(np.minimum(ends[0], ends[1]), axis=-1)
    leave = np.nanmin(np.maximum(ends[0], ends[1]), axis=-1)
    whole = np.zeros(layout.size[::-1], dtype=bool)
    left, top, width, height = layout.view
    whole[top : top + height, left : left + width] = enter < leave
    return whole


def texts(layout: Layout) -> list[tuple[str, Box]]:
    """Every text with the box that it takes, as the pen writes it."""
    found = [(" ".join(label.lines), label.box) for label in layout.labels]
    bar = layout.bar
    if bar is not None:
        left, top, right, bottom = bar.box
        pitch = line_height(bar.size)
        for value, text in bar.marks:
            row = bottom - (value - LOW) / (HIGH - LOW) * (bottom - top)
            at = right + bar.size // 4 + 2
            box = at, row - pitch / 2, at + length(text, bar.size) + 2, row + pitch / 2
            found.append((text, box))
        for number, line in enumerate(reversed(bar.title)):
            row = top - (number + TITLE_GAP) * pitch
            box = left - 2, row - pitch / 2, left + length(line, bar.size), row + pitch / 2
            found.append((line, box))
    if layout.legend is not None:
        side = layout.legend.size
        for at, top, entry in layout.legend.entries:
            wide = 1.4 * side + length(entry.text, side) + 2
            found.append((entry.text, (at, top - side / 4, at + wide, top + 1.25 * side)))
    return found


@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize(
    ("kind", "camera"),
    [
        ("plain", {}),
        ("plain", {"azimuth": 77.0, "elevation": -20.0}),
        ("plain", {"view": "xz", "projection": "parallel"}),
        ("plain", {"zoom": 2.5}),
        ("flat", {}),
        ("flat", {"view": "iso"}),
        ("long", {}),
    ],
    ids=str,
)
def test_nothing_covers_the_volume_or_is_cut(
    kind: str, camera: dict[str, Any], size: tuple[int, int]
) -> None:
    layout, rays = laid_out(kind, size, **camera)
    volume = covered(layout, rays)
    assert volume.sum() > 0.02 * volume.size
    left, top, width, height = layout.view
    assert width >= 0.15 * size[0]
    assert height >= 0.15 * size[1]
    boxes = texts(layout)
    for text, box in boxes:
        assert box[0] >= -0.5, text
        assert box[1] >= -0.5, text
        assert box[2] <= size[0] + 0.5, text
        assert box[3] <= size[1] + 0.5, text
        rows = slice(max(int(box[1]), 0), int(np.ceil(box[3])))
        columns = slice(max(int(box[0]), 0), int(np.ceil(box[2])))
        assert not volume[rows, columns].any(), text
    for (one, first), (other, second) in itertools.combinations(boxes, 2):
        apart = (
            first[2] <= second[0] + 1
            or second[2] <= first[0] + 1
            or first[3] <= second[1] + 1
            or second[3] <= first[1] + 1
        )
        assert apart, (one, other)
    assert layout.bar is not None
    assert layout.bar.box[0] >= left + width
    assert layout.time is not None
    assert layout.time[3] <= top


@pytest.mark.parametrize("kind", ["plain", "flat", "long"])
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_no_scale_is_lost(kind: str, size: tuple[int, int]) -> None:
    layout, _ = laid_out(kind, size, Effects(axes=True, colour_bar=True))
    # Three axes of the longest names and numbers need more than a view of 90 pixels.
    lost = 1 if (kind, size) == ("long", (256, 700)) else 0
    assert len(layout.labels) >= (6 if kind == "flat" else 9) - lost
    assert min(label.size for label in layout.labels) >= SMALLEST


def test_without_overlays_the_view_is_the_picture() -> None:
    for effects in (Effects(), Effects(box=True)):
        layout, rays = laid_out("plain", (300, 200), effects)
        assert layout.view == (0, 0, 300, 200)
        assert rays.size == (300, 200)
        assert (layout.labels, layout.bar, layout.time, layout.legend) == ((), None, None, None)


def test_each_strip_takes_its_side() -> None:
    entry = LegendEntry(text="a", colour="red")
    bar, _ = laid_out("plain", (300, 200), Effects(colour_bar=True))
    assert bar.view[:2] == (0, 0)
    assert bar.view[2] < 300
    assert bar.view[3] == 200
    label, _ = laid_out("plain", (300, 200), Effects(time_label=True))
    assert label.view[0::2] == (0, 300)
    assert label.view[1] + label.view[3] == 200
    legend, _ = laid_out("plain", (300, 200), Effects(legend=(entry,)))
    assert legend.view[:3] == (0, 0, 300)
    assert legend.view[3] < 200


def test_in_a_tiny_picture_the_volume_keeps_its_place() -> None:
    layout, rays = laid_out("plain", (24, 20))
    assert rays.size == layout.view[2:]
    assert rays.size[0] >= 0.3 * 24 - 1


def test_a_plane_seen_from_above_fills_its_view() -> None:
    layout, rays = laid_out("flat", (400, 400), Effects())
    rows, columns = np.nonzero(covered(layout, rays))
    assert 385 <= np.ptp(columns) + 1 <= 400
    assert np.ptp(rows) + 1 == pytest.approx(392 * 182 / 362, abs=6)


def test_names_of_quantities() -> None:
    assert quantity_of("speed", "m s-1") == "speed [m s-1]"
    assert quantity_of("share", "1") == quantity_of("share", "") == "share"


def test_labels_are_records_of_texts() -> None:
    layout, _ = laid_out("plain", (256, 256), Effects(axes=True))
    assert all(isinstance(label, Label) and all(label.lines) for label in layout.labels)


def test_a_colour_bar_has_two_ticks_or_more() -> None:
    axes = coords("plain")
    scene = Scene(size=(256, 256), effects=Effects(colour_bar=True))
    for low, high in ((271.0, 289.0), (0.6, 1.9), (-1.0, 1.0)):
        colours = named_map("viridis").rescaled(low, high)
        layout, _ = lay_out(scene, Grid.of(axes), axes, colours, "q")
        assert layout.bar is not None
        assert len(layout.bar.marks) >= 2
