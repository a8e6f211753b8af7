"""Ranges of values, values by rank, and the finite values of frames."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.support.threads import in_threads
from fhash_formats.support.values import exact_number, integer_origin, is_wide_integer
from fhash_formats.transform.values import about_origin

PIECE = 2**20
"""Values that are converted to float64 at a time; they take 8 MiB."""


def pieces(values: npt.NDArray[Any]) -> Iterator[npt.NDArray[Any]]:
    """The values in C order, as one-dimensional views of at most PIECE values.

    An array that is not C-contiguous is copied once.
    """
    flat = values.reshape(-1)
    for start in range(0, flat.size, PIECE):
        yield flat[start : start + PIECE]


def power_of_two(peak: float) -> float:
    """A power of two that brings `peak` >= 0 near 1.

    Multiplying by it is exact. Differences and squares of values up to `peak` then neither overflow
    nor vanish. It is clamped to 2**+-1000, so that its reciprocal is a normal number too.
    """
    exponent = math.frexp(peak)[1]
    return math.ldexp(1.0, -max(-1000, min(1000, exponent)))


class Mean:
    """The mean of many finite values that are added piece by piece.

    It does not overflow, and does not drift with the order or the number of pieces: each piece is
    summed in float64 after exact scaling, and the sums are added as exact fractions.
    """

    def __init__(self) -> None:
        self.count = 0
        self._total = Fraction(0)
        self._whole = False

    def add(self, values: npt.NDArray[Any]) -> None:
        """Add finite values of any shape and number type; cut large arrays with `pieces` first."""
        if values.size == 0:
            return
        peak = max(abs(values.min().item()), abs(values.max().item()))
        if values.dtype.kind != "f":
            wide = values.astype(np.dtype(f"{values.dtype.kind}8"), copy=False)
            # In halves, whose sums do not overflow.
            self._total += (int((wide >> 32).sum()) << 32) + int((wide & 0xFFFFFFFF).sum())
            self.count += values.size
            self._whole |= peak > 1 << 53
            return
        scale = power_of_two(peak)
        total = (values.astype(np.float64) * scale).sum()
        self.add_sums(values.size, np.array([total]), scale)

    def add_sums(self, count: int, totals: npt.NDArray[np.float64], scale: float) -> None:
        """Add `count` values by sums of some each: `totals` are these sums times `scale`."""
        mantissas, exponents = np.frexp(totals)
        least = int(exponents.min())
        numbers = np.ldexp(mantissas, 53).astype(np.int64).tolist()
        shifts = (exponents - least).tolist()
        total = sum(number << shift for number, shift in zip(numbers, shifts, strict=True))
        self._total += total * Fraction(2) ** (least - 53) / Fraction(scale)
        self.count += count

    def join(self, other: Mean) -> None:
        """Add the values of another mean."""
        self._total += other._total
        self.count += other.count
        self._whole |= other._whole

    def value(self) -> float:
        """The mean of all values added; there must be at least one.

        It is a whole number for integers of 64 bits some of which are beyond 2^53.
        """
        mean = self._total / self.count
        return exact_number(round(mean)) if self._whole else float(mean)


def mean_of(values: npt.NDArray[Any]) -> float:
    """The `Mean` of the finite values of an array; there must be at least one."""
    mean = Mean()
    mean.add(values)
    return mean.value()


def decoded_type(source: np.dtype[Any]) -> np.dtype[Any]:
    """The type of decoded values: a float wide enough for the source's own precision."""
    narrow = source.itemsize <= 2 or source == np.float32
    return np.dtype(np.float32 if narrow else np.float64)


