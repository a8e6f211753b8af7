"""The bytes of a coded tile: flags, a digest, and sections.

A stream is a byte of flags, the CRC-32 of the decoded integers, and sections, each behind its
length (LEB128). The CRC-32 is over the coefficients, then the residual, as little-endian int32; a
stream without coded integers has none. The sections are, in this order and each only if the flags
say so: the tile's own settings, missing values, coefficients or exact values, residual, mask.

Two kinds of values may decode to anything: those that are not finite in the source, and those
outside the coreset. The section of missing values brings the former back. It is the CRC-32 of its
marks as little-endian int32, then the coded marks: 0 for a finite value, 1 for NaN, 2 for infinity,
3 for negative infinity.

Where the settings ask for a mask, values that are not occupied decode to NaN (integers to the
centre). The last section is the mask: nothing if all values are occupied, otherwise the lower 16
bits of the CRC-32 of the packed mask, then the coded mask (mask.py). Such a stream has another
format number, so that a reader without masks refuses it.

Where the settings have a predictor and a bound is asked for, the section of coefficients holds
integers coded by prediction (predict.py), and there is no residual. The values are
origin + step * integer in float64, clipped to the range. These streams have format numbers of their
own, too.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import DamagedFileError
from fhash_formats.transform.entropy.coder import decode_integers, encode_integers
from fhash_formats.transform.entropy.mask import decode_mask, encode_mask
from fhash_formats.transform.entropy.mask_levels import Levels
from fhash_formats.transform.entropy.table import single_band
from fhash_formats.transform.tile.settings import TileSettings

__all__ = [
    "EMPTY",
    "EXACT",
    "FORMAT",
    "LABELS",
    "LABELS_MASKED",
    "MANY",
    "MASKED",
    "MISSING",
    "NUMBER",
    "OWN",
    "PREDICTED",
    "PREDICTED_MASKED",
    "RESIDUAL",
    "Shape",
    "TileStream",
    "build_exact_stream",
    "build_stream",
    "little_endian",
    "pack_mask",
    "pack_missing",
    "pack_settings",
    "parse_stream",
    "restore_missing",
    "section",
    "unpack_exact",
    "unpack_mask",
    "unpack_settings",
    "zero_levels",
]

Shape = tuple[int, int, int, int]
"""Lengths of a tile along (t, z, y, x)."""
Values = npt.NDArray[Any]
Mask = npt.NDArray[np.bool_]
Integers = npt.NDArray[np.int32]

OWN = 1
"""Flag of a stream with settings of its own."""
MISSING = 2
"""Flag of a stream with missing values."""
RESIDUAL = 4
"""Flag of a stream with a residual."""
EXACT = 8
"""Flag of a stream that stores the values without loss."""
EMPTY = 16
"""Flag of a stream without any coded values."""
FORMAT = 1 << 5
"""Format number of a stream coded by transform; the upper three bits of the flags."""
MASKED = 2 << 5
"""Format number of a stream coded by transform, with a mask."""
PREDICTED = 3 << 5
"""Format number of a stream coded by prediction."""
PREDICTED_MASKED = 4 << 5
"""Format number of a stream coded by prediction, with a mask."""

LABELS = 5 << 5
"""Format number of a stream of labels."""
LABELS_MASKED = 6 << 5
"""Format number of a stream of labels, with a mask."""
MANY = 16
"""Flag of a stream of labels that has more than 256 of them."""

NUMBER = 0xE0
"""Bits of the flags that hold the format number."""
_MAX_SETTINGS = 1 << 22
"""Most bytes of a tile's own settings, inflated."""
_MISSING_VALUES = (np.nan, np.inf, -np.inf)
"""Values with the marks 1, 2 and 3."""


@dataclass(frozen=True, kw_only=True)
class TileStream:
    """The flags and sections of a stream. A section is None where the flags say that there is none.

    Attributes:
        flags: the first byte.
        masked: whether the format number says that there is a mask.
        predicted: whether the format number says that the integers are coded by prediction.
        labelled: whether `body` holds a palette and labels.
        coded: whether `body` holds coded integers; otherwise it holds exact values or is None.
        digest: CRC-32 of the integers; 0 where none are coded.
        settings: the tile's own settings.
        missing: missing values.
        body: coefficients, predicted integers or exact values.
        residual: the residual.
        mask: the mask.
    """

    flags: int
    masked: bool
    predicted: bool
    labelled: bool
    coded: bool
    digest: int
    settings: memoryview | None = None
    missing: memoryview | None = None
    body: memoryview | None = None
    residual: memoryview | None = None
    mask: memoryview | None = None

    def sections(self) -> list[bytes]:
        """The sections of the stream, in order."""
        return [
            bytes(data)
            for data in (self.settings, self.missing, self.body, self.residual, self.mask)
            if data is not None
        ]


