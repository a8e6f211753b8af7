"""Figures of a series that every measurement needs: its range, its bulk, and its size."""

from __future__ import annotations

from dataclasses import dataclass
from math import prod

from fhash_codec.features.scan import scan
from fhash_codec.measure.errors import Errors, find_bulk
from fhash_codec.measure.value_range import ValueRange, power_of_two
from fhash_codec.progress import Progress
from fhash_formats.series import Series


@dataclass(frozen=True, kw_only=True)
class Facts:
    """Figures of a series.

    Attributes:
        value_range, bulk: in data units; bulk is None where the middle 98 % have no width.
        missing: number of values that are not finite.
    """

    value_range: ValueRange
    bulk: ValueRange | None
    missing: int
    raw_bytes: int

    @property
    def width(self) -> float:
        """Width of the range, in data units."""
        return self.value_range.high - self.value_range.low

    @property
    def scale(self) -> float:
        """Power of two that brings differences of values near 1."""
        return power_of_two(self.width)

    @property
    def scaled_width(self) -> float:
        """Width of the range after scaling."""
        return self.width * self.scale

    def errors(self) -> Errors:
        """Errors without a frame yet."""
        return Errors(self.width, self.bulk)


def facts_of(series: Series, progress: Progress) -> Facts:
    """Scan a series; raises InputError for one without a finite value."""
    scanned = scan(series, progress)
    value_range = scanned.value_range
    bulk = find_bulk(lambda: series.frames(), value_range, whole=series.dtype.kind in "iu")
    count = prod(series.shape)
    return Facts(
        value_range=value_range,
        bulk=bulk,
        missing=count - scanned.finite_count,
        raw_bytes=count * series.dtype.itemsize,
    )
