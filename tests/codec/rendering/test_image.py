"""Images: pixels over a background, and files with their scene."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as Pictures

from fhash_codec.rendering.image import Image
from fhash_codec.rendering.scenes import Camera, Scene
from fhash_formats.errors import InputError, OutputExistsError

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


@pytest.mark.parametrize("background", ["white", "transparent"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 3.0, -1.0])
def test_no_value_gives_a_pixel_that_is_none(background: str, value: float) -> None:
    rgba = np.full((1, 2, 4), 0.25, dtype=np.float32)
    rgba[0, 0] = value
    pixels = image(rgba=rgba).to_uint8(background)
    if not np.isfinite(value):
        assert pixels[0, 0].tolist() == ([255] * 3 if background == "white" else [0] * 4)
    assert pixels[0, 1].tolist() == ([255] * 3 if background == "white" else [255, 255, 255, 64])


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
