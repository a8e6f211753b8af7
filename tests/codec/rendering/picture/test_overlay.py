"""What is drawn around the volume: edges behind and before it, scales, colour bar, time label."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fhash_codec.rendering.camera.box import edges, outer_edges
from fhash_codec.rendering.camera.camera import Grid, Rays
from fhash_codec.rendering.colour.colours import named_map
from fhash_codec.rendering.picture.image import Image
from fhash_codec.rendering.picture.overlay import overlay, time_text
from fhash_codec.rendering.picture.ticks import ticks
from fhash_codec.rendering.scene.scene import Camera, Effects, Scene
from fhash_formats.series import Coordinate

COORDS = {
    axis: Coordinate(name=axis, values=np.linspace(0, extent, 11), attributes={"units": "km"})
    for axis, extent in zip("xyz", (4, 3, 2), strict=True)
}
GRID = Grid.of(COORDS)
SIZES = [(256, 256), (300, 700), (1024, 512)]
NAMES = ("box", "axes", "colour_bar", "time_label")


def drawn(
    effects: Effects,
    size: tuple[int, int] = (256, 256),
    background: str = "#ffffff",
    fill: float = 0.0,
    **camera: Any,
) -> Image:
    rgba = np.zeros((size[1], size[0], 4), dtype=np.float32)
    rgba[..., 3] = fill
    image = Image(rgba=rgba, scene=Scene(background=background).to_dict())
    rays = Rays.of(Camera(**camera), GRID, size)
    return overlay(
        image,
        effects,
        rays,
        colours=named_map("plasma").rescaled(-3, 5),
        quantity="speed [m/s]",
        coords=COORDS,
        label="step 3   t = 1 s",
    )


def test_nothing_is_drawn_unless_asked_for() -> None:
    image = Image(rgba=np.zeros((4, 4, 4), dtype=np.float32))
    assert (
        overlay(
            image,
            Effects(),
            Rays.of(Camera(), GRID, (4, 4)),
            colours=named_map("grey"),
            quantity="",
            coords=COORDS,
        )
        is image
    )


@pytest.mark.parametrize("background", ["#ffffff", "#10121c", "transparent"])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", NAMES)
def test_each_part_is_seen_on_any_background(
    name: str, size: tuple[int, int], background: str
) -> None:
    image = drawn(Effects(**{name: True}), size, background)
    assert image.rgba.shape == (size[1], size[0], 4)
    assert np.all((image.rgba >= 0) & (image.rgba <= 1 + 1e-6))
    assert np.all(image.rgba[..., :3] <= image.rgba[..., 3:] + 1e-6)
    paper = np.array(
        [0, 0, 0] if background == "transparent" else list(bytes.fromhex(background[1:]))
    )
    marked = np.abs(image.to_uint8()[..., :3].astype(int) - paper).max(axis=-1) > 100
    if background == "transparent":
        marked = image.to_uint8()[..., 3] > 100
    assert marked.sum() > 100
    assert marked.mean() < 0.2


def test_edges_at_the_back_are_hidden_by_an_opaque_volume_and_those_at_the_front_are_not() -> None:
    clear, filled = (drawn(Effects(box=True), fill=fill).rgba for fill in (0.0, 1.0))
    rays = Rays.of(Camera(), GRID, (256, 256))
    back = [edge for edge in edges(rays) if edge.fronts == 0]
    front = [edge for edge in edges(rays) if edge.fronts == 2]
    outline = [edge for edge in edges(rays) if edge.fronts == 1]
    assert (len(back), len(front), len(outline)) == (3, 3, 6)

    def at(picture: np.ndarray, edge: Any) -> float:
        x, y = edge.ends.mean(axis=0)
        return float(picture[int(y) - 1 : int(y) + 2, int(x) - 1 : int(x) + 2, :3].max())

    for edge in back:
        assert at(filled, edge) == 0
        assert at(clear, edge) > 0
    for edge in front + outline:
        assert at(filled, edge) > 0


@pytest.mark.parametrize("projection", ["perspective", "parallel"])
@pytest.mark.parametrize("view", ["iso", "xy", "zx"])
def test_every_edge_has_its_side(view: str, projection: str) -> None:
    found = edges(Rays.of(Camera(view=view, projection=projection), GRID, (64, 64)))
    assert len(found) == 12
    assert {edge.axis for edge in outer_edges(Rays.of(Camera(), GRID, (64, 64)))} == {0, 1, 2}
    assert all(0 <= edge.fronts <= 2 for edge in found)
    assert min(edge.fronts for edge in found) == 0


def test_from_inside_all_edges_are_behind_the_volume() -> None:
    rays = Rays.of(
        Camera(position=(2, 1, 1), focal_point=(4, 3, 1.1), view_up=(0, 0, 1), view_angle=60),
        GRID,
        (64, 64),
    )
    found = edges(rays)
    assert 3 <= len(found) < 12
    assert all(edge.fronts == 0 for edge in found)
    assert all(np.all(np.isfinite(edge.ends)) for edge in found)
    assert outer_edges(rays) == []
    everything = Effects(box=True, axes=True, colour_bar=True, time_label=True)
    inside = drawn(
        everything, position=(2, 1, 1), focal_point=(4, 3, 1.1), view_up=(0, 0, 1), view_angle=60
    )
    assert np.all(np.isfinite(inside.rgba))


def test_the_colour_bar_shows_the_colours_from_bottom_to_top() -> None:
    pixels = drawn(Effects(colour_bar=True)).to_uint8().astype(int)
    low, high = (np.rint(np.array(named_map("plasma")(end)) * 255) for end in (0.0, 1.0))
    rows_low = np.flatnonzero((np.abs(pixels - low).max(axis=-1) < 6).any(axis=1))
    rows_high = np.flatnonzero((np.abs(pixels - high).max(axis=-1) < 6).any(axis=1))
    assert len(rows_low)
    assert len(rows_high)
    assert rows_low.mean() > 180
    assert rows_high.mean() < 80


@pytest.mark.parametrize(
    ("low", "high", "texts"),
    [
        (0.0, 10.0, ["0", "2", "4", "6", "8", "10"]),
        (-1.0, 1.0, ["-1.0", "-0.5", "0.0", "0.5", "1.0"]),
        (101325.001, 101325.0045, ["101325.001", "101325.002", "101325.003", "101325.004"]),
        (0.0, 1e9, ["0", "2.0e+08", "4.0e+08", "6.0e+08", "8.0e+08", "1.0e+09"]),
        (1e-9, 4e-9, ["1e-09", "2e-09", "3e-09", "4e-09"]),
        (3.0, 3.0, ["3"]),
        (0.0, 1.2, ["0.00", "0.25", "0.50", "0.75", "1.00"]),
    ],
)
def test_ticks_are_round_and_told_apart(low: float, high: float, texts: list[str]) -> None:
    assert [text for _, text in ticks(low, high, 5)] == texts


@pytest.mark.parametrize("scale", [1e-300, 1e-12, 1.0, 3e7, 1e300])
@pytest.mark.parametrize("count", [1, 2, 5, 12])
def test_ticks_lie_within_the_ends_at_any_scale(scale: float, count: int) -> None:
    for low, high in ((0.13, 0.97), (-5.0, 3.0), (99.99, 100.01)):
        found = ticks(low * scale, high * scale, count)
        values, texts = [value for value, _ in found], [text for _, text in found]
        assert 1 <= len(found) <= 2.6 * count + 2
        assert len(set(texts)) == len(texts)
        assert all(
            low * scale - 1e-9 * abs(scale) <= value <= high * scale + 1e-9 * scale
            for value in values
        )
        np.testing.assert_allclose(
            [float(text) for text in texts], values, rtol=1e-6, atol=1e-9 * scale
        )


def test_the_text_of_a_time() -> None:
    assert time_text(3, 0.25, "s") == "step 3   t = 0.25 s"
    assert time_text(3.5, 1e-9, "") == "step 3.5   t = 1e-09"
