"""Range, sum and squared errors of many values, native (fhash_codec/native/quality.cpp) or in numpy with the same bits.

Both add in one stated order, because what is measured steers the encoder, whose bytes must not depend on the machine: value i of a piece
of PIECE values goes to lane i % LANES; each lane is added up in order, then the lanes, then the pieces.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec import native
from fhash_codec.measure.value_range import pieces

__all__ = ["Values", "range_and_sum", "squared_errors"]

Values = npt.NDArray[Any]
Mask = npt.NDArray[np.bool_]
Doubles = npt.NDArray[np.float64]

LANES, PIECE = 256, 1 << 14


def range_and_sum(values: Values, factor: float = 1.0) -> tuple[int, float, float, float]:
    """Number, least, greatest (inf and -inf if there is none) and sum times a factor of the finite ones of float32 or float64 values.

    Zeros come without a sign, since which of two zeros is the least is nobody's order. A sum beyond float64 is infinite.
    """
    flat = np.ascontiguousarray(values).reshape(-1)
    library = native.library()
    if library is not None:
        count, low, high, total = _call(
            library, "scan", flat, ctypes.c_int64(flat.size), factor, results=3
        )
        return count, low + 0.0, high + 0.0, total
    count, low, high, total = 0, np.inf, -np.inf, 0.0
    for start in range(0, flat.size, PIECE):
        part = flat[start : start + PIECE]
        finite = np.isfinite(part)
        chosen = part[finite]
        if chosen.size:
            count += chosen.size
            low, high = min(low, float(chosen.min())), max(high, float(chosen.max()))
        with np.errstate(over="ignore"):
            total += _lane_sum(np.where(finite, part, 0).astype(np.float64) * factor)
    return count, low + 0.0, high + 0.0, total


def squared_errors(
    original: Values, decoded: Values, mask: Mask | None, scale: float
) -> tuple[int, float, float]:
    """Number, sum of squares and largest magnitude of (original - decoded) * scale, in float64.

    Arrays of one shape and any real type; counted are those with a finite original where the mask is set (None: everywhere). The number is
    -1 where a decoded value that counts is not finite. 64-bit integers are compared exactly, where float64 would round differences to 0.
    """
    library = native.library()
    if (
        library is not None
        and original.dtype == decoded.dtype
        and original.dtype in (np.float32, np.float64)
    ):
        one, other = np.ascontiguousarray(original), np.ascontiguousarray(decoded)
        counted = None if mask is None else np.ascontiguousarray(mask, dtype=np.bool_)
        pointers = _pointer(other), _pointer(counted)
        return _call(library, "errors", one, *pointers, ctypes.c_int64(one.size), scale, results=2)
    exact = original.dtype.kind in "iu" and original.dtype.itemsize == 8
    count, squares, largest = 0, 0.0, 0.0
    masks = pieces(np.broadcast_to(np.True_, original.shape) if mask is None else mask)
    for one, other, counts in zip(pieces(original), pieces(decoded), masks, strict=True):
        if library is not None and not exact:
            found = squared_errors(
                one.astype(np.float64),
                other.astype(np.float64),
                None if mask is None else counts,
                scale,
            )
        else:
            found = _squared_errors(one, other, counts, np.float64(scale))
        if found[0] < 0:
            return -1, 0.0, 0.0
        count, squares, largest = count + found[0], squares + found[1], max(largest, found[2])
    return count, squares, largest


def _call(
    library: ctypes.CDLL, name: str, values: Values, *arguments: Any, results: int
) -> tuple[Any, ...]:
    function = getattr(library, f"fhash_{name}_f{values.dtype.itemsize * 8}")
    found = (ctypes.c_double * results)()
    given = (ctypes.c_double(value) if isinstance(value, float) else value for value in arguments)
    return function(_pointer(values), *given, found), *found


def _pointer(array: Values | None) -> ctypes.c_void_p:
    return ctypes.c_void_p(None if array is None else array.ctypes.data)


def _lane_sum(values: Doubles) -> float:
    """The sum of at most PIECE values in the stated order; a running sum has one order on every machine, `sum` has not."""
    rows = np.zeros((-(-values.size // LANES), LANES))
    rows.reshape(-1)[: values.size] = values
    total = 0.0
    for lane in np.add.accumulate(rows, axis=0)[-1]:
        total += float(lane)
    return total


def _squared_errors(
    original: Values, decoded: Values, mask: Mask, scale: np.float64
) -> tuple[int, float, float]:
    count, squares, largest = 0, 0.0, 0.0
    for start in range(0, original.size, PIECE):
        part = slice(start, start + PIECE)
        counts = np.isfinite(original[part]) & mask[part]
        difference = np.where(counts, _scaled_difference(original[part], decoded[part], scale), 0.0)
        if not np.isfinite(difference).all():
            return -1, 0.0, 0.0
        count += int(np.count_nonzero(counts))
        largest = max(largest, float(difference.max()), -float(difference.min()))
        with np.errstate(over="ignore"):
            squares += _lane_sum(np.square(difference))
    return count, squares, largest


def _scaled_difference(original: Values, decoded: Values, scale: np.float64) -> Doubles:
    with np.errstate(over="ignore", invalid="ignore"):
        difference = np.asarray(original * scale - decoded * scale, dtype=np.float64)
    if original.dtype.kind in "iu" and original.dtype.itemsize == 8:
        limits = np.iinfo(original.dtype)
        whole = np.clip(
            np.rint(decoded.astype(np.float64)),
            float(limits.min),
            np.nextafter(float(limits.max), 0.0),
        )
        # Differences wrap at 2^64; those beyond 2^62 do not need the exactness.
        exact = (original - whole.astype(original.dtype)).view(np.int64) - (
            decoded.astype(np.float64) - whole
        )
        difference = np.where(np.abs(difference) < 2.0**62 * scale, exact * scale, difference)
    return difference
