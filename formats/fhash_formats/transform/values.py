"""Values of a tile: casts, origins, and frames of zstd."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from fhash_formats.errors import InputError
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
