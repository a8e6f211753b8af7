"""The bytes of a coded tile: flags, sections, and what they hold beside the coded values: settings, digests, missing values, masks.

A stream is a byte of flags, the CRC-32 of the decoded integers (coefficients, then residual, as little-endian int32; left out if nothing is
coded), and sections, each behind its length (LEB128): own settings, missing, coefficients, residual, exact. What is not finite in the
source, and what the caller does not care for, may decode to anything; the former comes back as it was by the section `missing`: the
CRC-32 of its marks as little-endian int32 (0 for what is finite, 1 NaN, 2 and 3 infinity and its negative), and the coded marks.

Where the settings ask for a mask, what the caller does not care for decodes to NaN (the centre, for whole numbers), and what is occupied is
known from the last section: nothing if all is, else the lower 16 bits of the CRC-32 of the mask, packed, and the coded mask (mask.py).
Such a stream has another number, so that a reader that knows no masks refuses it.

Where the settings have a predictor and a bound is asked for, the coefficients are integers coded by prediction (predict.py) and there is
no residual: the values are origin + step * integer in float64, within the range. These streams have numbers of their own, too.
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
    "MASKED",
    "MISSING",
    "OWN",
    "PREDICTED",
    "PREDICTED_MASKED",
    "RESIDUAL",
    "Parts",
    "Shape",
    "assembled",
    "exact_bytes",
    "exact_values",
    "little",
    "no_levels",
    "pack_mask",
    "pack_missing",
    "parts_of",
    "restored",
    "section",
    "settings_from",
    "unpack_mask",
]

Shape = tuple[int, int, int, int]
Values = npt.NDArray[Any]
Mask = npt.NDArray[np.bool_]

OWN, MISSING, RESIDUAL, EXACT, EMPTY = 1, 2, 4, 8, 16
FORMAT, MASKED, PREDICTED, PREDICTED_MASKED = 1 << 5, 2 << 5, 3 << 5, 4 << 5
"""The upper three bits of the flags are the number of the stream format, 1 or with a mask 2; by prediction 3, or with a mask 4."""


@dataclass(frozen=True, kw_only=True)
class Parts:
    """A stream taken apart.

    flags: the first byte; masked, predicted: what its number says; coded: whether `body` is coded integers, else exact values or nothing.
    digest: CRC-32 of the integers, 0 where none are coded. The rest are the sections, None where the flags say that there is none: own
    settings, missing, coefficients or exact values, residual, mask.
    """

    flags: int
    masked: bool
    predicted: bool
    coded: bool
    digest: int
    settings: memoryview | None = None
    missing: memoryview | None = None
    body: memoryview | None = None
    residual: memoryview | None = None
    mask: memoryview | None = None

    def sections(self) -> list[bytes]:
        """Those that there are, in their order."""
        return [
            bytes(part)
            for part in (self.settings, self.missing, self.body, self.residual, self.mask)
            if part is not None
        ]


def assembled(
    settings: TileSettings | None,
    missing: bytes,
    coefficients: bytes,
    integers: npt.NDArray[np.int32] | None,
    residual: npt.NDArray[np.int32] | None,
    mask: bytes | None,
    predicted: bool = False,
) -> bytes:
    """The stream of a tile.

    settings: its own, or None. missing, mask: sections. coefficients: coded, and the integers that they are; None where nothing is coded.
    """
    numbers = (PREDICTED, PREDICTED_MASKED) if predicted else (FORMAT, MASKED)
    flags = numbers[mask is not None] | (OWN if settings else 0) | (MISSING if missing else 0)
    sections = [*_own(settings), *([missing] if missing else [])]
    if integers is None:
        return bytes([flags | EMPTY]) + b"".join(map(section, sections))
    crc = zlib.crc32(little(integers))
    sections.append(coefficients)
    if residual is not None:
        flags |= RESIDUAL
        crc = zlib.crc32(little(residual), crc)
        sections.append(encode_integers(residual, single_band(residual.shape)).data)
    if mask is not None:
        sections.append(mask)
    return bytes([flags]) + crc.to_bytes(4, "little") + b"".join(map(section, sections))


def section(data: bytes) -> bytes:
    """A section behind its length."""
    size, head = len(data), bytearray()
    while True:
        head.append(size & 127 | (128 if size > 127 else 0))
        size >>= 7
        if not size:
            return bytes(head) + data


def parts_of(data: bytes | memoryview) -> Parts:
    """A stream taken apart; raises DamagedFileError where flags contradict each other, or other sections are there than they say.

    All of that is known before anything is decoded, which may take long.
    """
    data = memoryview(data)
    if not len(data):
        raise DamagedFileError("a coded tile is empty")
    flags = data[0]
    number = flags & 0xE0
    if number not in (FORMAT, MASKED, PREDICTED, PREDICTED_MASKED):
        raise DamagedFileError(
            f"a coded tile begins with {flags:#04x}, which is no known stream format"
        )
    masked, predicted, coded = (
        number in (MASKED, PREDICTED_MASKED),
        number in (PREDICTED, PREDICTED_MASKED),
        not flags & (EXACT | EMPTY),
    )
    if predicted and flags & (EXACT | EMPTY | RESIDUAL):
        raise DamagedFileError("a coded tile is by prediction and something else as well")
    if coded and len(data) < 5:
        raise DamagedFileError("a coded tile is cut short")
    empty = not coded and not flags & EXACT
    expected = {
        "settings": bool(flags & OWN),
        "missing": bool(flags & MISSING),
        "body": not empty,
        "residual": coded and bool(flags & RESIDUAL),
        "mask": masked and not empty,
    }
    names = [name for name, there in expected.items() if there]
    sections = list(_sections(data[5:] if coded else data[1:]))
    if len(sections) != len(names):
        raise DamagedFileError(
            f"a coded tile has {len(sections)} sections; its flags say {len(names)}"
        )
    found = dict(zip(names, sections, strict=True))
    if flags & MISSING and not len(found["missing"]):
        raise DamagedFileError("a coded tile has lost its missing values")
    digest = int.from_bytes(data[1:5], "little") if coded else 0
    return Parts(
        flags=flags, masked=masked, predicted=predicted, coded=coded, digest=digest, **found
    )


def _sections(data: memoryview) -> Iterator[memoryview]:
    """The sections one after the other; DamagedFileError where one reaches beyond the end."""
    at = 0
    while at < len(data):
        size = shift = 0
        while True:
            if at >= len(data) or shift > 35:
                raise DamagedFileError("a coded tile is cut short")
            size |= (data[at] & 127) << shift
            shift += 7
            at += 1
            if not data[at - 1] & 128:
                break
        if size > len(data) - at:
            raise DamagedFileError("a coded tile is cut short")
        yield data[at : at + size]
        at += size


def _own(settings: TileSettings | None) -> list[bytes]:
    if settings is None:
        return []
    return [zlib.compress(json.dumps(settings.to_dict(), separators=(",", ":")).encode("ascii"), 9)]


def settings_from(data: bytes | memoryview) -> TileSettings:
    """A tile's own settings; raises DamagedFileError."""
    try:
        inflate = zlib.decompressobj()
        text = inflate.decompress(data, 1 << 22)
        if not inflate.eof or inflate.unused_data:
            raise DamagedFileError("the settings of a coded tile are damaged")
        return TileSettings.from_dict(json.loads(text))
    except (zlib.error, ValueError, TypeError, OverflowError, RecursionError) as error:
        raise DamagedFileError(f"the settings of a coded tile are damaged: {error}") from error


