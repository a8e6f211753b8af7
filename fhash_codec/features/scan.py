"""Scan of a series: its range, extremes and figures, block by block of frames."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.measure.errors import row_sums
from fhash_codec.measure.value_range import PIECE, Mean, Ranks, RanksSpan, ValueRange, power_of_two
from fhash_codec.progress import Progress
from fhash_formats.errors import InputError
from fhash_formats.series import ArraySeries, Series, spans_text, warn_defaults, warn_outside
from fhash_formats.support.threads import map_ahead, one_ahead, thread_pool
from fhash_formats.support.values import Values, exact_number

HELD_BYTES = 1 << 28
"""Bytes of a series whose frames stay in memory after the scan, at most."""

BLOCKS_AHEAD = 2
"""Blocks of frames that are looked at while the next one is read, at most."""

MOST = 2.0
"""Ratio of the ranges with and without a value that is hardly ever data: -9999, -32768."""

SEVERAL = 10.0
"""Ratio for a value that may be data too: 9999, or 65535 where a detector is saturated."""

HUGE = 1e3
"""Ratio for a large power of ten and the like: 1e20 is a density of electrons as well."""

ABSURD = 1e6
"""Ratio for any other value: without it, less than a millionth of the range is left.

A plateau of 1000 in a background of 1.2 +- 0.1, as water in air, has a ratio of 5000.
"""

NINES = re.compile(r"-99+(\.9+)?|999+(\.9+)?")
HUGE_VALUES = (1e15, 1e20, 1e30, 1e33, 1e34, 1e35, 1e36, 1e37, 1e38, 9.969209968386869e36)
"""Magnitudes that are in use for missing values; the last is NetCDF's default."""

LARGEST_FLOATS = (float(np.finfo(np.float32).max), float(np.finfo(np.float64).max))


def least_ratio(value: float) -> float:
    """The ratio of the ranges with and without a value, from which on it is taken for a fill value.

    The value is finite.
    """
    if value in _type_ends(low=True):
        return MOST
    if value in _type_ends(low=False):
        return SEVERAL
    if NINES.fullmatch(f"{value:.9g}"):
        return MOST if value < 0 else SEVERAL
    return HUGE if _is_huge(value) else ABSURD


def _type_ends(*, low: bool) -> set[int]:
    """Ends of the integer types of 16 to 64 bits; at the lower end also NetCDF's default, one
    above."""
    if low:
        return {-(2**bits) + more for bits in (15, 31, 63) for more in (0, 1, 2)}
    return {2**bits - more for bits in (15, 16, 31, 32, 63, 64) for more in (1, 2)}


def _is_huge(value: float) -> bool:
    # a float32 of 1e20 is 1.00000002e20 as a float64
    return abs(value) in LARGEST_FLOATS or any(
        math.isclose(abs(value), huge, rel_tol=1e-6) for huge in HUGE_VALUES
    )


@dataclass
class _End:
    """One end of the range of the values so far: the value, how often it occurs, the next one."""

    low: bool
    value: float | None = None
    count: int = 0
    next: float | None = None

    def add(self, piece: npt.NDArray[Any], extreme: float) -> None:
        """Add a piece whose finite values have this extreme."""
        if self.value is None or self._beyond(extreme, self.value):
            self._candidate(self.value)
            self.value, self.count = extreme, 0
        if extreme == self.value:
            self.count += int(np.count_nonzero(piece == extreme))
            self._candidate(_inner(piece, extreme, self.low))
        else:
            self._candidate(extreme)

    def join(self, other: _End) -> None:
        """Add the values of another end of the same side."""
        if other.value is None:
            return
        if self.value is None or self._beyond(other.value, self.value):
            self._candidate(self.value)
            self.value, self.count = other.value, 0
        if other.value == self.value:
            self.count += other.count
        else:
            self._candidate(other.value)
        self._candidate(other.next)

    def _beyond(self, one: float, other: float) -> bool:
        return one < other if self.low else one > other

    def _candidate(self, value: float | None) -> None:
        if value is not None and (self.next is None or self._beyond(value, self.next)):
            self.next = value


