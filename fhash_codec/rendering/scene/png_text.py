"""The scene and the digest that a PNG of fhash holds as text."""

from __future__ import annotations

import io
import json
import zlib
from pathlib import Path
from typing import BinaryIO

from fhash_codec.rendering.scene.scene import Scene
from fhash_formats.errors import InputError, MissingInputError

SCENE_KEY, SOURCE_KEY, DIGEST_KEY = "fhash.scene", "fhash.source", "fhash.digest"


MAX_TEXT = 2**20
"""Bytes of a scene in a PNG, unpacked."""


MAX_CHUNKS = 100_000
"""Chunks of a PNG that are looked at before the scene; pillow writes one for each 64 KiB of pixels."""


def scene_in_png(path: str | Path) -> Scene:
    """The scene that a picture shows; raises InputError for a file that is no PNG of `fhash render`, damaged ones included."""
    path = Path(path)
    try:
        with path.open("rb") as file:
            text = _scene_text(path, file)
    except FileNotFoundError as error:
        raise MissingInputError(f"{path}: no such picture") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    try:
        return Scene.from_dict(json.loads(text))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: its scene is damaged: {' '.join(str(error).split())}") from error


def digest_in_png(path: str | Path) -> str:
    """The digest of the volume that a picture is of; empty where it has none. Raises InputError for a file that is no PNG."""
    from PIL import Image as Pictures

    try:
        with Pictures.open(path, formats=("PNG",)) as picture:
            return str(picture.info.get(DIGEST_KEY, ""))
    except (OSError, ValueError, SyntaxError) as error:
        raise InputError(f"{path}: not a PNG: {error}") from error


def _scene_text(path: Path, file: BinaryIO) -> bytes:
    """The text of the scene's chunk. Pixels are skipped, and no more of the file is held than a scene can be long."""
    if file.read(8) != b"\x89PNG\r\n\x1a\n":
        raise InputError(f"{path}: not a PNG")
    for _ in range(MAX_CHUNKS):
        head = file.read(8)
        if len(head) < 8 or head[4:] == b"IEND":
            break
        length, kind = int.from_bytes(head[:4], "big"), head[4:]
        if kind != b"iTXt" or length > MAX_TEXT + 1024:
            file.seek(length + 4, io.SEEK_CUR)
            continue
        data, check = file.read(length), file.read(4)
        keyword, _, rest = data.partition(b"\0")
        if keyword != SCENE_KEY.encode():
            continue
        if len(data) != length or zlib.crc32(kind + data).to_bytes(4, "big") != check:
            raise InputError(f"{path}: its scene is damaged; render it again")
        # A flag and a method of compression, a language and a translated keyword, each ended by a zero, come before the text.
        packed, text = rest[:1] == b"\1", rest[2:].split(b"\0", 2)[-1]
        return _unpacked(path, text) if packed else text
    raise InputError(f"{path}: holds no scene; only pictures of 'fhash render' do")


def _unpacked(path: Path, data: bytes) -> bytes:
    reader = zlib.decompressobj()
    try:
        text = reader.decompress(data, MAX_TEXT)
    except zlib.error as error:
        raise InputError(f"{path}: its scene is damaged; render it again") from error
    if not reader.eof:
        raise InputError(f"{path}: its scene is cut short or longer than {MAX_TEXT >> 20} MiB")
    return text