def little(integers: npt.NDArray[np.int32]) -> memoryview:
    """Integers as the digest takes them."""
    return np.ascontiguousarray(integers, dtype="<i4").data.cast("B")


def exact_bytes(values: Values, settings: TileSettings | None, occupied: Mask | None) -> bytes:
    """The stream of a tile stored without loss: the bytes of equal weight together, deflated."""
    flags = (FORMAT if occupied is None else MASKED) | EXACT | (OWN if settings else 0)
    plain = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
    planes = plain.view(np.uint8).reshape(-1, plain.dtype.itemsize).T
    body = zlib.compress(planes.tobytes(), 6)
    sections = [
        *_own(settings),
        body,
        *([] if occupied is None else [pack_mask(occupied, no_levels(values.shape))]),
    ]
    return bytes([flags]) + b"".join(map(section, sections))


def exact_values(data: bytes | memoryview, shape: Shape, dtype: np.dtype[Any]) -> Values:
    """The values of such a section; raises DamagedFileError."""
    count = int(np.prod(shape)) * dtype.itemsize
    try:
        inflate = zlib.decompressobj()
        plain = inflate.decompress(data, count)
        if inflate.unconsumed_tail:
            inflate.decompress(inflate.unconsumed_tail, 1)
    except zlib.error as error:
        raise DamagedFileError(f"a coded tile is damaged: {error}") from error
    if len(plain) != count or not inflate.eof or inflate.unused_data:
        raise DamagedFileError("a coded tile is damaged: it holds another number of values")
    planes = np.frombuffer(plain, np.uint8).reshape(dtype.itemsize, -1)
    return (
        np.array(planes.T, order="C")
        .view(dtype.newbyteorder("<"))
        .reshape(shape)
        .astype(dtype, copy=False)
    )