@dataclass(frozen=True)
class ValueRange:
    """The range of a series: finite numbers `low` <= `high` in data units.

    Differences that could overflow or be denormal are computed after scaling by an exact power of
    two, so that +-1.7e308 and denormal ranges work like any other range. Where an end is an integer
    beyond 2^53, both are integers, and their difference is exact. Raises InputError for other
    numbers.
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low <= self.high):
            raise InputError(
                f"value range is {self.low!r} to {self.high!r}; "
                "two finite numbers, the lower first, are needed"
            )
        ends = [exact_number(end) for end in self.ends]
        if any(isinstance(end, int) for end in ends):
            ends = [int(end) for end in ends]
        for name, end in zip(("low", "high"), ends, strict=True):
            object.__setattr__(self, name, end)

    @property
    def ends(self) -> tuple[float, float]:
        """Both ends."""
        return self.low, self.high

    @property
    def floats(self) -> tuple[float, float]:
        """The least and the greatest float64 within the range; its rounded ends if none is."""
        low, high = float(self.low), float(self.high)
        inner = (
            low if low >= self.low else math.nextafter(low, math.inf),
            high if high <= self.high else math.nextafter(high, -math.inf),
        )
        return inner if inner[0] <= inner[1] else (low, high)

    def is_far(self, dtype: np.dtype[Any]) -> bool:
        """Whether values of a type may be integers that float64 has not."""
        return is_wide_integer(dtype) and max(map(abs, self.ends)) > 1 << 53

    def origin(self, dtype: np.dtype[Any]) -> int:
        """The integer that is subtracted from values of a type before they become floats."""
        return integer_origin(self.low, self.high, dtype)

    def moved(self, distance: int) -> ValueRange:
        """The range of the values plus an integer; integers stay exact."""
        if not distance:
            return self
        return ValueRange(*(exact_number(int(end) + distance) for end in self.ends))

    @property
    def scale(self) -> float:
        """A power of two: both ends are multiplied by it before they are subtracted.

        It is 1 for every ordinary range.
        """
        peak = max(abs(self.low), abs(self.high))
        return 1.0 if 2.0**-900 < peak < 2.0**1022 else power_of_two(peak)

    def to_unit(self, values: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """(value - low) / (high - low) as float32 in [0, 1], of the same shape.

        `low` gives exactly 0 and `high` exactly 1. Values outside the range are clipped. NaN and
        both infinities give NaN. A constant range gives 0. Computed in float64, PIECE values at a
        time.
        """
        source = np.asarray(values)
        origin = self.origin(source.dtype)
        if origin:
            differences = about_origin(np.clip(source, int(self.low), int(self.high)), origin)
            return self.moved(-origin).to_unit(differences)
        unit = np.empty(source.shape, dtype=np.float32)
        for piece, out in zip(pieces(source), pieces(unit), strict=True):
            out[:] = self._piece_to_unit(piece.astype(np.float64))
        return unit

    def _piece_to_unit(self, wide: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """`to_unit` of float64 values, in place."""
        wide[np.isinf(wide)] = np.nan
        np.clip(wide, self.low, self.high, out=wide)
        low = self.low * self.scale
        span = self.high * self.scale - low
        wide *= self.scale
        wide -= low
        if span > 0:
            wide /= span
        return wide

    def from_unit(self, unit: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """low + unit * (high - low) in data units, float64 of the same shape.

        Values are clipped to the range; NaN stays NaN. Error law, for every x in the range:
        |from_unit(to_unit(x)) - x| <= 2**-25 (high - low) + 2 float64 spacings of the larger end.
        """
        low, high = self.low * self.scale, self.high * self.scale
        values = np.asarray(unit, dtype=np.float64) * (high - low)
        values = np.asarray(values + low)
        np.clip(values, low, high, out=values)
        values /= self.scale
        # If the ends differ by 300 orders of magnitude, scaling takes digits from the smaller one:
        # clip in data units as well.
        return np.clip(values, *self.floats, out=values)


SIZE = 1 << 21
"""Values of a block. With 2^34 values the error is below 1/30,000 of them, in 40 MB."""
STRIDE = 8
"""Values of a sorted block of which one is held, since sorting is much faster than joining."""


class Ranks:
    """A sketch of the ranks of finite values that are added array by array.

    Attributes:
        count: number of values added.
        error: shift of a rank at most; 0 where all values are still held.
    """

    def __init__(self, size: int = SIZE) -> None:
        """Begin without values; size: of a block, a multiple of STRIDE."""
        self.count = self.error = self._blocks = 0
        self._size = size
        self._block: npt.NDArray[Any] | None = None
        self._held = 0
        self._levels: list[npt.NDArray[Any] | None] = []
        self._upper: list[bool] = []

    def add(self, values: npt.NDArray[Any]) -> None:
        """Add the finite values of an array of any shape; all arrays are of one real type."""
        full: list[npt.NDArray[Any]] = []
        for piece in pieces(values):
            finite = piece[np.isfinite(piece)] if piece.dtype.kind == "f" else piece
            self.count += finite.size
            while finite.size:
                if self._block is None:
                    self._block, self._held = np.empty(self._size, finite.dtype), 0
                taken = finite[: self._size - self._held]
                self._block[self._held : self._held + taken.size] = taken
                self._held += taken.size
                finite = finite[taken.size :]
                if self._held == self._size:
                    full.append(self._block)
                    self._block = None
        numbered = zip(full, range(self._blocks, self._blocks + len(full)), strict=True)
        for block in in_threads(lambda pair: _sketched(*pair), numbered):
            self._count_blocks(0)
            self._carry(block)

    def extend(self, span: RanksSpan) -> None:
        """Add the values of a span, which follow those added so far; nothing depends on the cut.

        Raises ValueError for a span of other places.
        """
        if span.first != self.count or span.size != self._size:
            raise ValueError(f"values from {span.first} on do not follow {self.count}")
        self.add(span.head)
        for level, block in span.blocks:
            self.count += self._size << level
            self._count_blocks(level)
            self._carry(block, level)
        self.add(span.tail)

    def _count_blocks(self, level: int) -> None:
        """Count the blocks that make up one of a level, and their joins."""
        self._blocks += 1 << level
        self.error += STRIDE // 2 << level
        while len(self._levels) < level:
            self._levels.append(None)
            self._upper.append(False)
        for below in range(level):
            joins = 1 << (level - below - 1)
            self._upper[below] ^= bool(joins % 2)
            self.error += STRIDE * joins << below

    def _carry(self, block: npt.NDArray[Any], level: int = 0) -> None:
        """Put a sorted block at the lowest free level, joined with those of the levels below.

        level: of the block, the lowest at which it may be put.
        """
        while level < len(self._levels):
            other = self._levels[level]
            if other is None:
                self._levels[level] = block
                return
            # Taking the upper and the lower of each pair in turn makes the shifts cancel, mostly.
            block = _join(block, other, upper=self._upper[level])
            self._upper[level] = not self._upper[level]
            self._levels[level] = None
            self.error += STRIDE << level
            level += 1
        self._levels.append(block)
        self._upper.append(False)

    def middle(self, beyond: int) -> tuple[float, float]:
        """The range of all values but some of the least and of the greatest.

        beyond: number of values left out at either end, 0 to (count - 1) // 2.

        Without error, the ends are the values with the ranks `beyond` and `count - 1 - beyond`.
        Else they are values outside of these, and the number left out is at least
        `beyond - 2 * error`, less the number of values that one held value stands for. An end is
        infinite where no value held is known to lie outside.
        """
        held = [] if self._block is None else [(self._block[: self._held], 1)]
        for level, block in enumerate(self._levels):
            held += [] if block is None else [(block, STRIDE << level)]
        values = np.concatenate([block for block, _ in held])
        weights = np.concatenate([np.full(block.size, each, np.int64) for block, each in held])
        order = np.argsort(values, kind="stable")
        values, weights = values[order], weights[order]
        first, last = self._end_index(weights, beyond), self._end_index(weights[::-1], beyond)
        return (
            -math.inf if first is None else exact_number(values[first].item()),
            math.inf if last is None else exact_number(values[::-1][last].item()),
        )

    def _end_index(self, weights: npt.NDArray[np.int64], beyond: int) -> int | None:
        """The place of an end among the sorted values, seen from that side; None if unknown."""
        so_far = np.cumsum(weights)
        if self.error == 0:
            return int(np.searchsorted(so_far, beyond, side="right"))
        place = int(np.searchsorted(so_far, beyond - self.error, side="right")) - 1
        return None if place < 0 else place


class RanksSpan:
    """A sketch of neighbouring values of many, for `Ranks.extend`; another machine may make it.

    Its blocks are those that the sketch of all values would make of them, by their places.

    Attributes:
        first: number of values before these.
        size: values of a block.
        head, tail: values before the first and after the last whole block.
        blocks: level and values of each sorted block between them, in their order.
    """

    def __init__(self, first: int, size: int = SIZE) -> None:
        """Begin without values."""
        self.first, self.size = first, size
        self.head = self.tail = np.empty(0)
        self.blocks: list[tuple[int, npt.NDArray[Any]]] = []
        self._missing = -first % size  # values of the head that are yet to come
        self._place = (first + self._missing) // size  # number of the next block among all

    def add(self, values: npt.NDArray[Any]) -> None:
        """Add finite values of an array of any shape; all arrays are of one real type."""
        flat = values.reshape(-1)
        head, rest = flat[: self._missing], flat[self._missing :]
        self.head = np.concatenate((self.head.astype(flat.dtype, copy=False), head))
        self._missing -= head.size
        rest = np.concatenate((self.tail.astype(flat.dtype, copy=False), rest))
        whole = rest.size // self.size * self.size
        for start in range(0, whole, self.size):
            self._push(_sketched(rest[start : start + self.size], self._place))
        self.tail = rest[whole:].copy()

    def _push(self, block: npt.NDArray[Any]) -> None:
        """Add a sorted block, joined with those before it that make a pair with it."""
        level, place = 0, self._place
        while place % 2 and self.blocks and self.blocks[-1][0] == level:
            _, other = self.blocks.pop()
            block = _join(block, other, upper=bool(place // 2 % 2))
            level, place = level + 1, place // 2
        self.blocks.append((level, block))
        self._place += 1


def _sketched(values: npt.NDArray[Any], number: int) -> npt.NDArray[Any]:
    """Every STRIDE-th of the values of a block in their order.

    number: of the block; taking the upper and the lower middle in turn makes the shifts cancel.
    """
    # Those of few bits are sorted by their digits.
    order = np.sort(values, kind="stable" if values.itemsize <= 2 else None)
    return order[(STRIDE - 1) // 2 + number % 2 :: STRIDE].copy()


def _join(block: npt.NDArray[Any], other: npt.NDArray[Any], *, upper: bool) -> npt.NDArray[Any]:
    """Every second value of two sorted blocks, the upper or the lower one of each pair."""
    both = np.concatenate((block, other))
    both.sort(kind="stable")
    return both[int(upper) :: 2].copy()
