"""Range, sum and squared errors of many values.

They are computed by native code (fhash_codec/native/quality.cpp); by numpy for 64-bit integers,
whose differences float64 would round. Both add in one fixed order: value i of a piece of PIECE
values goes to lane i % LANES, and each lane is summed in order, then the lanes, then the pieces.
The order is fixed because these figures steer the encoder, and its bytes must not depend on the
machine.
"""

from __future__ import annotations

import ctypes
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fhash_codec import native
from fhash_codec.measure.value_range import pieces
from fhash_formats.support.number_types import is_wide_integer

__all__ = ["ErrorSums", "Values", "error_sums", "histogram", "range_and_sum", "squared_errors"]

Values = npt.NDArray[Any]
Mask = npt.NDArray[np.bool_]
Doubles = npt.NDArray[np.float64]

LANES = 256
"""Sums that run side by side."""

PIECE = 1 << 14
"""Values that are summed in lanes before the lanes are added up."""


class ErrorSums(NamedTuple):
    """Sums over the scaled differences of counted vertices, all of them and those of the bulk."""

    number: int
    """Number of counted vertices."""
    squares: float
    """Sum of the squares."""
    largest: float
    """Largest magnitude."""
    bulk_count: int = 0
    """Number of counted vertices whose original value lies in the bulk."""
    bulk_squares: float = 0.0
    """Sum of their squares."""


def range_and_sum(values: Values, factor: float = 1.0) -> tuple[int, float, float, float]:
    """Number, minimum, maximum and sum of the finite values of a float32 or float64 array.

    Without a finite value, the minimum is inf and the maximum -inf. Zeros are returned without a
    sign, since no order decides between 0.0 and -0.0. Each value is multiplied by `factor` before
    it is added to the sum. A sum beyond float64 is infinite.
    """
    flat = np.ascontiguousarray(values).reshape(-1)
    count, low, high, total = _call("scan", flat, ctypes.c_int64(flat.size), factor, results=3)
    return count, low + 0.0, high + 0.0, total


def squared_errors(
    original: Values, decoded: Values, mask: Mask | None, scale: float
) -> tuple[int, float, float]:
    """Number, sum of squares and largest magnitude of (original - decoded) * scale, in float64.

    Parameters and results are those of `error_sums` without a bulk.
    """
    return error_sums(original, decoded, mask, scale)[:3]


def error_sums(
    original: Values,
    decoded: Values,
    mask: Mask | None,
    scale: float,
    bulk: tuple[float, float] | None = None,
) -> ErrorSums:
    """Sums over (original - decoded) * scale, in float64.

    original, decoded: arrays of one shape and any real type.
    mask: of the same shape; all True if None. A vertex is counted if the mask is True and its
        original value is finite.
    scale: a power of two.
    bulk: the original values, both ends included, that are summed once more; none if None.

    The number is -1 if a decoded value is not finite at a counted vertex. 64-bit integers are
    compared exactly; float64 would round their differences to 0.
    """
    if original.dtype == decoded.dtype and original.dtype in (np.float32, np.float64):
        return _native_sums(original, decoded, mask, scale, bulk)
    exact = is_wide_integer(original.dtype)
    total = ErrorSums(0, 0.0, 0.0)
    masks = pieces(np.broadcast_to(np.True_, original.shape) if mask is None else mask)
    for source, result, counted in zip(pieces(original), pieces(decoded), masks, strict=True):
        if not exact:
            sums = error_sums(
                source.astype(np.float64),
                result.astype(np.float64),
                None if mask is None else counted,
                scale,
                bulk,
            )
        else:
            sums = _numpy_sums(source, result, counted, np.float64(scale), bulk)
        if sums.number < 0:
            return sums
        total = _joined(total, sums)
    return total


def histogram(
    values: Values, counts: npt.NDArray[np.int64], *, scale: float, low: float, factor: float
) -> None:
    """Add the finite values of an array of any shape and real type to a histogram.

    A value goes to bin (value * scale - low) * factor of `counts`, rounded down, and a value beyond
    either end to the bin there: so the order of the values stays. Computed in float64.
    """
    native_type = values.dtype in (np.float32, np.float64)
    for piece in pieces(values):
        wide = np.ascontiguousarray(piece if native_type else piece.astype(np.float64))
        function = getattr(native.library(), f"fhash_histogram_f{wide.dtype.itemsize * 8}")
        numbers = (ctypes.c_double(number) for number in (scale, low, factor))
        size, bins = ctypes.c_int64(wide.size), ctypes.c_int64(counts.size)
        function(_pointer(wide), size, *numbers, bins, _pointer(counts))