_MISSING_VALUES = (np.nan, np.inf, -np.inf)


def pack_missing(values: Values, finite: Mask) -> bytes:
    """The section of values that are not finite."""
    marks = np.where(finite, 0, np.where(np.isnan(values), 1, np.where(values > 0, 2, 3))).astype(
        np.int32
    )
    return (
        zlib.crc32(little(marks)).to_bytes(4, "little")
        + encode_integers(marks, single_band(values.shape)).data
    )


def restored(decoded: Values, missing: bytes) -> Values:
    """Decoded values with what is missing put in, in place; `missing` is empty where nothing is. Raises DamagedFileError."""
    if missing:
        if decoded.dtype.kind != "f":
            raise DamagedFileError("a coded tile of integers has missing values")
        marks = decode_integers(missing[4:], decoded.shape, single_band(decoded.shape))
        if (
            zlib.crc32(little(marks)).to_bytes(4, "little") != missing[:4]
            or marks.min() < 0
            or marks.max() > 3
        ):
            raise DamagedFileError("the missing values of a coded tile are damaged")
        for mark, value in enumerate(_MISSING_VALUES, start=1):
            decoded[marks == mark] = value
    return decoded


def no_levels(shape: tuple[int, ...]) -> tuple[Levels, Levels]:
    """Where nothing is known of how likely a mask is."""
    return np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)


def pack_mask(occupied: Mask, levels: tuple[Levels, Levels]) -> bytes:
    """The section of a mask; empty where all is occupied."""
    # The coder reads zeros past the end: one zero is as good as no byte.
    return b"" if occupied.all() else _digest(occupied) + (encode_mask(occupied, levels) or b"\0")


def unpack_mask(packed: bytes | memoryview, levels: tuple[Levels, Levels]) -> Mask:
    """The mask of a section; raises DamagedFileError."""
    if not len(packed):
        return np.ones(levels[0].shape, bool)
    mask = decode_mask(packed[2:], levels)
    if _digest(mask) != packed[:2]:
        raise DamagedFileError("the decoded mask of a tile differs from its digest")
    return mask


def _digest(mask: Mask) -> bytes:
    return (zlib.crc32(np.packbits(mask).data) & 0xFFFF).to_bytes(2, "little")
