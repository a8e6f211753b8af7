"""Errors of decoded frames: PSNR, RMSE and largest error, added up step by step in float64.

Vertices whose original value is not finite are left out of every figure.
PSNR = 20 log10(range / RMSE), with the range of the whole original series. numpy only.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fhash_codec.measure.sums import ErrorSums, Values, error_sums
from fhash_codec.measure.value_range import ValueRange, power_of_two
from fhash_formats.errors import InputError

__all__ = ["BulkQuality", "Errors", "StepQuality", "psnr"]


@dataclass(frozen=True, kw_only=True)
class StepQuality:
    """Figures of one step: PSNR in dB, errors in data units.

    None if no vertex is counted; the PSNR is None as well if the error or the range is 0.
    """

    step: int
    psnr: float | None
    rmse: float | None
    max_abs_error: float | None


@dataclass(frozen=True, kw_only=True)
class BulkQuality:
    """Figures over the counted vertices whose original value lies in the bulk of the series.

    Attributes:
        psnr: in dB, relative to the width of the bulk; None if the error is 0.
        rmse: in data units; None if no such vertex is counted.
        range: first and last value of the bulk, in data units.
    """

    psnr: float | None
    rmse: float | None
    range: tuple[float, float]


class Errors:
    """Squared and largest differences over frames.

    Differences are computed after scaling by an exact power of two near the range, so that neither
    huge nor tiny ranges overflow or underflow.

    Attributes:
        data_range: of the original series, in data units; inf is allowed and makes PSNR None.
        bulk: of the original series, in data units; None without one.
        count: vertices compared so far.
        steps: a StepQuality per frame.
    """

    def __init__(self, data_range: float, bulk: ValueRange | None = None) -> None:
        """Begin without frames; raises InputError for a range below 0 or NaN."""
        if not data_range >= 0:
            raise InputError(f"data range is {data_range}; 0 or more is needed")
        self.data_range = data_range
        self.bulk = bulk
        self.count = 0
        self.steps: list[StepQuality] = []
        self._scale = power_of_two(min(data_range, sys.float_info.max))
        self._squares = 0.0
        self._largest = 0.0
        self._bulk_count = 0
        self._bulk_squares = 0.0

    def add(
        self,
        step: int,
        original: Values,
        decoded: Values,
        mask: npt.NDArray[np.bool_] | None = None,
    ) -> StepQuality:
        """Compare a frame, and return the figures of its step.

        mask: vertices to be compared, all if None. The three arrays have one shape. Raises
        InputError for different shapes, and for a decoded value that is not finite at a vertex that
        is compared.
        """
        return self.take(step, self.compare(step, original, decoded, mask))

    def compare(
        self,
        step: int,
        original: Values,
        decoded: Values,
        mask: npt.NDArray[np.bool_] | None = None,
    ) -> ErrorSums:
        """The scaled differences of a frame, for `take`; parameters and errors as in `add`."""
        if original.shape != decoded.shape or (mask is not None and mask.shape != original.shape):
            raise InputError(
                f"step {step}: the original is {original.shape}, the decoded {decoded.shape}; "
                "they must be of one shape"
            )
        bulk = None if self.bulk is None else (self.bulk.low, self.bulk.high)
        errors = error_sums(original, decoded, mask, self._scale, bulk)
        if errors.number < 0:
            raise InputError(f"step {step}: decoded values are not finite where they are compared")
        return errors

    def take(self, step: int, errors: ErrorSums) -> StepQuality:
        """Add the differences of a step, and return its figures."""
        count, squares, largest = errors[:3]
        self.count += count
        self._squares += squares
        self._bulk_count += errors.bulk_count
        self._bulk_squares += errors.bulk_squares
        self._largest = max(self._largest, largest)
        figures = StepQuality(
            step=step,
            psnr=self._psnr(squares, count),
            rmse=self._rmse(squares, count),
            max_abs_error=self._unscaled(largest, count),
        )
        self.steps.append(figures)
        return figures

    @property
    def rmse(self) -> float | None:
        """Root of the mean squared difference over all frames, in data units."""
        return self._rmse(self._squares, self.count)

    @property
    def psnr(self) -> float | None:
        """PSNR over all frames, in dB."""
        return self._psnr(self._squares, self.count)

    @property
    def max_abs_error(self) -> float | None:
        """The largest difference over all frames, in data units."""
        return self._unscaled(self._largest, self.count)

    def bulk_quality(self) -> BulkQuality | None:
        """The figures of the bulk over all frames; None without a bulk."""
        if self.bulk is None:
            return None
        squares, count = self._bulk_squares, self._bulk_count
        width = (self.bulk.high - self.bulk.low) * self._scale
        return BulkQuality(
            psnr=psnr(width, math.sqrt(squares / count) if count else None),
            rmse=self._rmse(squares, count),
            range=(self.bulk.low, self.bulk.high),
        )

    def _psnr(self, squares: float, count: int) -> float | None:
        # In scaled units: in data units, a mean of denormals would be rounded to a denormal.
        return psnr(self.data_range * self._scale, math.sqrt(squares / count) if count else None)

    def _rmse(self, squares: float, count: int) -> float | None:
        return self._unscaled(math.sqrt(squares / count) if count else 0.0, count)

    def _unscaled(self, value: float, count: int) -> float | None:
        with np.errstate(over="ignore"):
            figure = float(np.float64(value) / self._scale)
        return figure if count and math.isfinite(figure) else None


def psnr(data_range: float, rmse: float | None) -> float | None:
    """20 log10(data_range / rmse) in dB; None if either is 0, None or not finite."""
    if rmse is None or not (0 < rmse < math.inf and 0 < data_range < math.inf):
        return None
    return 20 * (math.log10(data_range) - math.log10(rmse))
