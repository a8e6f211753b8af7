"""Values of a tile: casts, origins, and frames of zstd."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.support.values import Values

_INT64 = np.iinfo(np.int64)

PIECE = 1 << 14
"""Values that numpy works on at once."""


def all_finite(values: Values) -> bool:
    """Whether no value, of any real type, is NaN or infinite."""
    if values.dtype.kind != "f":
        return True
    flat = values.reshape(-1)
    return all(bool(np.isfinite(flat[piece]).all()) for piece in pieces(flat.size))


def cast(values: Values, dtype: np.dtype[Any]) -> Values:
    """Floating-point values in another type, as a new array.

    For an integer type they are rounded and clipped to its range.
    """
    if dtype.kind == "f":
        with np.errstate(over="ignore"):
            return values.astype(dtype)
    result = np.empty(values.shape, dtype)
    flat_values, flat_result = values.reshape(-1), result.reshape(-1)
    limits = np.iinfo(dtype)
    # float64 cannot hold the largest 64-bit integers; the number below them is in the range.
    low, high = float(limits.min), float(limits.max)
    high = high if int(high) <= limits.max else float(np.nextafter(high, 0.0))
    for piece in pieces(values.size):
        rounded = np.rint(np.nan_to_num(flat_values[piece].astype(np.float64)))
        flat_result[piece] = np.clip(rounded, low, high)
    return result


def about_origin(values: Values, origin: int) -> Values:
    """The differences int64 of 64-bit integers from an origin, or float64 ones of floats.

    Raises InputError beyond int64.
    """
    if values.dtype.kind == "f":
        rounded = float(origin)
        return (values.astype(np.float64) - rounded) + (int(rounded) - origin)
    for end in (values.min(), values.max()) if values.size else ():
        if not _INT64.min <= int(end) - origin <= _INT64.max:
            raise InputError(
                f"the value {end} is too far from the origin {origin} of the settings: the "
                "difference must be an int64"
            )
    differences = values.view(np.uint64) - np.uint64(origin % (1 << 64))
    return differences.view(np.int64)


def at_origin(differences: Values, origin: int, dtype: np.dtype[Any]) -> Values:
    """The 64-bit integers whose differences from an origin are given, clipped to their type."""
    limits = np.iinfo(dtype)
    low, high = max(limits.min - origin, _INT64.min), min(limits.max - origin, _INT64.max)
    sums = np.clip(differences, low, high).view(np.uint64) + np.uint64(origin % (1 << 64))
    return sums.view(dtype)


def pieces(size: int) -> Iterator[slice]:
    """Slices that split a flat array of `size` values into pieces small enough for the cache."""
    return (slice(start, start + PIECE) for start in range(0, size, PIECE))


ZSTD_LEVEL = 9
"""Level at which arrays are written; a reader takes any."""
ZSTD_MAX_RATIO = 32 << 10
"""Decoded bytes per byte of zstd data.

A block of at most 128 KiB takes at least a header of three bytes and one more (RFC 8878, 3.1.1.2).
"""
_ZSTD_MARK = 0xFD2FB528


def zstd_content_size(data: memoryview | bytes) -> int | None:
    """The content size in the header of a zstd frame; None where the header has none.

    Raises DamagedFileError for data that do not begin with such a header (RFC 8878, 3.1.1.1).
    """
    if len(data) < 6 or int.from_bytes(data[:4], "little") != _ZSTD_MARK:
        raise DamagedFileError("not a zstd frame")
    descriptor = data[4]
    single_segment = bool(descriptor & 0x20)
    size_bytes = (1 if single_segment else 0, 2, 4, 8)[descriptor >> 6]
    at = 5 + (0 if single_segment else 1) + (0, 1, 2, 4)[descriptor & 3]
    if len(data) < at + size_bytes:
        raise DamagedFileError("the header of the zstd frame is cut short")
    if size_bytes == 0:
        return None
    return int.from_bytes(data[at : at + size_bytes], "little") + (256 if size_bytes == 2 else 0)


def from_zstd(data: memoryview, least: int, most: int) -> npt.NDArray[np.uint8]:
    """The bytes in one zstd frame that declares from `least` to `most` of them.

    Raises DamagedFileError for data that hold none, or another number of bytes.
    """
    from numcodecs.zstd import decompress

    declared = zstd_content_size(data)
    if declared is None or not least <= declared <= most:
        raise DamagedFileError(f"zstd declares {declared} bytes; the chunk has {most}")
    if declared > ZSTD_MAX_RATIO * len(data):
        raise DamagedFileError(
            f"zstd declares {declared} bytes, which {len(data)} bytes cannot hold"
        )
    # The buffer has exactly the declared size, which bounds what a hostile frame can write.
    found = np.empty(declared, np.uint8)
    try:
        decompress(data, found)
    except (RuntimeError, ValueError) as error:
        # zstd found no memory for its own work space: the data may be sound.
        if "Allocation error" in str(error):
            raise MemoryError("no memory to decompress a chunk") from error
        raise DamagedFileError(f"zstd data are damaged: {error}") from error
    return found
