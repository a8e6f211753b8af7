"""The promise of quality that the compact profile keeps."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from fhash_codec.compact.tiles.coding import BulkPart, Coding
from fhash_codec.config import PROMISES, EncodeConfig
from fhash_codec.measure.bulk import is_wide, whole_psnr
from fhash_codec.measure.value_range import ValueRange
from fhash_formats.errors import InputError

MAX_INTEGER_ERROR = 2.0**40
"""Bound on integers from which on a half more makes no difference."""
DEFAULT_PSNR = 50.0
"""PSNR in dB that is promised where nothing is asked for."""
DEFAULT_PSNR_BULK = 40.0
"""PSNR in dB that is promised of a wide bulk where nothing is asked for."""
RATIO_SLACK = 1.05
"""Factor by which a file may be smaller than a promised ratio asks for, where a step allows it."""


@dataclass(frozen=True, kw_only=True)
class Goal:
    """The promise: exactly one of a PSNR, a bound and a size."""

    psnr: float | None = None
    """PSNR in dB that `Outcome.psnr` must reach: over the vertices that count, or what stands for
    a promise about the bulk alone."""
    error: float | None = None
    """Strict bound of the absolute error, in data units."""
    size: float | None = None
    """Size of the file in bytes."""
    lossless: bool = False
    """Whether the bound allows no error at all."""
    data_range: float
    """Range of the values of the series, in data units."""
    overhead: int = 0
    """Approximate bytes of the file that are no tiles."""
    bulk: BulkPart | None = None
    """Part of a promised PSNR that is about the bulk."""

    @property
    def even_psnr(self) -> float | None:
        """PSNR in dB that keeps the promise if errors are everywhere alike."""
        if self.psnr is None or self.bulk is None:
            return self.psnr
        return self.psnr + max(0.0, 10 * math.log10(self.bulk.weight))

    @property
    def expected_error(self) -> float:
        """Approximate root of the mean squared error, in data units, before anything is coded."""
        if self.even_psnr is not None:
            return float(self.data_range * 10 ** (-self.even_psnr / 20))
        return self.data_range / 100 if self.error is None else self.error / 2

    def bounded(self, coding: Coding) -> Coding:
        """Return the coding under the bound, if one was promised."""
        return coding if self.error is None else replace(coding, error=self.error)


def goal_of(
    config: EncodeConfig,
    value_range: ValueRange,
    raw_bytes: int,
    overhead: int,
    bulk: ValueRange | None = None,
    *,
    integers: bool = False,
) -> Goal:
    """Return the promise of the settings; `EncodeConfig` allows one at most, or both PSNRs.

    raw_bytes: bytes of the series without compression.
    overhead: approximate bytes of the file that are no tiles.
    bulk: of the series, in data units; None if it has none.
    integers: whether the values are integers, so that their errors are as well.

    Raises InputError for a promise about a bulk that is not there.
    """
    data_range = value_range.high - value_range.low
    error = config.max_error
    if config.max_error_rel is not None:
        error = config.max_error_rel * data_range
    if error is not None and integers and error < MAX_INTEGER_ERROR:
        return integer_goal(error, data_range)
    if error is not None:
        return Goal(error=error, data_range=data_range, lossless=error == 0)
    if config.ratio is not None:
        return Goal(size=raw_bytes / config.ratio, data_range=data_range, overhead=overhead)
    promised = promise(config, value_range, bulk)
    psnr, psnr_bulk = promised.get("psnr"), promised.get("psnr_bulk")
    if psnr_bulk is None or bulk is None:
        return Goal(psnr=DEFAULT_PSNR if psnr is None else psnr, data_range=data_range)
    even = whole_psnr(psnr_bulk, bulk, data_range)
    if psnr is None:
        part = BulkPart(low=bulk.low, high=bulk.high, alone=True)
        return Goal(psnr=even, data_range=data_range, bulk=part)
    part = BulkPart(low=bulk.low, high=bulk.high, weight=10 ** ((even - psnr) / 10))
    return Goal(psnr=psnr, data_range=data_range, bulk=part)


def integer_goal(error: float, data_range: float) -> Goal:
    """Return the promise that integers are off by an error at most; below 1 they are exact."""
    # Before a decoded value is rounded to an integer, it may be off by half of one more.
    return Goal(error=math.floor(error) + 0.5, data_range=data_range, lossless=error < 1)


def promise(
    config: EncodeConfig, value_range: ValueRange | None = None, bulk: ValueRange | None = None
) -> dict[str, float]:
    """Return the promise of the settings by the names of its options.

    value_range: of the series, in data units; None if it is not known.
    bulk: of the series, in data units; None if it has none. Without a promise in the settings it
        is promised only if it is wide (`is_wide`): where nearly all values are nearly the same,
        it says nothing of the others, and would cost many times the bytes.

    Raises InputError for a promise about a bulk that is not there.
    """
    options = {name: getattr(config, name) for name in PROMISES}
    given = {name: value for name, value in options.items() if value is not None}
    varied = value_range is not None and value_range.low < value_range.high
    if "psnr_bulk" in given and bulk is None and varied:
        raise InputError(
            "psnr-bulk has nothing to measure: the middle 98 % of the values are all the same; "
            "promise --psnr, --max-error or --max-error-rel"
        )
    if given:
        return given
    if bulk is None or value_range is None or not is_wide(bulk, value_range):
        return {"psnr": DEFAULT_PSNR}
    return {"psnr": DEFAULT_PSNR, "psnr_bulk": DEFAULT_PSNR_BULK}
