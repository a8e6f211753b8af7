"""Passes of the native library over each value, by cffi, for tests that look at one alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.native import library, pointer
from fhash_formats.support.values import Integers, Mask, Values
from fhash_formats.transform.values import cast, pieces

OFFSET_UNIT = 128
"""Units in a quantiser step, for reconstruction offsets."""
ROUNDING = 0.4
"""Number added to |c| / step before rounding down.

Plain rounding adds 0.5. Less makes smaller integers near zero, which take fewer bits.
"""
LARGEST = 1_000_000_000.0
"""Largest magnitude of an integer; larger ones are clipped."""

Offsets = tuple[int, ...]
"""Six reconstruction offsets by magnitude, in 1/OFFSET_UNIT step; see `dequantise`."""


def quantise(
    coefficients: Values, step: float
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
    """The integers sign(c) floor(|c| / step + ROUNDING), int32, and c / step, float32.

    Args:
        coefficients: coefficients c, float32 or float64.
        step: quantiser step, in units of the coefficients.
    """
    width, scale = coefficients.dtype.itemsize * 8, 1.0 / step
    integers = np.empty(coefficients.shape, np.int32)
    scaled = np.empty(coefficients.shape, np.float32)
    source = np.ascontiguousarray(coefficients)
    getattr(library(), f"fhash_quantise_f{width}")(
        pointer(source),
        source.size,
        *(scale, ROUNDING, LARGEST),
        pointer(integers),
        pointer(scaled),
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
    getattr(library(), f"fhash_dequantise_f{kind.itemsize * 8}")(
        pointer(source),
        source.size,
        step,
        pointer(shifts),
        pointer(result),
    )
    return result


_NATIVE_TYPES = {np.dtype(np.float32): "f32", np.dtype(np.float64): "f64"}
"""Types with native passes, and their names in the library."""


def within(values: Values, decoded: Values, error: float, counted: Mask | None = None) -> bool:
    """Whether |decoded - value| <= error at every counted value.

    Rounding in the comparison never turns a no into a yes.

    Args:
        values: values of any real type.
        decoded: their decoded values, of the same shape and type.
        error: the bound, in units of the values.
        counted: the values that are compared; None for all.
    """
    if values.dtype.kind != "f":
        return _integers_within(values, decoded, error, counted)
    if values.dtype == np.float16:
        values, decoded = values.astype(np.float32), decoded.astype(np.float32)
    return bool(
        _native("within", values.dtype)(
            *_pointers(values, decoded, counted),
            values.size,
            error,
        )
    )


def _integers_within(values: Values, decoded: Values, error: float, counted: Mask | None) -> bool:
    """`within` for integers, exact also where float64 is not."""
    limit = 0 if error < 0 else np.iinfo(np.uint64).max if error >= 2.0**64 else int(error)
    flat, others = values.reshape(-1), decoded.reshape(-1)
    mask = None if counted is None else counted.reshape(-1)
    for piece in pieces(flat.size):
        value, other = flat[piece], others[piece]
        if value.dtype.itemsize < 8:
            value, other = value.astype(np.int64), other.astype(np.int64)
        # A signed difference may overflow; read as an unsigned number it is right again.
        difference = np.where(value > other, value - other, other - value).astype(np.uint64)
        near = difference <= np.uint64(limit)
        if not bool(np.all(near if mask is None else near | ~mask[piece])):
            return False
    return True


def residual_of(
    values: Values, base: Values, counted: Mask | None, quantum: float, largest: int
) -> tuple[Integers, int] | None:
    """The residual, and how many of its integers are not 0.

    The residual of a value is the number of quanta to add to `base` where |value - base| exceeds
    half a quantum, and 0 elsewhere. The result is None where an integer would exceed `largest`.

    Args:
        values: values of any real type.
        base: decoded values without a residual, float32 or float64, of the same shape.
        counted: the values that need the residual; None for all.
        quantum: step of the residual, in units of the values.
        largest: largest magnitude of an integer.
    """
    residual = np.zeros(values.shape, np.int32)
    if values.dtype not in _NATIVE_TYPES:
        values = values.astype(np.float64)
    nonzero = int(
        _native("residual", values.dtype, base.dtype)(
            *_pointers(values, base, counted),
            values.size,
            quantum,
            largest,
            *_pointers(residual),
        )
    )
    return None if nonzero < 0 else (residual, nonzero)


def corrected(
    base: Values, residual: Integers | None, quantum: float, dtype: np.dtype[Any]
) -> Values:
    """`base` plus its residual, computed in float64 and cast to `dtype`.

    The result may be `base` itself where there is no residual and nothing to cast.

    Args:
        base: decoded values, float32 or float64.
        residual: quanta to add, of the same shape; None for none.
        quantum: step of the residual, in units of the values.
        dtype: type of the result.
    """
    if residual is None:
        return base if base.dtype == dtype else cast(base, dtype)
    kind = dtype if dtype in _NATIVE_TYPES else np.dtype(np.float64)
    result = np.empty(base.shape, kind)
    _native("correct", base.dtype, kind)(
        *_pointers(base, residual),
        base.size,
        quantum,
        *_pointers(result),
    )
    return result if kind == dtype else cast(result, dtype)


def clip_shifted(values: Values, center: float, low: float, high: float) -> Values:
    """values + center, clipped to [low, high], in place; NaN stays.

    `center`, `low` and `high` are first rounded to the type of the values.
    """
    assert values.flags.c_contiguous, "they are changed in place"
    _native("clip", values.dtype)(
        *_pointers(values),
        values.size,
        *(center, low, high),
    )
    return values


def clipped(values: Values, low: float, high: float) -> Values:
    """Values clipped to [low, high] in their own type, in place; NaN and signs of zeros stay.

    `low` and `high` are first rounded to the type of the values, as by `cast`; an int is exact in
    an integer type.
    """
    ends = [_end(end, values.dtype) for end in (low, high)]
    flat = values.reshape(-1) if values.flags.c_contiguous else values
    for part in (flat[piece] for piece in pieces(flat.shape[0])):
        # Comparisons say which values change: numpy's clip may change the sign of a zero.
        np.copyto(part, ends[0], where=part < ends[0])
        np.copyto(part, ends[1], where=part > ends[1])
    return values


def _end(end: float, dtype: np.dtype[Any]) -> Any:
    """An end of a range in a type."""
    if isinstance(end, int) and dtype.kind != "f":
        limits = np.iinfo(dtype)
        return dtype.type(min(max(end, limits.min), limits.max))
    return cast(np.array([float(end)]), dtype)[0]


def free_values(
    target: Values, rebuilt: Values, counted: Mask | None, low: float, high: float
) -> int:
    """Copy `rebuilt` into `target` wherever a value is free, and return how many are free.

    A value is free where it is not counted, and where it lies at or beyond `low` or `high` and its
    rebuilt value lies still farther out: the decoder clips it.

    Args:
        target: values to code, C-contiguous; changed in place.
        rebuilt: what they decode to, of the same shape and type.
        counted: the values that must be kept; None for all.
        low: lower end of the range.
        high: upper end of the range.
    """
    assert target.flags.c_contiguous, "it is changed in place"
    return int(
        _native("free", target.dtype)(
            *_pointers(target, rebuilt, counted),
            target.size,
            low,
            high,
        )
    )


def _native(name: str, *types: np.dtype[Any]) -> Any:
    """The native function for arrays of these types, each float32 or float64."""
    ends = [_NATIVE_TYPES[kind] for kind in types]
    return getattr(library(), "_".join(["fhash", name, *ends]))


def _pointers(*arrays: Values | None) -> list[Any]:
    """Pointers to C-ordered arrays, or to the C-ordered copies of them."""
    return [pointer(None if array is None else np.ascontiguousarray(array)) for array in arrays]