def _inner(piece: npt.NDArray[Any], extreme: float, low: bool) -> float | None:
    """The finite value of a piece nearest to its extreme; None if there is no other."""
    inside = piece > extreme if low else piece < extreme
    if piece.dtype.kind == "f":
        start: Any = np.inf if low else -np.inf
    else:
        limits = np.iinfo(piece.dtype)
        start = limits.max if low else limits.min
    found = (np.min if low else np.max)(piece, initial=start, where=inside)
    if found == start and not (np.isfinite(start) and inside.any()):
        return None
    number: float = found.item()
    return number


class Extremes:
    """The two ends of the range of a series, gathered piece by piece, and the values next to them.

    Integers of 8 bits are passed over: their range is 255 at most, and label 127 is a label.

    unlikely: values that are hardly ever data, see `Series`.
    """

    def __init__(self, dtype: np.dtype[Any], unlikely: Collection[float] = ()) -> None:
        self._relevant = dtype.kind == "f" or dtype.itemsize > 1
        self._unlikely = unlikely
        self._low, self._high = _End(low=True), _End(low=False)
        self._count = 0

    def add(self, piece: npt.NDArray[Any], count: int, low: float, high: float) -> None:
        """Add a piece with `count` finite values from `low` to `high`; the others are no matter."""
        if self._relevant and count:
            self._count += count
            self._low.add(piece, low)
            self._high.add(piece, high)

    def join(self, other: Extremes) -> None:
        """Add the values of other extremes of the same type."""
        self._count += other._count
        self._low.join(other._low)
        self._high.join(other._high)

    def suspects(self) -> list[float]:
        """The ends that look like fill values; none, one or both."""
        low, high = self._low, self._high
        for ends in ([low], [high], [low, high]):
            if all(end.count > 1 for end in ends) and self._is_far_off(ends):
                return [end.value for end in ends if end.value is not None]
        return []

    def _is_far_off(self, ends: list[_End]) -> bool:
        """Whether the range without some ends is so small that they must be fill values."""
        rest = self._rest(ends)
        if rest is None or self._low.value is None or self._high.value is None:
            return False
        full, left = _half(self._low.value, self._high.value), _half(*rest)
        values = [end.value for end in ends if end.value is not None]
        if left == 0:
            # all others are equal, as in a mask; only a value that is hardly ever data counts
            return all(self._ratio(value) in (MOST, HUGE) for value in values)
        return all(full >= self._ratio(value) * left for value in values)

    def _ratio(self, value: float) -> float:
        return MOST if value in self._unlikely else least_ratio(value)

    def _rest(self, ends: list[_End]) -> tuple[float, float] | None:
        """The range of the values without some ends; None if none is left."""
        low = self._low.next if self._low in ends else self._low.value
        high = self._high.next if self._high in ends else self._high.value
        return None if low is None or high is None or low > high else (low, high)

    def refuse(self, series: Series) -> None:
        """Raise InputError if an end looks like a fill value, unless the user said it is data."""
        suspects = [] if series.keep_extremes else self.suspects()
        if not suspects:
            return
        counts = {self._low.value: self._low.count, self._high.value: self._high.count}
        stands = " and ".join(
            f"{_value_text(value, series.dtype)} at {_percent(counts[value] / self._count)}"
            for value in suspects
        )
        rest = self._rest([end for end in (self._low, self._high) if end.value in suspects])
        assert rest is not None
        others = " to ".join(_value_text(value, series.dtype) for value in dict.fromkeys(rest))
        numbers = [_value_text(value, series.dtype) for value in suspects]
        mark, keep = " ".join(f"--missing {number}" for number in numbers), "--keep-extremes"
        if isinstance(series, ArraySeries):
            mark, keep = f"ArraySeries(missing=[{', '.join(numbers)}])", "keep_extremes=True"
        raise InputError(
            f"{series.source}: '{series.name}' has {stands} of its vertices, and only {others}"
            f" elsewhere; give {mark} if that marks missing values, or {keep} if it is data"
        )


def _half(low: float, high: float) -> float:
    """Half of a range; integers are subtracted first, and halved floats do not overflow."""
    return (high - low) / 2 if isinstance(low, int) else high / 2 - low / 2


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"


def _value_text(value: float, dtype: np.dtype[Any]) -> str:
    """The shortest text that stands for a value of a type."""
    if dtype.kind != "f":
        return str(int(value))
    text = str(dtype.type(value))
    return text.removesuffix(".0")


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


