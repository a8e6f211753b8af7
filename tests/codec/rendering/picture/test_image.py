"""Pictures: pixels over a background, files, and the scene that comes back from a PNG."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as Pictures
from PIL.PngImagePlugin import PngInfo

from fhash_codec.rendering.picture.image import Image
from fhash_codec.rendering.scene.png_text import MAX_TEXT, SCENE_KEY
from fhash_codec.rendering.scene.scene import Camera, Scene, scene_in_png
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


def test_pixels_over_nothing_keep_their_colour() -> None:
    pixels = image().to_uint8("transparent")
    assert pixels[0, 0].tolist() == [255, 0, 0, 128]
    assert pixels[0, 1].tolist() == [0, 0, 0, 0]
    assert image(scene=Scene(background="transparent").to_dict()).to_uint8().shape == (2, 3, 4)


@pytest.mark.parametrize("background", ["white", "transparent"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 3.0, -1.0])
def test_no_value_gives_a_pixel_that_is_none(background: str, value: float) -> None:
    rgba = np.full((1, 2, 4), 0.25, dtype=np.float32)
    rgba[0, 0] = value
    pixels = image(rgba=rgba).to_uint8(background)
    if not np.isfinite(value):
        assert pixels[0, 0].tolist() == ([255] * 3 if background == "white" else [0] * 4)
    assert pixels[0, 1].tolist() == ([255] * 3 if background == "white" else [255, 255, 255, 64])


def test_saved_pictures_hold_their_scene(tmp_path: Path) -> None:
    path = tmp_path / "view.png"
    assert image().save(path) == [path]
    with Pictures.open(path) as found:
        np.testing.assert_array_equal(np.asarray(found), image().to_uint8())
        assert found.text["fhash.source"] == "run.fhz"
    assert scene_in_png(path) == Scene.load(path) == SCENE
    assert [each.name for each in tmp_path.iterdir()] == ["view.png"]


def test_buffers_lie_beside_the_picture(tmp_path: Path) -> None:
    depth = np.full((2, 3), np.inf, dtype=np.float32)
    normal = np.ones((2, 3, 3), dtype=np.float32)
    paths = image(depth=depth, normal=normal).save(tmp_path / "view.png")
    assert [path.name for path in paths] == ["view.depth.npy", "view.normal.npy", "view.png"]
    np.testing.assert_array_equal(np.load(paths[0]), depth)
    np.testing.assert_array_equal(np.load(paths[1]), normal)
    assert [path.name for path in image(normal=normal).outputs(Path("a.png"))] == [
        "a.normal.npy",
        "a.png",
    ]


@pytest.mark.parametrize("existing", ["view.png", "view.depth.npy"])
def test_an_older_picture_stays_unless_forced(tmp_path: Path, existing: str) -> None:
    (tmp_path / existing).write_text("old")
    new = image(depth=np.zeros((2, 3), dtype=np.float32))
    with pytest.raises(OutputExistsError, match=existing):
        new.save(tmp_path / "view.png")
    assert [path.name for path in tmp_path.iterdir()] == [existing]
    new.save(tmp_path / "view.png", force=True)
    assert scene_in_png(tmp_path / "view.png") == SCENE
    with pytest.raises(InputError, match=r"written as \.png"):
        new.save(tmp_path / "view.jpg")


def test_a_notebook_shows_the_picture() -> None:
    with Pictures.open(io.BytesIO(image()._repr_png_())) as found:
        np.testing.assert_array_equal(np.asarray(found), image().to_uint8())
    assert repr(image()) == "<fhash Image 3x2 of run.fhz in 0 s>"


def chunk(kind: bytes, data: bytes, wrong: int = 0) -> bytes:
    return (
        struct.pack(">I", len(data))
        + kind
        + data
        + struct.pack(">I", zlib.crc32(kind + data) ^ wrong)
    )


def png(*chunks: bytes) -> bytes:
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", b"\0" * 13) + b"".join(chunks) + chunk(b"IEND", b"")
    )


def text(content: bytes, packed: bytes = b"\0\0") -> bytes:
    return SCENE_KEY.encode() + b"\0" + packed + b"\0\0" + content


BOMB = zlib.compress(b" " * (MAX_TEXT + 1), 9)
HOSTILE = {
    "empty": (b"", "not a PNG"),
    "other": (b"GIF89a", "not a PNG"),
    "no scene": (png(), "holds no scene"),
    "other text": (png(chunk(b"iTXt", b"Title\0\0\0\0\0hello")), "holds no scene"),
    "no end": (b"\x89PNG\r\n\x1a\n", "holds no scene"),
    "long chunk": (b"\x89PNG\r\n\x1a\n\xff\xff\xff\xffiTXtfhash", "holds no scene"),
    "cut": (png(chunk(b"iTXt", text(b"{}")))[:60], "damaged"),
    "wrong sum": (png(chunk(b"iTXt", text(b"{}"), wrong=1)), "damaged"),
    "no json": (png(chunk(b"iTXt", text(b"{"))), "scene is damaged"),
    "no utf-8": (png(chunk(b"iTXt", text(b'"\xff"'))), "scene is damaged"),
    "deep": (png(chunk(b"iTXt", text(b"[" * 500_000))), "scene is damaged"),
    "a list": (png(chunk(b"iTXt", text(b"[]"))), "table of settings is needed"),
    "unknown key": (png(chunk(b"iTXt", text(b'{"camra": {}}'))), "did you mean 'camera'"),
    "bomb": (png(chunk(b"iTXt", text(BOMB, b"\1\0"))), "longer than 1 MiB"),
    "not packed": (png(chunk(b"iTXt", text(b"{}", b"\1\0"))), "damaged"),
    "too long": (png(chunk(b"iTXt", text(b" " * (MAX_TEXT + 2000)))), "holds no scene"),
    "short": (png(chunk(b"iTXt", SCENE_KEY.encode() + b"\0")), "scene is damaged"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_other_files_are_refused_in_one_line(tmp_path: Path, name: str) -> None:
    content, message = HOSTILE[name]
    path = tmp_path / "hostile.png"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        scene_in_png(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400 + len(str(path))


def test_a_packed_scene_and_a_file_that_is_not_there(tmp_path: Path) -> None:
    info = PngInfo()
    info.add_itxt(SCENE_KEY, '{"step": 2}', zip=True)
    Pictures.new("RGB", (2, 2)).save(tmp_path / "a.png", pnginfo=info)
    assert scene_in_png(tmp_path / "a.png") == Scene(step=2)
    with pytest.raises(FileNotFoundError, match="no such picture"):
        scene_in_png(tmp_path / "b.png")
    with pytest.raises(InputError, match="cannot be read"):
        scene_in_png(tmp_path)
