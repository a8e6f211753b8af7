"""Types of numbers that arrays may have."""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["DTYPES", "is_wide_integer"]

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
