"""The promise of quality that the compact profile keeps."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from fhash_codec.compact.tiles.coding import Coding
from fhash_codec.config import EncodeConfig
from fhash_codec.measure.value_range import ValueRange

MAX_INTEGER_ERROR = 2.0**40
"""Bound on integers from which on a half more makes no difference."""
DEFAULT_PSNR = 50.0
"""PSNR in dB that is promised where nothing is asked for."""


@dataclass(frozen=True, kw_only=True)
class Goal:
    """The promise: exactly one of a PSNR, a bound and a size."""

    psnr: float | None = None
    """PSNR in dB over the vertices that count."""
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

    @property
    def expected_error(self) -> float:
        """Approximate root of the mean squared error, in data units, before anything is coded."""
        if self.psnr is not None:
            return float(self.data_range * 10 ** (-self.psnr / 20))
        return self.data_range / 100 if self.error is None else self.error / 2

    def bounded(self, coding: Coding) -> Coding:
        """Return the coding under the bound, if one was promised."""
        return coding if self.error is None else replace(coding, error=self.error)


def goal_of(
    config: EncodeConfig,
    value_range: ValueRange,
    raw_bytes: int,
    overhead: int,
    *,
    integers: bool = False,
) -> Goal:
    """Return the promise of the settings; `EncodeConfig` allows one at most.

    raw_bytes: bytes of the series without compression.
    overhead: approximate bytes of the file that are no tiles.
    integers: whether the values are integers, so that their errors are as well.
    """
    data_range = value_range.high - value_range.low
    error = config.max_error
    if config.max_error_rel is not None:
        error = config.max_error_rel * data_range
    if error is not None and integers and error < MAX_INTEGER_ERROR:
        # Before a decoded value is rounded to an integer, it may be off by half of one more.
        return Goal(error=math.floor(error) + 0.5, data_range=data_range, lossless=error < 1)
    if error is not None:
        return Goal(error=error, data_range=data_range, lossless=error == 0)
    if config.ratio is not None:
        return Goal(size=raw_bytes / config.ratio, data_range=data_range, overhead=overhead)
    return Goal(psnr=DEFAULT_PSNR if config.psnr is None else config.psnr, data_range=data_range)


def promise(config: EncodeConfig) -> dict[str, float]:
    """Return the promise of the settings by the name of its option."""
    options = {
        name: getattr(config, name) for name in ("psnr", "max_error", "max_error_rel", "ratio")
    }
    given = {name: value for name, value in options.items() if value is not None}
    return given or {"psnr": DEFAULT_PSNR}
