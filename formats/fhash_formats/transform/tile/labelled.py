"""Tiles of few distinct values, stored without loss as a palette and labels.

The palette holds the bits of each value; NaN of other bits are other values. Where the tile has a
mask, vertices that are not occupied have the last label, which has no value. The section is: the
CRC-32 of the labels (4 bytes), the length of the palette in bytes (4 bytes), the deflated palette
(little-endian values in ascending order of their bits), the coded labels (entropy/labels.py).

More than MAX_NARROW labels are *many*. Their stream has a flag of its own, and their palette holds
the difference of each value from the one before: first all first bytes, then all second ones.
"""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import DamagedFileError
from fhash_formats.transform.entropy.labels import (
    MAX_LABELS,
    MAX_NARROW,
    decode_labels,
    encode_labels,
)
from fhash_formats.transform.tile.sections import (
    LABELS,
    LABELS_MASKED,
    MANY,
    OWN,
    Shape,
    pack_settings,
    section,
)
from fhash_formats.transform.tile.settings import TileSettings

__all__ = ["build_labelled_stream", "has_regions", "surely_exceeds", "unpack_labelled"]

Values = npt.NDArray[Any]
Mask = npt.NDArray[np.bool_]

REGION_SHARE = 0.5
"""Share of vertices with an equal neighbour from which on many different values may be labels."""
_LOOK = 4096
"""Values that are looked at, at least, where there are as many."""
_HEAD = 8
"""Bytes before the palette."""


def has_regions(values: Values) -> bool:
    """Whether REGION_SHARE of the values equal the one before along one of the four axes."""
    equal = np.zeros(values.shape, bool)
    for axis in range(4):
        moved, marks = np.moveaxis(values, axis, 0), np.moveaxis(equal, axis, 0)
        marks[1:] |= moved[1:] == moved[:-1]
    return bool(equal.mean() >= REGION_SHARE)


def surely_exceeds(values: Values, most: int) -> bool:
    """Whether a look at some of the values finds more than `most` different ones.

    That is enough for most tiles that have no labels.
    """
    flat = values.reshape(-1)
    return bool(np.unique(flat[:: max(1, flat.size // _LOOK)]).size > most)


def build_labelled_stream(
    values: Values, settings: TileSettings | None, occupied: Mask | None, *, many: bool = False
) -> bytes | None:
    """The stream of a tile; None for one of too many different values.

    Args:
        values: the tile (t, z, y, x).
        settings: the tile's own settings; None for none.
        occupied: the mask; None for a stream without one. The other values are not stored.
        many: whether there may be MAX_LABELS labels, not only MAX_NARROW.
    """
    most = MAX_LABELS if many else MAX_NARROW
    bits = np.ascontiguousarray(values).view(f"u{values.dtype.itemsize}").reshape(-1)
    kept = bits if occupied is None else bits[occupied.reshape(-1)]
    if surely_exceeds(kept, most):
        return None
    palette = np.unique(kept)
    count = palette.size + (occupied is not None)
    if count > most:
        return None
    labels = np.searchsorted(palette, bits).astype(np.int64)
    if occupied is not None:
        labels[~occupied.reshape(-1)] = palette.size
    many = count > MAX_NARROW
    small = labels.astype("<u2" if many else "u1").reshape(values.shape)
    packed = zlib.compress(_palette_bytes(palette, many), 9)
    body = b"".join(
        [
            zlib.crc32(small.data).to_bytes(4, "little"),
            len(packed).to_bytes(4, "little"),
            packed,
            encode_labels(small, count),
        ]
    )
    flags = (LABELS if occupied is None else LABELS_MASKED) | (OWN if settings else 0)
    flags |= MANY if many else 0
    return bytes([flags]) + b"".join(map(section, [*pack_settings(settings), body]))


def unpack_labelled(
    body: memoryview, shape: Shape, dtype: np.dtype[Any], *, masked: bool, many: bool
) -> tuple[Values, Mask | None]:
    """The values in a section, and which are occupied; None without a mask.

    Values that are not occupied are arbitrary. Raises DamagedFileError.
    """
    palette = _unpack_palette(body, dtype, many)
    count = palette.size + masked
    low, high = (MAX_NARROW + 1, MAX_LABELS) if many else (1, MAX_NARROW)
    if not low <= count <= high:
        raise DamagedFileError(f"a coded tile has {count} labels; {low} to {high} are possible")
    start = _HEAD + int.from_bytes(body[4:8], "little")
    labels = decode_labels(body[start:], count, shape)
    stored = np.ascontiguousarray(labels, dtype="<u2" if many else "u1")
    if zlib.crc32(stored.data).to_bytes(4, "little") != body[:4]:
        raise DamagedFileError("the decoded labels of a tile differ from their digest")
    # The label of unoccupied vertices has no value: any stands there.
    values = np.append(palette, np.zeros(1, palette.dtype))[labels].view(dtype)
    return values, labels < palette.size if masked else None


def _palette_bytes(palette: Values, many: bool) -> bytes:
    """The bytes of a palette before they are deflated."""
    if not many:
        return palette.astype(palette.dtype.newbyteorder("<")).tobytes()
    steps = np.diff(palette, prepend=palette.dtype.type(0))
    planes = steps.astype(palette.dtype.newbyteorder("<")).view(np.uint8)
    return planes.reshape(palette.size, -1).T.tobytes()


def _unpack_palette(body: memoryview, dtype: np.dtype[Any], many: bool) -> Values:
    """The bits of the values of a palette. Raises DamagedFileError."""
    size, most = int.from_bytes(body[4:8], "little"), MAX_LABELS if many else MAX_NARROW
    if len(body) < _HEAD + size:
        raise DamagedFileError("a coded tile is cut short")
    try:
        inflate = zlib.decompressobj()
        plain = inflate.decompress(body[_HEAD : _HEAD + size], most * dtype.itemsize + 1)
    except zlib.error as error:
        raise DamagedFileError(f"a coded tile is damaged: {error}") from error
    if not inflate.eof or inflate.unused_data or len(plain) % dtype.itemsize:
        raise DamagedFileError("the palette of a coded tile is damaged")
    if many:
        planes = np.frombuffer(plain, np.uint8).reshape(dtype.itemsize, -1)
        steps = np.ascontiguousarray(planes.T).view(f"<u{dtype.itemsize}").reshape(-1)
        palette = np.cumsum(steps, dtype=f"u{dtype.itemsize}")
    else:
        palette = np.frombuffer(plain, f"<u{dtype.itemsize}").astype(f"u{dtype.itemsize}")
    if (palette[1:] <= palette[:-1]).any():
        raise DamagedFileError("the palette of a coded tile does not ascend")
    return palette
