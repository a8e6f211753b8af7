"""A part of a tile: the tile is decoded up to its head, which then corrects no more than the part.

A head takes as long as the rest of a small tile, and a region is often a small part of one.
"""

from __future__ import annotations

from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.transform.tile.decoding import table_about_origin, within_range
from fhash_formats.transform.tile.sections import TRANSFORMED, Shape, parse_stream
from fhash_formats.transform.tile.settings import TileSettings
from fhash_formats.transform.values.elementwise import at_origin, corrected

__all__ = ["corrected_part", "uncorrected"]

SHARE = 4
"""A part is corrected alone where its head sees at most one SHARE-th of the tile's frames.

Who reads whole frames goes on to the next ones."""
REACH = (1, 2, 2, 2)
"""Farthest vertices along (t, z, y, x) that the inputs of a head come from."""

Values = npt.NDArray[Any]
Part = tuple[slice, ...]
"""Slices (t, z, y, x) with explicit ends."""


def uncorrected(
    data: bytes | memoryview, shape: Shape, dtype: npt.DTypeLike, settings: TileSettings, part: Part
) -> Values | None:
    """The values of a tile before its head, where nothing but `corrected_part` is left to do.

    They are less the origin of the settings. None for other tiles, and where the part is a large
    one.

    Raises DamagedFileError for bytes that no encoder writes.
    """
    if settings.head is None:
        return None
    seen = [along.stop - along.start for along in _widened(part, shape, settings)]
    if SHARE * prod(seen[1:]) > prod(shape[1:]):
        return None
    stream = parse_stream(data)
    more = (stream.settings, stream.missing, stream.residual)
    if stream.kind != TRANSFORMED or stream.masked or any(x is not None for x in more):
        return None
    return table_about_origin(stream, shape, dtype, settings)[0]


def corrected_part(
    table: Values, part: Part, dtype: npt.DTypeLike, settings: TileSettings
) -> Values:
    """A part of the values of a tile, as `decode_tile` gives them, in a new array.

    table: what `uncorrected` gave.
    """
    assert settings.head is not None, "a tile without head is decoded whole"
    widened = _widened(part, table.shape, settings)
    # At the ends of the tile the head sees its edge either way; farther in, what it sees instead of
    # what was cut off is cut off again.
    base = settings.head.apply(table[widened])
    inner = tuple(
        slice(along.start - wide.start, along.stop - wide.start)
        for along, wide in zip(part, widened, strict=True)
    )
    kind = np.dtype(dtype)
    coded = settings.differences_of(kind)
    values = within_range(corrected(base[inner], None, 0.0, coded), settings)
    return at_origin(values, settings.origin, kind) if settings.origin else values


def _widened(part: Part, shape: tuple[int, ...], settings: TileSettings) -> Part:
    """A part and what its head sees around it."""
    assert settings.head is not None
    more = 1 if settings.head.cross else 0
    return tuple(
        slice(max(0, along.start - reach - more), min(n, along.stop + reach + more))
        for along, reach, n in zip(part, REACH, shape, strict=True)
    )
