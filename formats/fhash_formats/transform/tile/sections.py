"""The bytes of a coded tile: a checksum, flags, and sections.

A stream is the CRC-32C of all that follows, a byte of flags, and sections, each but the last behind
its length (LEB128). The flags name the kind of the stream and say which sections there are, always
in this order: the tile's own settings, missing values, the body (coefficients, predicted integers,
labels or exact values), residual, mask.

Two kinds of values may decode to anything: those that are not finite in the source, and those
outside the coreset. The section of missing values brings the former back: labels 0 for a finite
value, 1 for NaN, 2 for infinity, 3 for negative infinity. Where the settings ask for a mask, values
that are not occupied decode to NaN (integers to the centre). Its section is empty if all values are
occupied. A tile of labels has a label for them instead, and an empty one has none that is occupied.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import DamagedFileError
from fhash_formats.native import crc32c
from fhash_formats.transform.entropy.coder import encode_integers
from fhash_formats.transform.entropy.labels import decode_labels, encode_labels
from fhash_formats.transform.entropy.mask import decode_mask, encode_mask
from fhash_formats.transform.entropy.mask_levels import Levels
from fhash_formats.transform.entropy.table import single_band
from fhash_formats.transform.tile.settings import TileSettings, read_varint, varint

__all__ = [
    "EMPTY",
    "EXACT",
    "KIND",
    "LABELS",
    "MASKED",
    "MISSING",
    "OWN",
    "PREDICTED",
    "RESIDUAL",
    "TRANSFORMED",
    "Shape",
    "TileStream",
    "build_exact_stream",
    "build_labelled_stream",
    "build_stream",
    "pack_mask",
    "pack_missing",
    "pack_planes",
    "parse_stream",
    "restore_missing",
    "seal",
    "unpack_mask",
    "unpack_planes",
    "zero_levels",
]

Shape = tuple[int, int, int, int]
"""Lengths of a tile along (t, z, y, x)."""
Values = npt.NDArray[Any]
Mask = npt.NDArray[np.bool_]
Integers = npt.NDArray[np.int32]

TRANSFORMED, PREDICTED, LABELS, EXACT, EMPTY = range(5)
"""Kinds of streams."""
KIND = 7
"""Bits of the flags that hold the kind."""
OWN = 8
"""Flag of a stream with settings of its own."""
MISSING = 16
"""Flag of a stream with missing values."""
RESIDUAL = 32
"""Flag of a stream with a residual."""
MASKED = 64
"""Flag of a stream that says which values are occupied."""

_ALLOWED = {
    TRANSFORMED: OWN | MISSING | RESIDUAL | MASKED,
    PREDICTED: OWN | MISSING | MASKED,
    LABELS: OWN | MASKED,
    EXACT: OWN | MASKED,
    EMPTY: OWN | MISSING | MASKED,
}
"""Flags that a stream of each kind may have."""
_CHECKSUM = 4
"""Bytes of the checksum."""
_MARKS = 4
"""Labels of missing values."""
_MISSING_VALUES = (np.nan, np.inf, -np.inf)
"""Values with the labels 1, 2 and 3."""


@dataclass(frozen=True, kw_only=True)
class TileStream:
    """The sections of a stream. A section is None where the flags say that there is none.

    Attributes:
        kind: TRANSFORMED, PREDICTED, LABELS, EXACT or EMPTY.
        masked: whether the stream says which values are occupied.
        settings: the tile's own settings.
        missing: missing values.
        body: coefficients, predicted integers, labels or exact values.
        residual: the residual.
        mask: the mask.
    """

    kind: int
    masked: bool
    settings: memoryview | None = None
    missing: memoryview | None = None
    body: memoryview | None = None
    residual: memoryview | None = None
    mask: memoryview | None = None


def seal(flags: int, sections: list[bytes]) -> bytes:
    """The stream of flags and sections, with its checksum."""
    *others, last = sections or [b""]
    lengths = [part for section in others for part in (varint(len(section)), section)]
    data = b"".join([bytes([flags]), *lengths, last])
    return crc32c(data).to_bytes(_CHECKSUM, "little") + data


def build_stream(
    kind: int,
    settings: TileSettings | None,
    missing: bytes = b"",
    body: bytes = b"",
    residual: Integers | None = None,
    mask: bytes | None = None,
) -> bytes:
    """The stream of a tile.

    Args:
        kind: TRANSFORMED, PREDICTED or EMPTY.
        settings: the tile's own settings; None for none.
        missing: section of missing values; empty for none.
        body: section of coded coefficients or predicted integers.
        residual: residual in quanta; None for none.
        mask: section of the mask; None for a stream without one.
    """
    flags, sections = _head(kind, settings, mask is not None)
    if missing:
        flags |= MISSING
        sections.append(missing)
    if kind != EMPTY:
        sections.append(body)
    if residual is not None:
        flags |= RESIDUAL
        sections.append(encode_integers(residual, single_band(residual.shape)).data)
    if mask is not None and kind != EMPTY:
        sections.append(mask)
    return seal(flags, sections)


def build_exact_stream(
    values: Values, settings: TileSettings | None, occupied: Mask | None
) -> bytes:
    """The stream of a tile stored without loss.

    Args:
        values: the tile (t, z, y, x).
        settings: the tile's own settings; None for none.
        occupied: the mask; None for a stream without one.
    """
    flags, sections = _head(EXACT, settings, occupied is not None)
    sections.append(pack_planes(values))
    if occupied is not None:
        sections.append(pack_mask(occupied, zero_levels(values.shape)))
    return seal(flags, sections)


def build_labelled_stream(body: bytes, settings: TileSettings | None, *, masked: bool) -> bytes:
    """The stream of a tile of labels. body: the section of palette and labels."""
    flags, sections = _head(LABELS, settings, masked)
    return seal(flags, [*sections, body])


def _head(kind: int, settings: TileSettings | None, masked: bool) -> tuple[int, list[bytes]]:
    """The first flags and sections of a stream."""
    flags = kind | (MASKED if masked else 0)
    return (flags, []) if settings is None else (flags | OWN, [settings.to_bytes()])


def parse_stream(data: bytes | memoryview) -> TileStream:
    """The flags and sections of a stream.

    Raises DamagedFileError where the checksum differs, flags contradict each other, or the sections
    are not those of the flags. All of that is checked before anything is decoded, which may take
    long.
    """
    data = memoryview(data)
    if len(data) <= _CHECKSUM:
        raise DamagedFileError(f"a coded tile has {len(data)} bytes, which are too few")
    if crc32c(data[_CHECKSUM:]) != int.from_bytes(data[:_CHECKSUM], "little"):
        raise DamagedFileError("the CRC-32C of a coded tile differs, it is damaged")
    flags = data[_CHECKSUM]
    kind = flags & KIND
    if flags & ~KIND & ~_ALLOWED.get(kind, 0) or kind not in _ALLOWED:
        raise DamagedFileError(f"a coded tile has the flags {flags:#04x}, which no encoder writes")
    masked = bool(flags & MASKED)
    there = {
        "settings": bool(flags & OWN),
        "missing": bool(flags & MISSING),
        "body": kind != EMPTY,
        "residual": bool(flags & RESIDUAL),
        "mask": masked and kind not in (EMPTY, LABELS),
    }
    names = [name for name in there if there[name]]
    sections = _sections(data[_CHECKSUM + 1 :], len(names))
    return TileStream(kind=kind, masked=masked, **dict(zip(names, sections, strict=True)))


def _sections(data: memoryview, count: int) -> list[memoryview]:
    """So many sections. Raises DamagedFileError where one reaches beyond the end."""
    found = []
    for _ in range(count - 1):
        size, data = read_varint(data)
        if size > len(data):
            raise DamagedFileError("a coded tile is cut short")
        found.append(data[:size])
        data = data[size:]
    if not count and len(data):
        raise DamagedFileError("an empty tile has bytes after its end")
    return [*found, data] if count else found


def pack_planes(values: Values) -> bytes:
    """The bytes of values of any shape: those of equal weight together, lowest first, deflated."""
    plain = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
    planes = plain.view(np.uint8).reshape(-1, plain.dtype.itemsize).T
    return zlib.compress(planes.tobytes(), 6)


def unpack_planes(data: bytes | memoryview, count: int, dtype: np.dtype[Any]) -> Values:
    """So many values that `pack_planes` packed, one axis. Raises DamagedFileError."""
    size = count * dtype.itemsize
    try:
        inflate = zlib.decompressobj()
        plain = inflate.decompress(data, size + 1)  # one more, so that it comes to the end
    except zlib.error as error:
        raise DamagedFileError(f"a coded tile is damaged: {error}") from error
    if len(plain) != size or not inflate.eof or inflate.unused_data:
        raise DamagedFileError("a coded tile is damaged: it holds another number of values")
    planes = np.frombuffer(plain, np.uint8).reshape(dtype.itemsize, -1)
    found = np.array(planes.T, order="C").view(dtype.newbyteorder("<")).reshape(-1)
    return found.astype(dtype, copy=False)


def pack_missing(values: Values, finite: Mask) -> bytes:
    """The section of missing values. finite: where the values are finite."""
    marks = np.where(finite, 0, np.where(np.isnan(values), 1, np.where(values > 0, 2, 3)))
    return encode_labels(marks, _MARKS)


def restore_missing(decoded: Values, missing: bytes | memoryview | None) -> Values:
    """Put the missing values of a section into decoded values, in place.

    missing: the section; empty or None where nothing is missing. Raises DamagedFileError.
    """
    if missing:
        if decoded.dtype.kind != "f":
            raise DamagedFileError("a coded tile of integers has missing values")
        marks = decode_labels(missing, _MARKS, decoded.shape)
        for mark, value in enumerate(_MISSING_VALUES, start=1):
            decoded[marks == mark] = value
    return decoded


def zero_levels(shape: tuple[int, ...]) -> tuple[Levels, Levels]:
    """Levels of a mask that no decoded values say anything about."""
    return np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)


def pack_mask(occupied: Mask, levels: tuple[Levels, Levels]) -> bytes:
    """The section of a mask; empty where all values are occupied.

    levels: how likely each value is occupied (`MaskLevels.levels`).
    """
    if occupied.all():
        return b""
    # The decoder reads zeros past the end, so one zero stands for an empty code.
    return encode_mask(occupied, levels) or b"\0"


def unpack_mask(packed: bytes | memoryview, levels: tuple[Levels, Levels]) -> Mask:
    """The mask in a section."""
    return decode_mask(packed, levels) if len(packed) else np.ones(levels[0].shape, bool)
