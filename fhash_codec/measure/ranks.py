"""Ranks of many values in one pass: what the greatest of the least 1 % is, within a known error.

Source of the sketch: Manku, Rajagopalan and Lindsay, "Approximate medians and other quantiles in
one pass and with limited memory", SIGMOD 1998. Sorted blocks of SIZE values are joined two by two,
and every second value of the join stands for two. Each join of blocks whose values stand for w
values shifts a rank by w at most, so that the sum of these w bounds the error.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.measure.value_range import pieces
from fhash_formats.support.number_types import exact_number

SIZE = 1 << 18
"""Values of a block. With 2^34 values the error is below 1/30,000 of them, in 40 MB."""


class Ranks:
    """A sketch of the ranks of finite values that are added array by array.

    Attributes:
        count: number of values added.
        error: shift of a rank at most; 0 where all values are still held.
    """

    def __init__(self, size: int = SIZE) -> None:
        """Begin without values; size: of a block, an even number."""
        self.count = self.error = 0
        self._size = size
        self._block: npt.NDArray[Any] | None = None
        self._held = 0
        self._levels: list[npt.NDArray[Any] | None] = []
        self._upper: list[bool] = []

    def add(self, values: npt.NDArray[Any]) -> None:
        """Add the finite values of an array of any shape; all arrays are of one real type."""
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
                    block, self._block = np.sort(self._block), None
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
            self._joined_below(level)
            self._carry(block, level)
        self.add(span.tail)

    def _joined_below(self, level: int) -> None:
        """Count the joins of which a block of a level was made."""
        while len(self._levels) < level:
            self._levels.append(None)
            self._upper.append(False)
        for below in range(level):
            joins = 1 << (level - below - 1)
            self._upper[below] ^= bool(joins % 2)
            self.error += joins << below

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
            self.error += 1 << level
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
        rest = [] if self._block is None else [(self._block[: self._held], 0)]
        held = [(block, level) for level, block in enumerate(self._levels) if block is not None]
        values = np.concatenate([block for block, _ in (*held, *rest)])
        weights = np.concatenate(
            [np.full(block.size, 1 << level, np.int64) for block, level in (*held, *rest)]
        )
        order = np.argsort(values, kind="stable")
        values, weights = values[order], weights[order]
        first, last = self._place(weights, beyond), self._place(weights[::-1], beyond)
        return (
            -math.inf if first is None else exact_number(values[first].item()),
            math.inf if last is None else exact_number(values[::-1][last].item()),
        )

    def _place(self, weights: npt.NDArray[np.int64], beyond: int) -> int | None:
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
            self._push(np.sort(rest[start : start + self.size]))
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


def _join(block: npt.NDArray[Any], other: npt.NDArray[Any], *, upper: bool) -> npt.NDArray[Any]:
    """Every second value of two sorted blocks, the upper or the lower one of each pair."""
    both = np.concatenate((block, other))
    both.sort(kind="stable")
    return both[int(upper) :: 2].copy()
