"""Types of numbers that arrays may have."""

from __future__ import annotations

import numpy as np

__all__ = ["DTYPES"]

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
