"""Texts, ticks, scales and strips around the volume."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.colours import named_map
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.layout import (
    TITLE_GAP,
    Layout,
    end_texts,
    lay_out,
    length,
    line_height,
    quantity_of,
    scales,
    ticks,
    wrapped,
)
from fhash_codec.rendering.scenes import Camera, Effects, LegendEntry, Scene
from fhash_formats.series import Coordinate

LONG = "sea_water_potential_temperature [degree_Celsius]"


@pytest.mark.parametrize("limit", [12.0, 40.0, 90.0, 150.0, 1000.0])
def test_lines_are_no_longer_than_their_limit_and_hold_every_letter(limit: float) -> None:
    lines = wrapped(LONG, 10, limit)
    assert all(length(line, 10) <= limit for line in lines)
    assert "".join(lines).replace(" ", "") == LONG.replace(" ", "")
    assert (len(lines) == 1) is (limit == 1000)


@pytest.mark.parametrize("scale", [1e-300, 1e-12, 1.0, 3e7, 1e300])
@pytest.mark.parametrize("count", [1, 2, 5, 12])
def test_ticks_lie_within_the_ends_at_any_scale(scale: float, count: int) -> None:
    for low, high in ((0.13, 0.97), (-5.0, 3.0), (99.99, 100.01)):
        marks = ticks(low * scale, high * scale, count)
        values, texts = [value for value, _ in marks], [text for _, text in marks]
        assert 1 <= len(marks) <= 2.6 * count + 2
        assert len(set(texts)) == len(texts)
        assert all(
            low * scale - 1e-9 * abs(scale) <= value <= high * scale + 1e-9 * scale
            for value in values
        )
        np.testing.assert_allclose(
            [float(text) for text in texts], values, rtol=1e-6, atol=1e-9 * scale
        )


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


def test_in_a_tiny_picture_the_volume_keeps_its_place() -> None:
    layout, rays = laid_out("plain", (24, 20))
    assert rays.size == layout.view[2:]
    assert rays.size[0] >= 0.3 * 24 - 1


def test_names_of_quantities() -> None:
    assert quantity_of("speed", "m s-1") == "speed [m s-1]"
    assert quantity_of("share", "1") == quantity_of("share", "") == "share"
