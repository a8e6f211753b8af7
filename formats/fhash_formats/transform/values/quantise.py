"""Coefficients to integers and back: a uniform quantiser with a dead zone, and reconstruction points that the encoder measures."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats import native

__all__ = ["OFFSET_UNIT", "ROUNDING", "dequantise", "quantise"]

OFFSET_UNIT = 128
"""Reconstruction offsets are whole numbers of this part of a step."""
ROUNDING = 0.4
"""Magnitudes are rounded down after this is added (half would be plain rounding): near zero, a smaller number costs fewer bits."""
LARGEST = 1_000_000_000.0

Values = npt.NDArray[Any]


def quantise(
    coefficients: Values, step: float, rounding: float = ROUNDING
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
    """Integers int32, sign(c) floor(|c| / step + rounding), and c / step as float32; magnitudes stop at 1e9."""
    width, scale = coefficients.dtype.itemsize * 8, 1.0 / step
    library = native.library()
    if library is None:
        kind = coefficients.dtype.type
        exact = coefficients * kind(scale)
        magnitude = np.abs(exact)
        magnitude = np.where(
            magnitude < kind(LARGEST), magnitude + kind(rounding), kind(LARGEST)
        ).astype(np.int32)
        return np.where(exact < 0, -magnitude, magnitude), exact.astype(np.float32)
    integers, scaled = (
        np.empty(coefficients.shape, np.int32),
        np.empty(coefficients.shape, np.float32),
    )
    source = np.ascontiguousarray(coefficients)
    getattr(library, f"fhash_quantise_f{width}")(
        ctypes.c_void_p(source.ctypes.data),
        ctypes.c_int64(source.size),
        *(ctypes.c_double(number) for number in (scale, rounding, LARGEST)),
        ctypes.c_void_p(integers.ctypes.data),
        ctypes.c_void_p(scaled.ctypes.data),
    )
    return integers, scaled


def dequantise(
    integers: npt.NDArray[np.int32],
    step: float,
    offsets: tuple[int, int, int],
    dtype: npt.DTypeLike,
) -> Values:
    """sign(q) (|q| + offset / OFFSET_UNIT) step in a floating type; offsets for |q| of 1, 2 and more; 0 for 0."""
    kind: np.dtype[Any] = np.dtype(dtype)
    one, two, more = (offset / OFFSET_UNIT for offset in offsets)
    library = native.library()
    if library is None:
        magnitude = np.abs(integers)
        offset = np.array([0.0, one, two, more], dtype=kind)[np.minimum(magnitude, 3)]
        with np.errstate(over="ignore"):
            value: Values = (magnitude.astype(kind) + offset) * np.array(step, dtype=kind)
        return np.where(integers < 0, -value, value)
    result, source = np.empty(integers.shape, kind), np.ascontiguousarray(integers)
    getattr(library, f"fhash_dequantise_f{kind.itemsize * 8}")(
        ctypes.c_void_p(source.ctypes.data),
        ctypes.c_int64(source.size),
        *(ctypes.c_double(number) for number in (step, one, two, more)),
        ctypes.c_void_p(result.ctypes.data),
    )
    return result
