"""The promise of quality that the compact profile keeps."""

from __future__ import annotations

from dataclasses import dataclass, replace

from fhash_codec.compact.tiles.coding import Coding
from fhash_codec.config import EncodeConfig
from fhash_codec.measure.value_range import ValueRange

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


def goal_of(config: EncodeConfig, value_range: ValueRange, raw_bytes: int, overhead: int) -> Goal:
    """Return the promise of the settings; `EncodeConfig` allows one at most.

    raw_bytes: bytes of the series without compression.
    overhead: approximate bytes of the file that are no tiles.
    """
    data_range = value_range.high - value_range.low
    if config.max_error is not None:
        return Goal(error=config.max_error, data_range=data_range)
    if config.max_error_rel is not None:
        return Goal(error=config.max_error_rel * data_range, data_range=data_range)
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