def _native_sums(
    original: Values,
    decoded: Values,
    mask: Mask | None,
    scale: float,
    bulk: tuple[float, float] | None,
) -> ErrorSums:
    """`error_sums` of arrays of one type, float32 or float64."""
    original, decoded = np.ascontiguousarray(original), np.ascontiguousarray(decoded)
    mask = None if mask is None else np.ascontiguousarray(mask, dtype=np.bool_)
    size = ctypes.c_int64(original.size)
    arguments = (original, _pointer(decoded), _pointer(mask), size, float(scale))
    if bulk is None:
        return ErrorSums(*_call("errors", *arguments, results=2))
    low, high = map(float, bulk)
    count, squares, largest, bulk_squares, bulk_count = _call(
        "bulk_errors", *arguments, low, high, results=4
    )
    if count < 0:
        return ErrorSums(-1, 0.0, 0.0)
    return ErrorSums(count, squares, largest, int(bulk_count), bulk_squares)


def _joined(first: ErrorSums, second: ErrorSums) -> ErrorSums:
    """The sums over two arrays."""
    return ErrorSums(
        number=first.number + second.number,
        squares=first.squares + second.squares,
        largest=max(first.largest, second.largest),
        bulk_count=first.bulk_count + second.bulk_count,
        bulk_squares=first.bulk_squares + second.bulk_squares,
    )


def _call(name: str, values: Values, *arguments: Any, results: int) -> tuple[Any, ...]:
    """The count that a native function returns, and the `results` numbers that it writes.

    name: `scan`, `errors` or `bulk_errors`; the function of the type of the values is called.
    """
    function = getattr(native.library(), f"fhash_{name}_f{values.dtype.itemsize * 8}")
    output = (ctypes.c_double * results)()
    numbers = (ctypes.c_double(value) if isinstance(value, float) else value for value in arguments)
    return function(_pointer(values), *numbers, output), *output


def _pointer(array: Values | None) -> ctypes.c_void_p:
    return ctypes.c_void_p(None if array is None else array.ctypes.data)


def _lane_sum(values: Doubles) -> float:
    """The sum of at most PIECE values in the fixed order.

    A running sum adds in one order on every machine; `np.sum` does not.
    """
    rows = np.zeros((-(-values.size // LANES), LANES))
    rows.reshape(-1)[: values.size] = values
    total = 0.0
    for lane in np.add.accumulate(rows, axis=0)[-1]:
        total += float(lane)
    return total


def _numpy_sums(
    original: Values,
    decoded: Values,
    mask: Mask,
    scale: np.float64,
    bulk: tuple[float, float] | None,
) -> ErrorSums:
    """`error_sums` of one-dimensional arrays of 64-bit integers."""
    total = ErrorSums(0, 0.0, 0.0)
    for start in range(0, original.size, PIECE):
        piece = slice(start, start + PIECE)
        counted = np.isfinite(original[piece]) & mask[piece]
        errors = _scaled_difference(original[piece], decoded[piece], scale)
        difference = np.where(counted, errors, 0.0)
        if not np.isfinite(difference).all():
            return ErrorSums(-1, 0.0, 0.0)
        with np.errstate(over="ignore"):
            squares = np.square(difference)
            sums = ErrorSums(
                number=int(np.count_nonzero(counted)),
                squares=_lane_sum(squares),
                largest=max(float(difference.max()), -float(difference.min())),
            )
            if bulk is not None:
                values = original[piece].astype(np.float64)
                inside = counted & (values >= bulk[0]) & (values <= bulk[1])
                sums = sums._replace(
                    bulk_count=int(np.count_nonzero(inside)),
                    bulk_squares=_lane_sum(np.where(inside, squares, 0.0)),
                )
            total = _joined(total, sums)
    return total


def _scaled_difference(original: Values, decoded: Values, scale: np.float64) -> Doubles:
    """(original - decoded) * scale; exact for 64-bit integers."""
    with np.errstate(over="ignore", invalid="ignore"):
        difference = np.asarray(original * scale - decoded * scale, dtype=np.float64)
    if is_wide_integer(original.dtype):
        limits = np.iinfo(original.dtype)
        nearest = np.clip(
            np.rint(np.nan_to_num(decoded.astype(np.float64))),
            float(limits.min),
            np.nextafter(float(limits.max), 0.0),
        )
        if decoded.dtype == original.dtype:
            nearest = decoded
        # Integer differences wrap at 2^64; differences beyond 2^62 do not need to be exact.
        exact = (original - nearest.astype(original.dtype)).view(np.int64) - (
            0.0 if nearest is decoded else decoded.astype(np.float64) - nearest
        )
        difference = np.where(np.abs(difference) < 2.0**62 * scale, exact * scale, difference)
    return difference