def build_stream(
    settings: TileSettings | None,
    missing: bytes,
    coefficients: bytes,
    integers: Integers | None,
    residual: Integers | None,
    mask: bytes | None,
    predicted: bool = False,
) -> bytes:
    """The stream of a tile.

    Args:
        settings: the tile's own settings; None for none.
        missing: section of missing values; empty for none.
        coefficients: section of coded coefficients or predicted integers.
        integers: the integers that `coefficients` decodes to; None where nothing is coded.
        residual: residual in quanta; None for none.
        mask: section of the mask; None for a stream without one.
        predicted: whether the integers are coded by prediction.
    """
    numbers = (PREDICTED, PREDICTED_MASKED) if predicted else (FORMAT, MASKED)
    flags = numbers[mask is not None] | (OWN if settings else 0) | (MISSING if missing else 0)
    sections = [*pack_settings(settings), *([missing] if missing else [])]
    if integers is None:
        return bytes([flags | EMPTY]) + b"".join(map(section, sections))
    crc = zlib.crc32(little_endian(integers))
    sections.append(coefficients)
    if residual is not None:
        flags |= RESIDUAL
        crc = zlib.crc32(little_endian(residual), crc)
        table = single_band(residual.shape)
        sections.append(encode_integers(residual, table).data)
    if mask is not None:
        sections.append(mask)
    return bytes([flags]) + crc.to_bytes(4, "little") + b"".join(map(section, sections))


def section(data: bytes) -> bytes:
    """A section with its length (LEB128) in front."""
    size, length = len(data), bytearray()
    while True:
        length.append(size & 127 | (128 if size > 127 else 0))
        size >>= 7
        if not size:
            return bytes(length) + data


def parse_stream(data: bytes | memoryview) -> TileStream:
    """The flags and sections of a stream.

    Raises DamagedFileError where flags contradict each other or the sections are not those of the
    flags. All of that is checked before anything is decoded, which may take long.
    """
    data = memoryview(data)
    if not len(data):
        raise DamagedFileError("a coded tile is empty")
    flags = data[0]
    number = flags & NUMBER
    labelled = number in (LABELS, LABELS_MASKED)
    if not labelled and number not in (FORMAT, MASKED, PREDICTED, PREDICTED_MASKED):
        raise DamagedFileError(
            f"a coded tile begins with {flags:#04x}, which is no known stream format"
        )
    masked = number in (MASKED, PREDICTED_MASKED, LABELS_MASKED)
    if labelled and flags & ~NUMBER & ~(OWN | MANY):
        raise DamagedFileError("a coded tile is of labels and something else as well")
    predicted = number in (PREDICTED, PREDICTED_MASKED)
    coded = not flags & (EXACT | EMPTY) and not labelled
    if predicted and flags & (EXACT | EMPTY | RESIDUAL):
        raise DamagedFileError("a coded tile is by prediction and something else as well")
    if coded and len(data) < 5:
        raise DamagedFileError("a coded tile is cut short")
    empty = not coded and not labelled and not flags & EXACT
    expected = {
        "settings": bool(flags & OWN),
        "missing": bool(flags & MISSING),
        "body": not empty,
        "residual": coded and bool(flags & RESIDUAL),
        "mask": masked and not empty and not labelled,
    }
    names = [name for name, there in expected.items() if there]
    sections = list(_sections(data[5:] if coded else data[1:]))
    if len(sections) != len(names):
        raise DamagedFileError(
            f"a coded tile has {len(sections)} sections; its flags say {len(names)}"
        )
    by_name = dict(zip(names, sections, strict=True))
    if flags & MISSING and not len(by_name["missing"]):
        raise DamagedFileError("a coded tile has lost its missing values")
    digest = int.from_bytes(data[1:5], "little") if coded else 0
    return TileStream(
        flags=flags,
        masked=masked,
        predicted=predicted,
        labelled=labelled,
        coded=coded,
        digest=digest,
        **by_name,
    )


def _sections(data: memoryview) -> Iterator[memoryview]:
    """The sections in order. Raises DamagedFileError where one reaches beyond the end."""
    position = 0
    while position < len(data):
        size = shift = 0
        while True:
            if position >= len(data) or shift > 35:
                raise DamagedFileError("a coded tile is cut short")
            size |= (data[position] & 127) << shift
            shift += 7
            position += 1
            if not data[position - 1] & 128:
                break
        if size > len(data) - position:
            raise DamagedFileError("a coded tile is cut short")
        yield data[position : position + size]
        position += size


