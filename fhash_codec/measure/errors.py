"""Sums over errors, and the errors that follow from them, at vertices and in bulk."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from threading import Lock
from typing import Annotated, Any, NamedTuple, TypedDict

import numpy as np
import numpy.typing as npt

from fhash_codec import native
from fhash_codec.measure.value_range import Ranks, ValueRange, pieces, power_of_two
from fhash_codec.native import pointer
from fhash_formats.errors import InputError
from fhash_formats.support.threads import in_threads, usable_threads
from fhash_formats.support.values import Double, Mask, Values, exact_number, is_wide_integer

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

    @classmethod
    def of(cls, numbers: Double) -> ErrorSums:
        """The sums of a row of `step_sums`."""
        number, squares, largest, bulk_count, bulk_squares = numbers.tolist()
        return cls(int(number), squares, largest, int(bulk_count), bulk_squares)


def range_and_sum(values: Values, factor: float = 1.0) -> tuple[int, float, float, float]:
    """The figures of `row_sums` of a whole array of any shape."""
    ((count, low, high, total),) = row_sums(values.reshape(1, -1), factor).tolist()
    return int(count), low, high, total


def row_sums(rows: Values, factor: float = 1.0) -> Double:
    """Number, minimum, maximum and sum (rows, 4) of the finite values of each of some rows.

    Without a finite value, the minimum is inf and the maximum -inf. Zeros are returned without a
    sign, since no order decides between 0.0 and -0.0. Each value is multiplied by `factor` before
    it is added to the sum. A sum beyond float64 is infinite.

    rows: float32 or float64 (rows, values).
    """
    result = np.empty((len(rows), 4))
    _call("scan", np.ascontiguousarray(rows), *rows.shape, float(factor), pointer(result))
    result[:, 1:3] += 0.0
    return result


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
    if _is_native(original, decoded):
        whole = None if mask is None else mask[None]
        return ErrorSums.of(_native_sums(original[None], decoded[None], whole, scale, bulk)[0])
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


def step_sums(
    original: Values,
    decoded: Values,
    mask: Mask | None,
    scale: float,
    bulk: tuple[float, float] | None = None,
) -> Double:
    """The `error_sums` of each step of arrays (t, z, y, x): float64 (t, 5)."""
    if not is_wide_integer(original.dtype) and len(original) > 1:
        # small frames: the copies take little
        wide = np.result_type(original.dtype, decoded.dtype, np.float32)
        original, decoded = (each.astype(wide, copy=False) for each in (original, decoded))
    if _is_native(original, decoded):
        return _native_sums(original, decoded, mask, scale, bulk)
    masks = [None] * len(original) if mask is None else mask
    steps = zip(original, decoded, masks, strict=True)
    return np.array([error_sums(*step, scale, bulk) for step in steps], dtype=np.float64)


def _is_native(original: Values, decoded: Values) -> bool:
    """Whether native code compares arrays of these types."""
    return original.dtype == decoded.dtype and original.dtype in (np.float32, np.float64)


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
        numbers = (wide.size, scale, low, factor, counts.size)
        function(pointer(wide), *numbers, pointer(counts))


def _native_sums(
    original: Values,
    decoded: Values,
    mask: Mask | None,
    scale: float,
    bulk: tuple[float, float] | None,
) -> Double:
    """`step_sums` of arrays (t, ...) of one type, float32 or float64."""
    original, decoded = np.ascontiguousarray(original), np.ascontiguousarray(decoded)
    mask = None if mask is None else np.ascontiguousarray(mask, dtype=np.bool_)
    result = np.zeros((len(original), len(ErrorSums._fields)))
    low, high = (1.0, 0.0) if bulk is None else bulk
    size = original.size // max(len(original), 1)
    arrays = (pointer(decoded), pointer(mask), len(original), size)
    _call("errors", original, *arrays, float(scale), float(low), float(high), pointer(result))
    return result


def _joined(first: ErrorSums, second: ErrorSums) -> ErrorSums:
    """The sums over two arrays."""
    return ErrorSums(
        number=first.number + second.number,
        squares=first.squares + second.squares,
        largest=max(first.largest, second.largest),
        bulk_count=first.bulk_count + second.bulk_count,
        bulk_squares=first.bulk_squares + second.bulk_squares,
    )


def _call(name: str, values: Values, *arguments: Any) -> None:
    """Call the native function of a name for the type of the values, which it gets first."""
    function = getattr(native.library(), f"fhash_{name}_f{values.dtype.itemsize * 8}")
    function(pointer(values), *arguments)


def _lane_sum(values: Double) -> float:
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


def _scaled_difference(original: Values, decoded: Values, scale: np.float64) -> Double:
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


class StepErrors(TypedDict):
    """Figures of a step; null if no vertex is counted, the PSNR also if the error or range is 0."""

    step: Annotated[int, "index of the step"]
    psnr: Annotated[float | None, "in dB"]
    rmse: Annotated[float | None, "in data units"]
    max_abs_error: Annotated[float | None, "in data units"]


@dataclass(frozen=True, kw_only=True)
class BulkQuality:
    """Figures over the counted vertices whose original value lies in the bulk of the series."""

    psnr: Annotated[float | None, "dB, relative to the width of the bulk; null if the error is 0"]
    rmse: Annotated[float | None, "in data units; null if no such vertex is counted"]
    range: Annotated[tuple[float, float], "first and last value of the bulk, in data units"]


class Errors:
    """Squared and largest differences over frames.

    Differences are computed after scaling by an exact power of two near the range, so that neither
    huge nor tiny ranges overflow or underflow.

    Attributes:
        data_range: of the original series, in data units; inf is allowed and makes PSNR None.
        bulk: of the original series, in data units; None without one.
        sums: `step_sums` of all steps, in the arrays in which they came.
    """

    def __init__(
        self, data_range: float, bulk: ValueRange | None = None, scale: float | None = None
    ) -> None:
        """Begin without frames; raises InputError for a range below 0 or NaN.

        scale: power of two by which differences are multiplied, if not that of the range.
        """
        if not data_range >= 0:
            raise InputError(f"data range is {data_range}; 0 or more is needed")
        self.data_range = data_range
        self.bulk = bulk
        self.sums: list[Double] = []
        self._scale = scale or power_of_two(min(data_range, sys.float_info.max))
        self._sums = ErrorSums(0, 0.0, 0.0)

    def add(self, step: int, original: Values, decoded: Values, mask: Mask | None = None) -> None:
        """Compare a frame.

        mask: vertices to be compared, all if None. The three arrays have one shape. Raises
        InputError for different shapes, and for a decoded value that is not finite at a vertex that
        is compared.
        """
        if original.shape != decoded.shape or (mask is not None and mask.shape != original.shape):
            raise InputError(
                f"step {step}: the original is {original.shape}, the decoded {decoded.shape}; "
                "they must be of one shape"
            )
        whole = None if mask is None else mask[None]
        self.take(self.compare(step, original[None], decoded[None], whole))

    def compare(
        self, first: int, original: Values, decoded: Values, mask: Mask | None = None
    ) -> Double:
        """The scaled differences of frames (t, z, y, x) of one shape, for `take`: (t, 5).

        first: step of the first of them. Other parameters and errors as in `add`.
        """
        bulk = None if self.bulk is None else (self.bulk.low, self.bulk.high)
        errors = step_sums(original, decoded, mask, self._scale, bulk)
        for place in np.flatnonzero(errors[:, 0] < 0):
            step = first + int(place)
            raise InputError(f"step {step}: decoded values are not finite where they are compared")
        return errors

    def take(self, errors: Double) -> None:
        """Add the differences of the next steps."""
        self.sums.append(errors)
        both = np.vstack([self._sums, errors])
        with np.errstate(over="ignore"):
            # A running sum adds one step after the other, whatever steps come together.
            sums = ErrorSums.of(np.add.accumulate(both)[-1])
        self._sums = sums._replace(largest=float(both[:, 2].max()))

    def per_step(self) -> list[StepErrors]:
        """Figures of each step."""
        sums = (row for errors in self.sums for row in errors[:, :3].tolist())
        return [
            {
                "step": step,
                "psnr": self._psnr(squares, count),
                "rmse": self._rmse(squares, count),
                "max_abs_error": self._unscaled(largest, count),
            }
            for step, (count, squares, largest) in enumerate(sums)
        ]

    @property
    def count(self) -> int:
        """Vertices compared so far."""
        return self._sums.number

    @property
    def rmse(self) -> float | None:
        """Root of the mean squared difference over all frames, in data units."""
        return self._rmse(self._sums.squares, self.count)

    @property
    def psnr(self) -> float | None:
        """PSNR over all frames, in dB."""
        return self._psnr(self._sums.squares, self.count)

    @property
    def max_abs_error(self) -> float | None:
        """The largest difference over all frames, in data units."""
        return self._unscaled(self._sums.largest, self.count)

    def bulk_quality(self) -> BulkQuality | None:
        """The figures of the bulk over all frames; None without a bulk."""
        if self.bulk is None:
            return None
        squares, count = self._sums.bulk_squares, self._sums.bulk_count
        width = (self.bulk.high - self.bulk.low) * self._scale
        return BulkQuality(
            psnr=psnr(width, math.sqrt(squares / count) if count else None),
            rmse=self._rmse(squares, count),
            range=(self.bulk.low, self.bulk.high),
        )

    def _psnr(self, squares: float, count: float) -> float | None:
        # In scaled units: in data units, a mean of denormals would be rounded to a denormal.
        return psnr(self.data_range * self._scale, math.sqrt(squares / count) if count else None)

    def _rmse(self, squares: float, count: float) -> float | None:
        return self._unscaled(math.sqrt(squares / count) if count else 0.0, count)

    def _unscaled(self, value: float, count: float) -> float | None:
        figure = float(value) / float(self._scale)
        return figure if count and math.isfinite(figure) else None


def psnr(data_range: float, rmse: float | None) -> float | None:
    """20 log10(data_range / rmse) in dB; None if either is 0, None or not finite."""
    if rmse is None or not (0 < rmse < math.inf and 0 < data_range < math.inf):
        return None
    return 20 * (math.log10(data_range) - math.log10(rmse))


ONE_IN = 100
"""Values of which one is left out at either end of the bulk."""
BINS = 1 << 16
"""Bins of the histogram that the ends of the bulk are found by."""
MIN_BINS = 1 << 10
"""Bins that the bulk must span at least: its width is then known to 0.2 %, or 0.02 dB."""
PASSES = 2
"""Histograms that are made at most, the second of the bins that the first found."""
DIGITS = 3
"""Decimal digits of the width to which both ends are rounded outwards."""
MIN_SHARE = 0.01
"""Share of the range of the series that a wide bulk spans at least."""

Passes = Callable[[], Iterable[Values]]
"""Function that gives all counted values of a series, in arrays of any shape, once a call."""


def find_bulk(passes: Passes, value_range: ValueRange, *, whole: bool = False) -> ValueRange | None:
    """The bulk: the range from the 1st to the 99th percentile of the finite values of a series.

    passes: called once or twice; memory is bounded by one of its arrays for each thread.
    value_range: of the series, in data units.
    whole: whether the values are whole numbers, as the ends of the bulk then are.

    Both ends are found to 1/1000 of the width and rounded outwards; the result does not depend on
    the order of the values. None where the bulk has no width, or less than 2^-21 of the range: at
    least 98 % of the values are then the same, or there are none.
    """
    scale = value_range.scale
    low, high = value_range.low * scale, value_range.high * scale
    for _ in range(PASSES):
        width = (high - low) / BINS
        if not 0 < width < math.inf or not math.isfinite(BINS / (high - low)):
            return None
        share = (iter(passes()), Lock(), scale, low, BINS / (high - low))
        counts = in_threads(lambda each: _counts(*each), [share] * usable_threads())
        first, last = _ends(sum(counts, np.zeros(BINS, np.int64)))
        # A thousandth of a bin more than the bins span, for the rounding of the bins themselves.
        low, high = low + (first - 0.001) * width, low + (last + 1.001) * width
        if last + 1 - first >= MIN_BINS or (whole and width < 0.5):
            return _rounded(low / scale, high / scale, value_range, whole=whole)
    return None


def _counts(
    arrays: Iterator[Values], lock: Lock, scale: float, low: float, factor: float
) -> npt.NDArray[np.int64]:
    """The histogram of the arrays that no other thread takes; see `histogram`."""
    counts = np.zeros(BINS, np.int64)
    while True:
        with lock:
            values = next(arrays, None)
        if values is None:
            return counts
        histogram(values, counts, scale=scale, low=low, factor=factor)


def bulk_of_ranks(
    ranks: Ranks, value_range: ValueRange, *, whole: bool = False
) -> ValueRange | None:
    """The bulk of values whose ranks were taken in one pass; arguments as in `find_bulk`.

    At least 98 % of the values lie in it, and at most another 3 errors of `ranks`, which are below
    1/10,000 of the values. The ends are rounded outwards to 1/1000 of the width.
    """
    width = value_range.high - value_range.low
    if not ranks.count or not math.isfinite(width):
        return None
    low, high = ranks.middle((ranks.count - 1) // ONE_IN)
    low, high = max(low, value_range.low), min(high, value_range.high)
    if not high - low >= width / (BINS * BINS / (2 * MIN_BINS)):
        return None
    return _rounded(low, high, value_range, whole=whole)


def is_wide(bulk: ValueRange, value_range: ValueRange) -> bool:
    """Whether a bulk spans at least MIN_SHARE of the range of the series."""
    return bulk.high - bulk.low >= MIN_SHARE * (value_range.high - value_range.low)


def whole_psnr(psnr: float, bulk: ValueRange, data_range: float) -> float:
    """The PSNR (dB) over the range of a series with the same RMSE as a PSNR over its bulk.

    data_range: of the series, in data units, more than 0.
    """
    return psnr + 20 * (math.log10(data_range) - math.log10(bulk.high - bulk.low))


def _ends(counts: npt.NDArray[np.int64]) -> tuple[int, int]:
    """Bins of the 1st and the 99th percentile, by the nearest ranks outside."""
    so_far = np.cumsum(counts)
    total = int(so_far[-1])
    beyond = max(total - 1, 0) // ONE_IN
    ranks = (beyond, max(total - 1, 0) - beyond)
    first, last = np.searchsorted(so_far, ranks, side="right")
    return int(first), min(int(last), BINS - 1)


def _rounded(low: float, high: float, limits: ValueRange, *, whole: bool) -> ValueRange | None:
    """The ends as short decimals, rounded outwards within the limits; whole ones inwards.

    None if no width is left.
    """
    low, high = max(low, limits.low), min(high, limits.high)
    if not 0 < high - low < math.inf:
        return None
    if whole:
        # The ends lie less than one bin outside of the whole numbers that they stand for.
        low, high = math.ceil(low), math.floor(high)
    else:
        exact = Context(prec=700)
        unit = Decimal(1).scaleb(math.floor(math.log10(high - low)) - DIGITS)
        low = float(Decimal(low).quantize(unit, ROUND_FLOOR, exact))
        high = float(Decimal(high).quantize(unit, ROUND_CEILING, exact))
    low, high = max(exact_number(low), limits.low), min(exact_number(high), limits.high)
    return ValueRange(low, high) if math.isfinite(high - low) and high > low else None
