"""Tiles of few distinct values, stored without loss as a palette and labels.

The palette holds the bits of each value; NaN of other bits are other values. Where the tile has a
mask, vertices that are not occupied have the last label, which has no value. The section is: the
number of values in the palette and the bytes of the packed palette (LEB128 each), the palette, and
the coded labels (entropy/labels.py). The palette ascends; packed is the difference of each value
from the one before (`sections.pack_planes`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import DamagedFileError
from fhash_formats.transform.entropy.labels import MAX_LABELS, decode_labels, encode_labels
from fhash_formats.transform.tile.sections import (
    Shape,
    build_labelled_stream,
    pack_planes,
    unpack_planes,
)
from fhash_formats.transform.tile.settings import TileSettings, read_varint, varint

__all__ = ["FEW", "has_regions", "labelled_stream", "surely_exceeds", "unpack_labelled"]

Values = npt.NDArray[Any]
Mask = npt.NDArray[np.bool_]

FEW = 256
"""Labels that are tried whether or not values lie in regions."""
REGION_SHARE = 0.5
"""Share of vertices with an equal neighbour from which on many different values may be labels."""
_LOOK = 4096
"""Values that are looked at, at least, where there are as many."""


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


def labelled_stream(
    values: Values,
    settings: TileSettings | None,
    occupied: Mask | None,
    most: int = MAX_LABELS,
) -> bytes | None:
    """The stream of a tile; None for one of too many different values.

    Args:
        values: the tile (t, z, y, x).
        settings: the tile's own settings; None for none.
        occupied: the mask; None for a stream without one. The other values are not stored.
        most: labels that there may be.
    """
    bits = np.ascontiguousarray(values).view(f"u{values.dtype.itemsize}").reshape(-1)
    kept = bits if occupied is None else bits[occupied.reshape(-1)]
    if surely_exceeds(kept, most):
        return None
    palette = np.unique(kept)
    count = palette.size + (occupied is not None)
    if count > most:
        return None
    labels = np.searchsorted(palette, bits).astype(np.uint16)
    if occupied is not None:
        labels[~occupied.reshape(-1)] = palette.size
    packed = pack_planes(np.diff(palette, prepend=palette.dtype.type(0)))
    body = [varint(palette.size), varint(len(packed)), packed]
    body.append(encode_labels(labels.reshape(values.shape), count))
    return build_labelled_stream(b"".join(body), settings, masked=occupied is not None)


def unpack_labelled(
    body: memoryview, shape: Shape, dtype: np.dtype[Any], *, masked: bool
) -> tuple[Values, Mask | None]:
    """The values in a section, and which are occupied; None without a mask.

    Values that are not occupied are arbitrary. Raises DamagedFileError.
    """
    size, body = read_varint(body)
    length, body = read_varint(body)
    count = size + masked
    if not 1 <= count <= MAX_LABELS:
        raise DamagedFileError(f"a coded tile has {count} labels; 1 to {MAX_LABELS} are possible")
    if length > len(body):
        raise DamagedFileError("a coded tile is cut short")
    steps = unpack_planes(body[:length], size, np.dtype(f"u{dtype.itemsize}"))
    palette = np.cumsum(steps, dtype=steps.dtype)
    if (palette[1:] <= palette[:-1]).any():
        raise DamagedFileError("the palette of a coded tile does not ascend")
    labels = decode_labels(body[length:], count, shape)
    # The label of unoccupied vertices has no value: any stands there.
    values = np.append(palette, np.zeros(1, palette.dtype))[labels].view(dtype)
    return values, labels < size if masked else None