def pack_settings(settings: TileSettings | None) -> list[bytes]:
    """The section of a tile's own settings, if there are any: JSON, deflated."""
    if settings is None:
        return []
    return [zlib.compress(json.dumps(settings.to_dict(), separators=(",", ":")).encode("ascii"), 9)]


def unpack_settings(data: bytes | memoryview) -> TileSettings:
    """The settings in a section. Raises DamagedFileError."""
    try:
        inflate = zlib.decompressobj()
        text = inflate.decompress(data, _MAX_SETTINGS)
        if not inflate.eof or inflate.unused_data:
            raise DamagedFileError("the settings of a coded tile are damaged")
        return TileSettings.from_dict(json.loads(text))
    except (zlib.error, ValueError, TypeError, OverflowError, RecursionError) as error:
        raise DamagedFileError(f"the settings of a coded tile are damaged: {error}") from error


def little_endian(integers: Integers) -> memoryview:
    """The bytes of integers over which digests are computed: little-endian int32."""
    return np.ascontiguousarray(integers, dtype="<i4").data.cast("B")


def build_exact_stream(
    values: Values, settings: TileSettings | None, occupied: Mask | None
) -> bytes:
    """The stream of a tile stored without loss: bytes of equal weight together, deflated.

    Args:
        values: the tile (t, z, y, x).
        settings: the tile's own settings; None for none.
        occupied: the mask; None for a stream without one.
    """
    flags = (FORMAT if occupied is None else MASKED) | EXACT | (OWN if settings else 0)
    plain = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
    planes = plain.view(np.uint8).reshape(-1, plain.dtype.itemsize).T
    sections = [*pack_settings(settings), zlib.compress(planes.tobytes(), 6)]
    if occupied is not None:
        sections.append(pack_mask(occupied, zero_levels(values.shape)))
    return bytes([flags]) + b"".join(map(section, sections))


def unpack_exact(data: bytes | memoryview, shape: Shape, dtype: np.dtype[Any]) -> Values:
    """The values in a section of exact values. Raises DamagedFileError."""
    size = int(np.prod(shape)) * dtype.itemsize
    try:
        inflate = zlib.decompressobj()
        plain = inflate.decompress(data, size)
        if inflate.unconsumed_tail:
            inflate.decompress(inflate.unconsumed_tail, 1)
    except zlib.error as error:
        raise DamagedFileError(f"a coded tile is damaged: {error}") from error
    if len(plain) != size or not inflate.eof or inflate.unused_data:
        raise DamagedFileError("a coded tile is damaged: it holds another number of values")
    planes = np.frombuffer(plain, np.uint8).reshape(dtype.itemsize, -1)
    return (
        np.array(planes.T, order="C")
        .view(dtype.newbyteorder("<"))
        .reshape(shape)
        .astype(dtype, copy=False)
    )


def pack_missing(values: Values, finite: Mask) -> bytes:
    """The section of missing values. finite: where the values are finite."""
    marks = np.where(finite, 0, np.where(np.isnan(values), 1, np.where(values > 0, 2, 3))).astype(
        np.int32
    )
    return (
        zlib.crc32(little_endian(marks)).to_bytes(4, "little")
        + encode_integers(marks, single_band(values.shape)).data
    )


def restore_missing(decoded: Values, missing: bytes) -> Values:
    """Put the missing values of a section into decoded values, in place.

    missing: the section; empty where nothing is missing. Raises DamagedFileError.
    """
    if missing:
        if decoded.dtype.kind != "f":
            raise DamagedFileError("a coded tile of integers has missing values")
        marks = decode_integers(missing[4:], decoded.shape, single_band(decoded.shape))
        if (
            zlib.crc32(little_endian(marks)).to_bytes(4, "little") != missing[:4]
            or marks.min() < 0
            or marks.max() > 3
        ):
            raise DamagedFileError("the missing values of a coded tile are damaged")
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
    return _digest(occupied) + (encode_mask(occupied, levels) or b"\0")


def unpack_mask(packed: bytes | memoryview, levels: tuple[Levels, Levels]) -> Mask:
    """The mask in a section. Raises DamagedFileError."""
    if not len(packed):
        return np.ones(levels[0].shape, bool)
    mask = decode_mask(packed[2:], levels)
    if _digest(mask) != packed[:2]:
        raise DamagedFileError("the decoded mask of a tile differs from its digest")
    return mask


def _digest(mask: Mask) -> bytes:
    """The lower 16 bits of the CRC-32 of a mask."""
    return (zlib.crc32(np.packbits(mask).data) & 0xFFFF).to_bytes(2, "little")
