"""Sections of streams, packed by numpy and the native kernels, for tests that build streams."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np

from fhash_formats.errors import DamagedFileError
from fhash_formats.support.values import Integers, Mask, Values
from fhash_formats.transform.spec import MAX_LABELS
from fhash_formats.transform.tile_format import (
    EMPTY,
    FAST,
    LABELS,
    MASKED,
    MISSING,
    OWN,
    RESIDUAL,
    Shape,
    TileSettings,
    read_varint,
    seal,
    surely_exceeds,
    varint,
)
from reference.kernels import (
    decode_labels,
    encode_integers,
    encode_labels,
    single_band,
)


def build_stream(
    kind: int,
    settings: TileSettings | None,
    missing: bytes = b"",
    body: bytes = b"",
    residual: Integers | None = None,
    mask: bytes | None = None,
    *,
    fast: bool = False,
) -> bytes:
    """The stream of a tile.

    Args:
        kind: TRANSFORMED, PREDICTED or EMPTY.
        settings: the tile's own settings; None for none.
        missing: section of missing values; empty for none.
        body: section of coded coefficients or predicted integers.
        residual: residual in quanta; None for none.
        mask: section of the mask; None for a stream without one.
        fast: whether the body is, and the residual shall be, of the fast coder.
    """
    flags, sections = _head(kind, settings, mask is not None)
    flags |= FAST if fast else 0
    if missing:
        flags |= MISSING
        sections.append(missing)
    if kind != EMPTY:
        sections.append(body)
    if residual is not None:
        flags |= RESIDUAL
        sections.append(encode_integers(residual, single_band(residual.shape), fast=fast).data)
    if mask is not None and kind != EMPTY:
        sections.append(mask)
    return seal(flags, sections)


def build_labelled_stream(body: bytes, settings: TileSettings | None, *, masked: bool) -> bytes:
    """The stream of a tile of labels. body: the section of palette and labels."""
    flags, sections = _head(LABELS, settings, masked)
    return seal(flags, [*sections, body])


def _head(kind: int, settings: TileSettings | None, masked: bool) -> tuple[int, list[bytes]]:
    """The first flags and sections of a stream."""
    flags = kind | (MASKED if masked else 0)
    return (flags, []) if settings is None else (flags | OWN, [settings.to_bytes()])


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
    plain = np.where(np.isnan(values), np.asarray(np.nan, values.dtype), values)
    bits = plain.view(f"u{values.dtype.itemsize}")
    palette = np.unique(bits[~finite])
    marks = np.where(finite, 0, np.searchsorted(palette, bits) + 1)
    little = palette.astype(palette.dtype.newbyteorder("<"))
    head = bytes([palette.size]) + little.tobytes()
    return head + encode_labels(marks, palette.size + 1)


def restore_missing(decoded: Values, missing: bytes | memoryview | None) -> Values:
    """Put the missing values of a section into decoded values, in place.

    missing: the section; empty or None where nothing is missing. Raises DamagedFileError.
    """
    if missing:
        palette, coded = missing_palette(missing, decoded.dtype)
        marks = decode_labels(coded, palette.size + 1, decoded.shape)
        decoded[marks > 0] = palette[marks[marks > 0] - 1]
    return decoded


def missing_palette(section: bytes | memoryview, dtype: np.dtype[Any]) -> tuple[Values, memoryview]:
    """The values of a section of missing values, and the labels after them."""
    end = 1 + section[0] * dtype.itemsize
    bits = np.frombuffer(section[1:end], f"<u{dtype.itemsize}")
    if end > len(section) or np.any(bits[1:] <= bits[:-1]):
        raise DamagedFileError("the missing values of a coded tile are cut, or do not ascend")
    return bits.astype(f"u{dtype.itemsize}").view(dtype), memoryview(section)[end:]


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
