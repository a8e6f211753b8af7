"""The texts that a PNG of fhash holds: its scene, the name of the volume's file and its digest."""

from __future__ import annotations

import io
import zlib
from pathlib import Path
from typing import BinaryIO

from fhash_formats.errors import InputError, MissingInputError

__all__ = ["DIGEST_KEY", "SCENE_KEY", "SOURCE_KEY", "digest_in_png", "scene_text_in_png"]

SCENE_KEY = "fhash.scene"
"""Keyword of the iTXt chunk that holds the scene as JSON."""
SOURCE_KEY = "fhash.source"
"""Keyword of the chunk that holds the name of the volume's file."""
DIGEST_KEY = "fhash.digest"
"""Keyword of the chunk that holds the digest of the volume."""

SIGNATURE = b"\x89PNG\r\n\x1a\n"
"""First bytes of every PNG."""
MAX_TEXT = 2**20
"""Most bytes of a scene in a PNG, unpacked."""
MAX_KEYWORDS = 1024
"""Most bytes of keyword, flags and language that stand before the text of a chunk."""
MAX_CHUNKS = 100_000
"""Most chunks of a PNG before the scene; pillow writes one for each 64 KiB of pixels."""


def scene_text_in_png(path: str | Path) -> bytes:
    """Read the JSON text of the scene that a picture shows.

    Raises InputError for a file that is no PNG of `fhash render`, damaged ones included.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            return _scene_text(path, file)
    except FileNotFoundError as error:
        raise MissingInputError(f"{path}: no such picture") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error


def digest_in_png(path: str | Path) -> str:
    """Read the digest of the volume that a picture shows; empty if the picture has none.

    Raises InputError for a file that is no PNG.
    """
    from PIL import Image as Pictures

    try:
        with Pictures.open(path, formats=("PNG",)) as picture:
            return str(picture.info.get(DIGEST_KEY, ""))
    except (OSError, ValueError, SyntaxError) as error:
        raise InputError(f"{path}: not a PNG: {error}") from error


def _scene_text(path: Path, file: BinaryIO) -> bytes:
    """Find the scene's chunk and return its text.

    Pixels are skipped, and no more of the file is held than a scene can be long.
    """
    if file.read(len(SIGNATURE)) != SIGNATURE:
        raise InputError(f"{path}: not a PNG")
    for _ in range(MAX_CHUNKS):
        head = file.read(8)
        if len(head) < 8 or head[4:] == b"IEND":
            break
        length, kind = int.from_bytes(head[:4], "big"), head[4:]
        if kind != b"iTXt" or length > MAX_TEXT + MAX_KEYWORDS:
            file.seek(length + 4, io.SEEK_CUR)
            continue
        data, checksum = file.read(length), file.read(4)
        keyword, _, rest = data.partition(b"\0")
        if keyword != SCENE_KEY.encode():
            continue
        if len(data) != length or zlib.crc32(kind + data).to_bytes(4, "big") != checksum:
            raise InputError(f"{path}: its scene is damaged; render it again")
        # Before the text stand a flag and a method of compression, a language and a translated
        # keyword, the last two ended by a zero each.
        packed, text = rest[:1] == b"\1", rest[2:].split(b"\0", 2)[-1]
        return _unpacked(path, text) if packed else text
    raise InputError(f"{path}: holds no scene; only pictures of 'fhash render' do")


def _unpacked(path: Path, data: bytes) -> bytes:
    """Decompress a text of at most MAX_TEXT bytes."""
    reader = zlib.decompressobj()
    try:
        text = reader.decompress(data, MAX_TEXT)
    except zlib.error as error:
        raise InputError(f"{path}: its scene is damaged; render it again") from error
    if not reader.eof:
        raise InputError(f"{path}: its scene is cut short or longer than {MAX_TEXT >> 20} MiB")
    return text
