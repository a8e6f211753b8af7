"""Coefficients to integers and back.

The quantiser is uniform with a dead zone; the encoder measures the reconstruction points. Dependent
quantisation chooses its integers elsewhere (entropy/trellis.py), and comes back in the same way.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats import native

__all__ = ["LARGEST", "OFFSET_UNIT", "ROUNDING", "Offsets", "dequantise", "quantise"]

OFFSET_UNIT = 128
"""Units in a quantiser step, for reconstruction offsets."""
ROUNDING = 0.4
"""Number added to |c| / step before rounding down.

Plain rounding adds 0.5. Less makes smaller integers near zero, which take fewer bits.
"""
LARGEST = 1_000_000_000.0
"""Largest magnitude of an integer; larger ones are clipped."""

Values = npt.NDArray[Any]
Offsets = tuple[int, ...]
"""Six reconstruction offsets by magnitude, in 1/OFFSET_UNIT step; see `dequantise`."""


def quantise(
    coefficients: Values, step: float, rounding: float = ROUNDING
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
    """The integers sign(c) floor(|c| / step + rounding), int32, and c / step, float32.

    Args:
        coefficients: coefficients c, float32 or float64.
        step: quantiser step, in units of the coefficients.
        rounding: fraction of a step added before rounding down.
    """
    width, scale = coefficients.dtype.itemsize * 8, 1.0 / step
    integers = np.empty(coefficients.shape, np.int32)
    scaled = np.empty(coefficients.shape, np.float32)
    source = np.ascontiguousarray(coefficients)
    getattr(native.library(), f"fhash_quantise_f{width}")(
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
    offsets: Offsets,
    dtype: npt.DTypeLike,
) -> Values:
    """The coefficients sign(q) (|q| + offset / OFFSET_UNIT) step of integers q; 0 for 0.

    Args:
        integers: integers q.
        step: quantiser step, in units of the coefficients.
        offsets: in 1/OFFSET_UNIT step, of |q| = 1, 2, 3, 4, odd ones from 5 on, and even ones from
            6 on.
        dtype: type of the coefficients, float32 or float64.
    """
    kind: np.dtype[Any] = np.dtype(dtype)
    shifts = np.array(offsets, dtype=np.float64) / OFFSET_UNIT
    result, source = np.empty(integers.shape, kind), np.ascontiguousarray(integers)
    getattr(native.library(), f"fhash_dequantise_f{kind.itemsize * 8}")(
        ctypes.c_void_p(source.ctypes.data),
        ctypes.c_int64(source.size),
        ctypes.c_double(step),
        ctypes.c_void_p(shifts.ctypes.data),
        ctypes.c_void_p(result.ctypes.data),
    )
    return result
