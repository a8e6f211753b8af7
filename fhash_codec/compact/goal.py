"""The promise of quality that the compact profile keeps."""

from __future__ import annotations

from dataclasses import dataclass, replace

from fhash_codec.compact.tiles.coding import Coding
from fhash_codec.config import EncodeConfig
from fhash_codec.measure.value_range import ValueRange

DEFAULT_PSNR = 50.0


@dataclass(frozen=True, kw_only=True)
class Goal:
    """What was promised: exactly one of a PSNR in dB, a bound in data units, and a number of bytes.

    data_range: of the series. overhead: bytes of the file that are no tiles, roughly.
    """

    psnr: float | None = None
    error: float | None = None
    size: float | None = None
    data_range: float
    overhead: int = 0

    @property
    def expected(self) -> float:
        """Root of the mean squared error, roughly, before anything is coded."""
        if self.psnr is not None:
            return float(self.data_range * 10 ** (-self.psnr / 20))
        return self.data_range / 100 if self.error is None else self.error / 2

    def bounded(self, coding: Coding) -> Coding:
        """The same way under the bound, if that was promised."""
        return coding if self.error is None else replace(coding, error=self.error)


def goal_of(config: EncodeConfig, value_range: ValueRange, raw_bytes: int, overhead: int) -> Goal:
    """The one promise of the settings (that there is no other, `EncodeConfig` has seen to). overhead: see `Goal`."""
    data_range = value_range.high - value_range.low
    if config.max_error is not None:
        return Goal(error=config.max_error, data_range=data_range)
    if config.max_error_rel is not None:
        return Goal(error=config.max_error_rel * data_range, data_range=data_range)
    if config.ratio is not None:
        return Goal(size=raw_bytes / config.ratio, data_range=data_range, overhead=overhead)
    return Goal(psnr=DEFAULT_PSNR if config.psnr is None else config.psnr, data_range=data_range)


def promise(config: EncodeConfig) -> dict[str, float]:
    """The promise of the settings by its name."""
    given = {
        name: getattr(config, name) for name in ("psnr", "max_error", "max_error_rel", "ratio")
    }
    return {name: value for name, value in given.items() if value is not None} or {
        "psnr": DEFAULT_PSNR
    }
