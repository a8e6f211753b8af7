"""Passes over the values of a tile, element by element: bounds, residuals, casts. Native for float32 and float64, else portable.

Tiles are large and these passes simple, so they wait for memory: the native ones go over it once, the portable ones piece by piece, so that
what they compute on the way stays in the cache. Both give the same bits.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats import native

__all__ = [
    "all_finite",
    "cast",
    "clip_shifted",
    "corrected",
    "free_values",
    "pieces",
    "residual_of",
    "within",
]

Values = npt.NDArray[Any]
Mask = npt.NDArray[np.bool_]
Integers = npt.NDArray[np.int32]

PIECE = 1 << 14
_NAMES = {np.dtype(np.float32): "f32", np.dtype(np.float64): "f64"}


def all_finite(values: Values) -> bool:
    """Whether no value of any real type is NaN or infinite."""
    if values.dtype.kind != "f":
        return True
    flat = values.reshape(-1)
    return all(bool(np.isfinite(flat[piece]).all()) for piece in pieces(flat.size))


def within(values: Values, decoded: Values, error: float, counts: Mask | None = None) -> bool:
    """Whether |decoded - value| <= error wherever it counts, without rounding in favour of the answer."""
    function = _native("within", values.dtype) if values.dtype == decoded.dtype else None
    if function is not None:
        return bool(
            function(
                *_pointers(values, decoded, counts),
                ctypes.c_int64(values.size),
                ctypes.c_double(error),
            )
        )
    one, other, marks = (
        values.reshape(-1),
        decoded.reshape(-1),
        None if counts is None else counts.reshape(-1),
    )
    near = _near_whole if values.dtype.kind in "iu" and values.dtype.itemsize == 8 else _near
    for piece in pieces(one.size):
        found = near(one[piece], other[piece], error)
        if not bool(np.all(found if marks is None else found | ~marks[piece])):
            return False
    return True


def _near(one: Values, other: Values, error: float) -> Mask:
    with np.errstate(all="ignore"):
        difference = np.abs(one.astype(np.float64) - other.astype(np.float64))
        # A difference of float64 numbers is rounded: the next one up is surely not too small.
        found: Mask = (
            (one == other)
            | (np.nextafter(difference, np.inf) <= error)
            | ((one.dtype.itemsize < 8) & (difference <= error))
        )
    return found


def _near_whole(one: Values, other: Values, error: float) -> Mask:
    most = 0 if error < 0 else np.iinfo(np.uint64).max if error >= 2.0**64 else int(error)
    # A signed difference may go round, and as an unsigned number it is right again.
    found: Mask = np.where(one > other, one - other, other - one).astype(np.uint64) <= np.uint64(
        most
    )
    return found


def residual_of(
    values: Values, base: Values, counts: Mask | None, quantum: float, largest: int
) -> tuple[Integers, int] | None:
    """Whole quanta to add to `base` where the error is too large, and how many are not 0; None where one would be above `largest`.

    values: of any real type. base: float32 or float64. counts: where the error matters; None for everywhere.
    """
    result = np.zeros(values.shape, np.int32)
    function = _native("residual", values.dtype, base.dtype)
    if function is not None:
        numbers = (ctypes.c_double(quantum), ctypes.c_double(largest))
        found = int(
            function(
                *_pointers(values, base, counts),
                ctypes.c_int64(values.size),
                *numbers,
                *_pointers(result),
            )
        )
        return None if found < 0 else (result, found)
    one, other, marks, out = (
        values.reshape(-1),
        base.reshape(-1),
        None if counts is None else counts.reshape(-1),
        result.reshape(-1),
    )
    found = 0
    for piece in pieces(one.size):
        with np.errstate(all="ignore"):
            rest = one[piece].astype(np.float64) - other[piece].astype(np.float64)
            rest = rest if marks is None else np.where(marks[piece], rest, 0.0)
            whole = np.where(np.abs(rest) > quantum / 2, np.rint(rest / quantum), 0.0)
        if not bool(np.all(np.abs(whole) <= largest)):
            return None
        out[piece] = whole
        found += int(np.count_nonzero(out[piece]))
    return result, found


def corrected(
    base: Values, residual: Integers | None, quantum: float, dtype: np.dtype[Any]
) -> Values:
    """`base` plus so many quanta, in float64, and from there to a type; may be `base` itself where nothing is to be done."""
    if residual is None:
        return base if base.dtype == dtype else cast(base, dtype)
    function = _native("correct", base.dtype, dtype)
    result = np.empty(base.shape, dtype)
    if function is not None:
        function(
            *_pointers(base, residual),
            ctypes.c_int64(base.size),
            ctypes.c_double(quantum),
            *_pointers(result),
        )
        return result
    flat, whole, out = base.reshape(-1), residual.reshape(-1), result.reshape(-1)
    for piece in pieces(flat.size):
        with np.errstate(all="ignore"):
            out[piece] = _cast(
                flat[piece].astype(np.float64) + whole[piece] * np.float64(quantum), dtype
            )
    return result


def cast(values: Values, dtype: np.dtype[Any]) -> Values:
    """Floating values as another type, rounded and clipped to whole numbers where it has only these; a new array."""
    if dtype.kind == "f":
        with np.errstate(over="ignore"):
            return values.astype(dtype)
    result = np.empty(values.shape, dtype)
    flat, out = values.reshape(-1), result.reshape(-1)
    for piece in pieces(flat.size):
        out[piece] = _cast(flat[piece], dtype)
    return result


def _cast(values: Values, dtype: np.dtype[Any]) -> Values:
    if dtype.kind == "f":
        with np.errstate(over="ignore"):
            return values.astype(dtype)
    limits = np.iinfo(dtype)
    # float64 cannot hold the largest 64-bit integers; the number below them is inside.
    low, high = float(limits.min), float(limits.max)
    high = high if int(high) <= limits.max else float(np.nextafter(high, 0.0))
    return np.clip(np.rint(np.nan_to_num(values.astype(np.float64))), low, high).astype(dtype)


def clip_shifted(values: Values, center: float, low: float, high: float) -> Values:
    """values + center within [low, high], each first rounded to the type of the values, in place; NaN stays."""
    function = _native("clip", values.dtype)
    if function is not None and values.flags.c_contiguous:
        function(
            *_pointers(values),
            ctypes.c_int64(values.size),
            *(ctypes.c_double(number) for number in (center, low, high)),
        )
        return values
    kind = values.dtype.type
    with np.errstate(all="ignore"):
        values += kind(center)
        return np.clip(values, kind(low), kind(high), out=values)


def free_values(
    target: Values, rebuilt: Values, counts: Mask | None, low: float, high: float
) -> int:
    """Put `rebuilt` into `target` wherever it may be anything, and count where that is.

    That is what does not count, and what lies at or beyond `low` or `high` and was rebuilt still farther out.
    """
    assert target.flags.c_contiguous, "it is changed in place"
    function = _native("free", target.dtype)
    if function is not None:
        numbers = (ctypes.c_int64(target.size), ctypes.c_double(low), ctypes.c_double(high))
        return int(function(*_pointers(target, rebuilt, counts), *numbers))
    kind, one, other = target.dtype.type, target.reshape(-1), rebuilt.reshape(-1)
    marks, found = None if counts is None else counts.reshape(-1), 0
    for piece in pieces(one.size):
        value, new = one[piece], other[piece]
        free = ((value <= kind(low)) & (new < value)) | ((value >= kind(high)) & (new > value))
        free = free if marks is None else free | ~marks[piece]
        value[free] = new[free]
        found += int(np.count_nonzero(free))
    return found


def pieces(size: int) -> Iterator[slice]:
    """Parts of a flat array, small enough for the cache."""
    return (slice(at, at + PIECE) for at in range(0, size, PIECE))


def _native(name: str, *types: np.dtype[Any]) -> Any:
    """The native function for arrays of these types, None where there is none."""
    library = native.library()
    if library is None or not all(kind in _NAMES for kind in types):
        return None
    function = getattr(library, "_".join(["fhash", name, *(_NAMES[kind] for kind in types)]))
    return function


def _pointers(*arrays: Values | None) -> list[ctypes.c_void_p]:
    """Each holds its array, or a copy of it in C order."""
    return [
        ctypes.c_void_p(None)
        if array is None
        else np.ascontiguousarray(array).ctypes.data_as(ctypes.c_void_p)
        for array in arrays
    ]
