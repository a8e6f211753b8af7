"""Figures of a series that every measurement needs: its range, its bulk, and its size."""

from __future__ import annotations

from dataclasses import dataclass
from math import prod

from fhash_codec.coreset.scan import scan
from fhash_codec.measure.bulk import find_bulk
from fhash_codec.measure.errors import Errors
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.progress import Progress
from fhash_formats.errors import InputError
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

    def errors(self) -> Errors:
        """Errors without a frame yet."""
        return Errors(self.width, self.bulk)


def facts_of(series: Series, progress: Progress) -> Facts:
    """Scan a series; raises InputError for one that is constant or without a finite value."""
    scanned = scan(series, progress)
    value_range = scanned.value_range
    if value_range.low == value_range.high:
        raise InputError(
            f"{series.source}: '{series.name}' is constant; accuracy costs nothing there"
        )
    bulk = find_bulk(lambda: series.frames(), value_range, whole=series.dtype.kind in "iu")
    count = prod(series.shape)
    return Facts(
        value_range=value_range,
        bulk=bulk,
        missing=count - scanned.finite_count,
        raw_bytes=count * series.dtype.itemsize,
    )
