"""The scene in a PNG: read from any PNG of fhash, and from no other file."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import pytest
from PIL import Image as Pictures
from PIL.PngImagePlugin import PngInfo

from fhash_codec.rendering.scene.png_text import MAX_TEXT, SCENE_KEY
from fhash_codec.rendering.scene.scene import Scene, scene_in_png
from fhash_formats.errors import InputError


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
