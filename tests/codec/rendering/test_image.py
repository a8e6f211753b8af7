"""Pictures: files, and what pillow draws around the volume."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as Pictures

from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.colours import named_map
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.image import Image, Pen, overlay, surrounded, time_text
from fhash_codec.rendering.layout import Layout, lay_out, strips
from fhash_codec.rendering.scenes import Camera, Effects, LegendEntry, Scene
from fhash_codec.rendering.view import edges
from fhash_formats.errors import InputError, OutputExistsError
from fhash_formats.series import Coordinate

SCENE = Scene(
    size=(3, 2), camera=Camera(view="xz", position=(1.5, 2.0, 3.25)), background="#204060", step=3.5
)


def image(**arguments: Any) -> Image:
    rgba = np.zeros((2, 3, 4), dtype=np.float32)
    rgba[0, 0] = 0.5, 0, 0, 0.5
    rgba[1, 2] = 0, 1, 0, 1
    return Image(**{"rgba": rgba, "scene": SCENE.to_dict(), "source": "/data/run.fhz", **arguments})


def test_pixels_over_a_background() -> None:
    pixels = image().to_uint8()
    assert (pixels.shape, pixels.dtype) == ((2, 3, 3), np.uint8)
    assert pixels[0, 1].tolist() == [0x20, 0x40, 0x60]
    assert pixels[0, 0].tolist() == [144, 32, 48]
    assert pixels[1, 2].tolist() == [0, 255, 0]
    assert image().to_uint8("white")[0, 0].tolist() == [255, 128, 128]


def test_a_notebook_shows_the_picture() -> None:
    with Pictures.open(io.BytesIO(image()._repr_png_())) as found:
        np.testing.assert_array_equal(np.asarray(found), image().to_uint8())
    assert repr(image()) == "<fhash Image 3x2 of run.fhz in 0 s>"


@pytest.mark.parametrize("suffix", [".jpg", ".JPEG"])
def test_a_jpeg_holds_the_pixels(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"view{suffix}"
    rgba = np.ones((40, 60, 4), dtype=np.float32)
    rgba[:, :30, 0] = 0
    wide = image(rgba=rgba)
    assert wide.save(path) == [path]
    with Pictures.open(path) as found:
        assert found.format == "JPEG"
        difference = np.asarray(found).astype(int) - wide.to_uint8()
    assert np.abs(difference).max() < 24
    with pytest.raises(OutputExistsError):
        wide.save(path)


def test_other_names_and_transparent_jpegs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"written as \.png, \.jpg or \.jpeg"):
        image().save(tmp_path / "view.gif")
    clear = image(scene=Scene(background="transparent").to_dict())
    with pytest.raises(InputError, match="JPEG cannot be transparent"):
        clear.save(tmp_path / "view.jpg")
    assert not list(tmp_path.iterdir())


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
    scene = Scene(background=background, size=size, effects=effects, camera=Camera(**camera))
    colours = named_map("plasma").rescaled(-3, 5)
    layout, rays = lay_out(scene, GRID, COORDS, colours, "speed [m/s]")
    left, top, width, height = layout.view
    rgba[top : top + height, left : left + width, 3] = fill
    image = Image(rgba=rgba, scene=scene.to_dict())
    return overlay(image, effects, rays, layout, colours=colours, label="step 3   t = 1 s")


def test_nothing_is_drawn_unless_asked_for() -> None:
    image = Image(rgba=np.zeros((4, 4, 4), dtype=np.float32))
    rays = Rays.of(Camera(), GRID, (4, 4))
    layout = Layout(size=(4, 4), view=(0, 0, 4, 4))
    assert overlay(image, Effects(), rays, layout, colours=named_map("grey")) is image
    assert surrounded(image, Effects(box=True), colours=named_map("grey"), quantity="") is image


@pytest.mark.parametrize("background", ["#ffffff", "#10121c", "transparent"])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", NAMES)
def test_every_effect_is_seen_on_any_background(
    name: str, size: tuple[int, int], background: str
) -> None:
    image = drawn(Effects(**{name: True}), size, background)
    assert image.rgba.shape == (size[1], size[0], 4)
    assert np.all((image.rgba >= 0) & (image.rgba <= 1 + 1e-6))
    assert np.all(image.rgba[..., :3] <= image.rgba[..., 3:] + 1e-6)
    paper = np.array(
        [0, 0, 0] if background == "transparent" else list(bytes.fromhex(background[1:]))
    )
    drawn_on = np.abs(image.to_uint8()[..., :3].astype(int) - paper).max(axis=-1) > 100
    if background == "transparent":
        drawn_on = image.to_uint8()[..., 3] > 100
    assert drawn_on.sum() > 100
    assert drawn_on.mean() < 0.2


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


def test_from_inside_the_volume_the_overlay_is_finite() -> None:
    everything = Effects(box=True, axes=True, colour_bar=True, time_label=True)
    inside = drawn(
        everything, position=(2, 1, 1), focal_point=(4, 3, 1.1), view_up=(0, 0, 1), view_angle=60
    )
    assert np.all(np.isfinite(inside.rgba))


def test_the_text_of_a_time() -> None:
    def times(values: list[float], units: str) -> Coordinate:
        return Coordinate(name="time", values=np.array(values), attributes={"units": units})

    assert time_text(3, 0.25, times([0, 0.25], "s")) == "step 3   t = 0.25 s"
    assert time_text(3.5, 1e-9, times([0, 2e-9], "")) == "step 3.5   t = 1e-09"
    late = times([347921.001, 347921.002], "s")
    assert time_text(0, 347921.001, late) == "step 0   t = 347921.001 s"
    dated = times([40.0, 40.25], "days since 2001-01-01")
    assert time_text(1, 40.25, dated) == "step 1   2001-02-10 06:00"
    assert time_text(0, 40.0, dated) == "step 0   2001-02-10"
