"""The first pass over a series: its range, its mean, and its missing values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.extremes import Extremes
from fhash_codec.measure.ranks import Ranks, RanksSpan
from fhash_codec.measure.sums import range_and_sum
from fhash_codec.measure.value_range import Mean, ValueRange, pieces, power_of_two
from fhash_codec.progress import Progress
from fhash_formats.errors import InputError
from fhash_formats.series import Series, warn_defaults
from fhash_formats.support.number_types import exact_number


@dataclass(frozen=True, kw_only=True)
class Scan:
    """Figures of the finite values of all steps of a series.

    Attributes:
        value_range: of the finite values, in data units.
        mean: of the finite values, in data units, within the range.
        finite_count: number of finite values.
        missing: masks of the steps that have NaN or infinite values: one bit per vertex,
            1 = missing, np.packbits of the frame in C order.
    """

    value_range: ValueRange
    mean: float
    finite_count: int
    missing: Mapping[int, npt.NDArray[np.uint8]]

    def finite(self, step: int, shape: tuple[int, int, int]) -> npt.NDArray[np.bool_] | None:
        """Mask (z, y, x) of the finite vertices of a step; None if all are finite.

        shape: of a frame.
        """
        return finite_mask(self.missing, step, shape)


def finite_mask(
    missing: Mapping[int, npt.NDArray[np.uint8]], step: int, shape: tuple[int, int, int]
) -> npt.NDArray[np.bool_] | None:
    """The mask of `Scan.finite`, from `Scan.missing`."""
    if step not in missing:
        return None
    bits = np.unpackbits(missing[step], count=prod(shape)).view(np.bool_)
    return ~bits.reshape(shape)


def scan(series: Series, progress: Progress, ranks: Ranks | None = None) -> Scan:
    """Scan every frame once.

    ranks: gets all finite values.

    Raises InputError if no value at all is finite, if an extreme value looks like a fill value that
    nobody declared (extremes.py), or if the series changed. Progress stage: "scanning".
    """
    low, high, mean = np.inf, -np.inf, Mean()
    extremes = Extremes(series.dtype, series.unlikely)
    missing: dict[int, npt.NDArray[np.uint8]] = {}
    last_bits: npt.NDArray[np.uint8] | None = None
    steps = series.shape[0]
    for step, frame in enumerate(series.frames()):
        count = 0
        for piece in pieces(frame):
            piece_count, piece_low, piece_high = scan_piece(piece, mean)
            extremes.add(piece, piece_count, piece_low, piece_high)
            if ranks is not None:
                ranks.add(piece)
            count, low, high = count + piece_count, min(low, piece_low), max(high, piece_high)
        if count < frame.size:
            missing[step] = last_bits = _missing_bits(frame, last_bits)
        progress("scanning", step + 1, steps, "")
    series.check()
    if mean.count == 0:
        raise InputError(
            f"{series.source}: '{series.name}' has no finite value in any of its {steps} steps; "
            "there is nothing to encode"
        )
    extremes.refuse(series)
    warn_defaults(series)
    return _scan_of(low, high, mean, missing)


class SpanScan:
    """A scan of neighbouring steps without missing values; spans join to the scan of a series.

    Another machine may make it. Attributes:
        has_missing: whether a value is missing; nothing else counts then.
        ranks: of the values.
    """

    def __init__(self, series: Series, steps: range) -> None:
        """Scan some steps."""
        self._low, self._high, self._mean = np.inf, -np.inf, Mean()
        self._extremes = Extremes(series.dtype, series.unlikely)
        self.ranks = RanksSpan(steps.start * prod(series.shape[1:]))
        self.has_missing = False
        for step in steps:
            frame = series.read(step)
            for piece in pieces(frame):
                count, low, high = scan_piece(piece, self._mean)
                self.has_missing |= count < piece.size
                if self.has_missing:
                    self.ranks = RanksSpan(0)
                    return
                self._extremes.add(piece, count, low, high)
                self._low, self._high = min(self._low, low), max(self._high, high)
            self.ranks.add(frame)

    @staticmethod
    def joined(series: Series, spans: Iterable[SpanScan]) -> tuple[Scan, Ranks] | None:
        """The scan of a series and its ranks, from spans of all steps in their order.

        None where a value is missing. Raises InputError as `scan` does.
        """
        low, high, mean, ranks = np.inf, -np.inf, Mean(), Ranks()
        extremes = Extremes(series.dtype, series.unlikely)
        for span in spans:
            if span.has_missing:
                return None
            low, high = min(low, span._low), max(high, span._high)
            mean.join(span._mean)
            extremes.join(span._extremes)
            ranks.extend(span.ranks)
        extremes.refuse(series)
        return _scan_of(low, high, mean, {}), ranks


def _scan_of(
    low: float, high: float, mean: Mean, missing: Mapping[int, npt.NDArray[np.uint8]]
) -> Scan:
    return Scan(
        value_range=ValueRange(low, high),
        mean=min(max(mean.value(), low), high),
        finite_count=mean.count,
        missing=missing,
    )


def scan_steps(
    series: Series, steps: range, known: ValueRange, *, may_miss: bool, progress: Progress
) -> dict[int, npt.NDArray[np.uint8]]:
    """The masks of missing values of some steps, as `Scan.missing` has them, of a scanned series.

    known: range of the whole series. may_miss: whether values of it are missing.

    Raises InputError for values beyond the range, and for missing ones where none may be: the data
    are not those that were scanned. Progress stage: "scanning".
    """
    missing: dict[int, npt.NDArray[np.uint8]] = {}
    last_bits: npt.NDArray[np.uint8] | None = None
    for number, step in enumerate(steps):
        frame, count, mean = series.read(step), 0, Mean()
        for piece in pieces(frame):
            piece_count, low, high = scan_piece(piece, mean)
            count += piece_count
            if piece_count and not (known.low <= low and high <= known.high):
                raise InputError(
                    f"{series.source}: step {step} has values from {low:.9g} to {high:.9g}, and "
                    f"the plan is of data from {known.low:.9g} to {known.high:.9g}; make it anew"
                )
        if count < frame.size:
            if not may_miss:
                raise InputError(
                    f"{series.source}: step {step} has missing values, and the plan is of data "
                    "without; make it anew"
                )
            missing[step] = last_bits = _missing_bits(frame, last_bits)
        progress("scanning", number + 1, len(steps), "")
    return missing


def _missing_bits(
    frame: npt.NDArray[Any], last: npt.NDArray[np.uint8] | None
) -> npt.NDArray[np.uint8]:
    """The bits of the values of a frame that are not finite; the last ones where they are equal."""
    bits = np.packbits(~np.isfinite(frame))
    # A land mask is the same at every step: keep one copy of it.
    return last if last is not None and np.array_equal(bits, last) else bits


def scan_piece(piece: npt.NDArray[Any], mean: Mean) -> tuple[int, float, float]:
    """Number, minimum and maximum of the finite values of a piece; they are added to the mean."""
    if piece.dtype.kind != "f":
        mean.add(piece)
        return piece.size, exact_number(piece.min().item()), exact_number(piece.max().item())
    wide = piece.astype(np.float32 if piece.dtype.itemsize <= 4 else np.float64, copy=False)
    # A sum of float32 values does not overflow; float64 values are scaled before they are summed.
    count, low, high, total = range_and_sum(wide)
    scale = 1.0
    if count and wide.dtype == np.float64:
        scale = power_of_two(max(abs(low), abs(high)))
        total = range_and_sum(wide, scale)[3]
    mean.add_sum(count, total, scale)
    return count, low, high


def finite_values(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """The finite values, one-dimensional; the array itself if all of its values are finite."""
    if values.dtype.kind != "f":
        return values
    finite = np.isfinite(values)
    return values if finite.all() else values[finite]
