"""Types of numbers that arrays may have."""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["DTYPES", "exact_number", "integer_origin", "is_wide_integer", "is_within"]

DTYPES = {
    name: np.dtype(name)
    for name in (
        "int8",
        "int16",
        "int32",
        "int64",
        "uint8",
        "uint16",
        "uint32",
        "uint64",
        "float16",
        "float32",
        "float64",
    )
}
"""Number types of arrays by the name that Zarr gives them, in native byte order."""


def is_wide_integer(dtype: np.dtype[Any]) -> bool:
    """Whether a type is an integer of 64 bits: beyond 2^53, float64 has not each of them."""
    return dtype.kind in "iu" and dtype.itemsize == 8


def is_within(number: int, dtype: np.dtype[Any]) -> bool:
    """Whether an integer is one of an integer type."""
    limits = np.iinfo(dtype)
    return int(limits.min) <= number <= int(limits.max)


def exact_number(value: int | float) -> int | float:
    """The number as a float, or as an integer where it is one beyond 2^53."""
    return value if isinstance(value, int) and abs(value) > 1 << 53 else float(value)


def integer_origin(low: int | float, high: int | float, dtype: np.dtype[Any]) -> int:
    """The integer that is subtracted before values of a range become floats; 0 for most ranges.

    It is the middle of a range of 64-bit integers that has some beyond 2^53, so that float64 has
    all differences from it, unless the range itself is wider than 2^54. Each of them is an int64.
    """
    if not is_wide_integer(dtype) or max(abs(low), abs(high)) <= 1 << 53:
        return 0
    return (int(low) + int(high) + 1) // 2