def finite_masks(
    missing: Mapping[int, npt.NDArray[np.uint8]], steps: range, shape: tuple[int, int, int]
) -> npt.NDArray[np.bool_] | None:
    """Masks (t, z, y, x) of the finite vertices of some steps; None if all are finite.

    missing: see `Scan`. shape: of a frame.
    """
    if not any(step in missing for step in steps):
        return None
    none = np.zeros(-(-prod(shape) // 8), np.uint8)
    rows = np.stack([missing.get(step, none) for step in steps])
    bits = np.unpackbits(rows, axis=1, count=prod(shape)).view(np.bool_)
    return ~bits.reshape(-1, *shape)


def scan(series: Series, progress: Progress, ranks: Ranks | None = None) -> Scan:
    """Scan every frame once.

    ranks: gets all finite values.

    Raises InputError if no value at all is finite, if an extreme value looks like a fill value that
    nobody declared (extremes.py), or if the series changed. Progress stage: "scanning".
    """
    figures = _Figures(series)
    missing: dict[int, npt.NDArray[np.uint8]] = {}
    steps, size = series.shape[0], prod(series.shape) * series.dtype.itemsize
    # the encoder and the measurement read all frames once more
    kept = series.held is None and size <= HELD_BYTES
    held = np.empty(series.shape, series.dtype) if kept else None

    def look(at: tuple[range, Values]) -> tuple[range, Values, _Figures, int, int]:
        block, frames = at
        if held is not None:
            held[block.start : block.stop] = frames
        own = _Figures(series)
        return block, frames, own, own.add(frames), series.outside(frames)

    outside = 0
    with thread_pool() as workers:
        blocks = one_ahead(series.blocks(range(steps)))
        looks = map_ahead(workers, look, blocks, BLOCKS_AHEAD)
        for block, frames, own, finite, beyond in looks:
            outside += beyond
            figures.join(own)
            if finite < frames.size:
                _add_missing(missing, block, frames)
            if ranks is not None:
                ranks.add(frames)
            progress("scanning", block.stop, steps, "")
    series.check()
    if held is not None:
        held.flags.writeable = False
        series.held = held
    if figures.mean.count == 0:
        raise InputError(
            f"{series.source}: '{series.name}' has no finite value in any of its {steps} steps; "
            "there is nothing to encode"
        )
    found = figures.scan(series, missing)
    warn_defaults(series)
    warn_outside(series, outside)
    return found


class _Figures:
    """Range, mean and extremes of the finite values of blocks of frames that are added in turn."""

    def __init__(self, series: Series) -> None:
        self.low, self.high, self.mean = np.inf, -np.inf, Mean()
        self.extremes = Extremes(series.dtype, series.unlikely)

    def add(self, frames: Values) -> int:
        """Add frames (t, z, y, x), and return the number of their finite values."""
        finite = 0
        for rows in _rows(frames):
            count, low, high = scan_rows(rows, self.mean)
            self.extremes.add(rows, count, low, high)
            self.low, self.high = min(self.low, low), max(self.high, high)
            finite += count
        return finite

    def join(self, other: _Figures) -> None:
        """Add the frames of other figures."""
        self.low, self.high = min(self.low, other.low), max(self.high, other.high)
        self.mean.join(other.mean)
        self.extremes.join(other.extremes)

    def scan(self, series: Series, missing: Mapping[int, npt.NDArray[np.uint8]]) -> Scan:
        """The scan; raises InputError for an extreme that looks like a fill value."""
        self.extremes.refuse(series)
        return Scan(
            value_range=ValueRange(self.low, self.high),
            mean=min(max(self.mean.value(), self.low), self.high),
            finite_count=self.mean.count,
            missing=missing,
        )


class SpanScan:
    """A scan of neighbouring steps without missing values; spans join to the scan of a series.

    Another machine may make it. Attributes:
        has_missing: whether a value is missing; nothing else counts then.
        ranks: of the values.
        outside: number of values outside the range that the source calls valid.
    """

    def __init__(self, series: Series, steps: range) -> None:
        """Scan some steps."""
        self._figures = _Figures(series)
        self.ranks = RanksSpan(steps.start * prod(series.shape[1:]))
        self.has_missing = False
        self.outside = 0
        for _, frames in series.blocks(steps):
            self.outside += series.outside(frames)
            if self._figures.add(frames) < frames.size:
                self.has_missing, self.ranks = True, RanksSpan(0)
                return
            self.ranks.add(frames)

    @staticmethod
    def joined(series: Series, spans: Iterable[SpanScan]) -> tuple[Scan, Ranks] | None:
        """The scan of a series and its ranks, from spans of all steps in their order.

        None where a value is missing. Raises InputError as `scan` does.
        """
        figures, ranks, outside = _Figures(series), Ranks(), 0
        for span in spans:
            if span.has_missing:
                return None
            outside += span.outside
            figures.join(span._figures)
            ranks.extend(span.ranks)
        warn_outside(series, outside)
        return figures.scan(series, {}), ranks


def scan_steps(
    series: Series, steps: range, known: ValueRange, *, may_miss: bool, progress: Progress
) -> dict[int, npt.NDArray[np.uint8]]:
    """The masks of missing values of some steps, as `Scan.missing` has them, of a scanned series.

    known: range of the whole series. may_miss: whether values of it are missing.

    Raises InputError for values beyond the range, and for missing ones where none may be: the data
    are not those that were scanned. Progress stage: "scanning".
    """
    missing: dict[int, npt.NDArray[np.uint8]] = {}
    for block, frames in series.blocks(steps):
        count, mean = 0, Mean()
        which = spans_text([[block.start, block.stop]])
        for rows in _rows(frames):
            rows_count, low, high = scan_rows(rows, mean)
            count += rows_count
            if rows_count and not (known.low <= low and high <= known.high):
                raise InputError(
                    f"{series.source}: in {which} are values from {low:.9g} to {high:.9g}, and "
                    f"the plan is of data from {known.low:.9g} to {known.high:.9g}; make it anew"
                )
        if count < frames.size:
            if not may_miss:
                raise InputError(
                    f"{series.source}: in {which} are missing values, and the plan is of data "
                    "without; make it anew"
                )
            _add_missing(missing, block, frames)
        progress("scanning", block.stop - steps.start, len(steps), "")
    return missing


def _rows(frames: Values) -> Iterator[Values]:
    """Frames (t, z, y, x) as rows (t, values) of at most PIECE values each; blocks are small."""
    rows = frames.reshape(len(frames), -1)
    return (rows[:, start : start + PIECE] for start in range(0, rows.shape[1], PIECE))


def _add_missing(
    missing: dict[int, npt.NDArray[np.uint8]], steps: range, frames: npt.NDArray[Any]
) -> None:
    """Add the bits of the values that are not finite of each step that has some."""
    # A land mask is the same at every step: keep one copy of it.
    last = next(reversed(missing.values()), None)
    bits = np.packbits(~np.isfinite(frames).reshape(len(steps), -1), axis=1)
    for place in np.flatnonzero(bits.any(axis=1)).tolist():
        row = bits[place]
        last = row if last is None or (row != last).any() else last
        missing[steps[place]] = last


def scan_rows(rows: npt.NDArray[Any], mean: Mean) -> tuple[int, float, float]:
    """Number, minimum and maximum of the finite values of rows (rows, values).

    Each row is added to the mean, which so does not depend on the rows that come together.
    """
    if rows.dtype.kind != "f":
        mean.add(rows)
        return rows.size, exact_number(rows.min().item()), exact_number(rows.max().item())
    wide = rows.astype(np.float32 if rows.dtype.itemsize <= 4 else np.float64, copy=False)
    # A sum of float32 values does not overflow; float64 values are scaled before they are summed.
    counts, lows, highs, totals = row_sums(wide).T
    count, low, high, scale = int(counts.sum()), float(lows.min()), float(highs.max()), 1.0
    if count and wide.dtype == np.float64:
        scale = power_of_two(max(abs(low), abs(high)))
        totals = row_sums(wide, scale)[:, 3]
    mean.add_sums(count, totals, scale)
    return count, low, high


def finite_values(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """The finite values, one-dimensional; the array itself if all of its values are finite."""
    if values.dtype.kind != "f":
        return values
    finite = np.isfinite(values)
    return values if finite.all() else values[finite]
