"""The mask of a tile apart from its stream, and put back behind it."""

from __future__ import annotations

from fhash_formats.errors import DamagedFileError
from fhash_formats.transform.tile.sections import (
    EMPTY,
    EXACT,
    MASKED,
    NUMBER,
    PREDICTED_MASKED,
    parse_stream,
    section,
)

__all__ = ["join_mask", "split_mask"]


def split_mask(stream: bytes) -> tuple[bytes, bytes]:
    """A stream without its section of the mask, and that section; `join_mask` is the inverse.

    The section is empty where the stream has none, or says that all vertices are occupied.
    """
    mask = parse_stream(stream).mask
    if mask is None:
        return stream, b""
    return stream[: -len(section(bytes(mask)))], bytes(mask)


def join_mask(stream: bytes | memoryview, mask: bytes | memoryview) -> bytes:
    """The stream of a tile whose mask lies apart. Raises DamagedFileError for a mask too many."""
    flags = stream[0] if len(stream) else 0
    empty = flags & EMPTY and not flags & EXACT
    if flags & NUMBER in (MASKED, PREDICTED_MASKED) and not empty:
        return bytes(stream) + section(bytes(mask))
    if len(mask):
        raise DamagedFileError("there is a mask for a coded tile that has none")
    return bytes(stream)
