"""Scenes, and their text in PNGs."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path
from typing import Any

import pytest
from PIL import Image as Pictures
from PIL.PngImagePlugin import PngInfo

from fhash_codec.rendering.image import Image
from fhash_codec.rendering.scenes import MAX_TEXT, SCENE_KEY, Scene, scene_in_png
from fhash_formats.errors import InputError, MissingInputError

VALUES: dict[str, Any] = {
    "camera": {"view": "xz", "position": [1.5, 2.0, 3.25]},
    "size": [30, 20],
    "background": "transparent",
    "effects": {"shading": {"ambient": 0.5}, "buffers": ["depth"]},
    "step": 3.5,
}


def test_a_scene_comes_back_from_its_json() -> None:
    scene = Scene.from_dict(VALUES)
    assert scene.to_dict() == VALUES
    assert Scene.from_dict(json.loads(json.dumps(scene.to_dict()))) == scene
    assert Scene().to_dict() == {}


def test_a_scene_is_read_from_toml_json_and_pictures(tmp_path: Path) -> None:
    import numpy as np

    scene = Scene.from_dict(VALUES)
    (tmp_path / "a.json").write_text(json.dumps(VALUES))
    (tmp_path / "a.toml").write_text(
        'size = [30, 20]\nbackground = "transparent"\nstep = 3.5\n'
        '[camera]\nview = "xz"\nposition = [1.5, 2, 3.25]\n'
        '[effects]\nbuffers = ["depth"]\nshading = {ambient = 0.5}\n'
    )
    Image(rgba=np.zeros((2, 3, 4), dtype=np.float32), scene=VALUES).save(tmp_path / "a.png")
    for name in ("a.json", "a.toml", "a.png"):
        assert Scene.load(tmp_path / name) == scene


@pytest.mark.parametrize("name", ["a.json", "a.toml", "a.png"])
def test_a_scene_that_is_not_there(tmp_path: Path, name: str) -> None:
    with pytest.raises(MissingInputError, match="no such"):
        Scene.load(tmp_path / name)
    (tmp_path / name).write_text("[")
    with pytest.raises(InputError, match="not a") as caught:
        Scene.load(tmp_path / name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"step": 1, "time": 2}, "step and time exclude each other"),
        ({"step": 1, "evolution": {"steps": [0]}}, "steps of its own"),
        ({"time": 1, "evolution": {"steps": [0]}}, "steps of its own"),
        ({"camra": {}}, "did you mean 'camera'"),
        ({"effects": {"shadow": True}}, "did you mean 'shadows'"),
        ({"evolution": {}}, "steps is missing"),
        ({"effects": {"clip": True}}, "clip cuts nothing"),
        ({"effects": {"clip": {"z": [2, 1]}}}, "z is 2 to 1; the first end must be below"),
        ({"effects": {"clip": {"planes": [{"normal": [0, 0, 1]}]}}}, "either a point or an offset"),
        ({"effects": {"clip": {"planes": [{"offset": 1}]}}}, "normal is missing"),
        (
            {"effects": {"clip": {"planes": [{"normal": [0, 0, 0], "offset": 1}]}}},
            "the normal has no length",
        ),
        (
            {"effects": {"clip": {"planes": 7 * [{"normal": [0, 0, 1], "offset": 1}]}}},
            "clip has 7 planes; allowed: 6",
        ),
        (
            {"effects": {"attenuated_maximum_intensity": {"attenuation": 0}}},
            "attenuation is 0; allowed: 1e-06 to 1000",
        ),
        ({"size": [0, 9]}, "size is 0; allowed: 1 to 16384"),
    ],
)
def test_scenes_that_contradict_themselves_are_refused(
    values: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        Scene.from_dict(values)


def test_a_clip_and_projections_are_read_and_written() -> None:
    planes = [{"normal": [0, 0, 1], "offset": 2.0}, {"point": [1, 2, 3], "normal": [1, 1, 0]}] * 3
    values = {
        "transfer_function": {"gradient_opacity": [[0, 0.0], [0.5, 1]]},
        "effects": {"clip": {"x": [None, 3.5], "z": [0, None], "planes": planes}},
    }
    scene = Scene.from_dict(values)
    assert Scene.from_dict(scene.to_dict()) == scene
    assert json.loads(json.dumps(scene.to_dict())) == json.loads(json.dumps(values))
    assert Scene.from_dict({"effects": {"clip": False}}) == Scene()
    toml = {"x": [False, 3.5], "z": [0, False], "planes": planes}  # TOML has no null
    assert Scene.from_dict({**values, "effects": {"clip": toml}}) == scene
    both = Scene.from_dict(
        {"effects": {"average_intensity": True, "attenuated_maximum_intensity": True}}
    )
    assert both.effects.projections == ("average", "attenuated")
    assert scene.effects.projections == ()


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
