"""Colours and extinctions of values by a transfer function, in the arrays of a device."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fhash_codec.rendering.task.arrays import NUMPY, Array, Arrays
from fhash_codec.rendering.task.task import Table

__all__ = ["Palette"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Palette:
    """A `Table` in arrays of `arrays`.

    Attributes:
        low, high: values of the first and the last entry.
        colours: float64 (n, 3), 0..1.
        extinctions: float64 (n,), per unit of the coordinates.
        opaque_before: int64 (n + 1,), number of entries before each one that have an extinction.
    """

    arrays: Arrays
    low: float
    high: float
    colours: Array
    extinctions: Array
    opaque_before: Array

    @classmethod
    def of(cls, table: Table, arrays: Arrays = NUMPY) -> Palette:
        """The palette of a table."""
        opaque_before = np.concatenate([[0], np.cumsum(table.extinctions > 0)])
        return cls(
            arrays=arrays,
            low=table.low,
            high=table.high,
            colours=arrays.array(table.colours, "float64"),
            extinctions=arrays.array(table.extinctions, "float64"),
            opaque_before=arrays.array(opaque_before, "int64"),
        )

    def colour(self, values: Array) -> Array:
        """Colours (n, 3) of finite values (n,), linear between the entries."""
        before, share = self._located(values)
        share = share[:, None]
        return self.colours[before] * (1 - share) + self.colours[before + 1] * share

    def extinction(self, values: Array) -> Array:
        """Extinctions (n,) of finite values (n,), linear between the entries."""
        xp = self.arrays.xp
        before, share = self._located(values)
        low = xp.take(self.extinctions, before)
        return low + share * (xp.take(self.extinctions, before + 1) - low)

    def visible(self, low: Array, high: Array) -> Array:
        """Whether a value between `low` and `high` has an extinction.

        False where one of the two is NaN or `low` is above `high`.
        """
        xp, last = self.arrays.xp, len(self.extinctions) - 1
        ordered = low <= high
        first, stop = (
            xp.clip(self._entry(xp.where(ordered, ends, 0.0)), 0, last) for ends in (low, high)
        )
        first, stop = self.arrays.to_int64(xp.floor(first)), self.arrays.to_int64(xp.ceil(stop))
        return ordered & (
            xp.take(self.opaque_before, stop + 1) > xp.take(self.opaque_before, first)
        )

    def _entry(self, values: Array) -> Array:
        """Positions of values among the entries, fractional.

        They are infinite where the table is so narrow that float64 does not hold them.
        """
        with np.errstate(over="ignore"):
            return (values - self.low) / (self.high - self.low) * (len(self.extinctions) - 1)

    def _located(self, values: Array) -> tuple[Array, Array]:
        """The entry before each value, and the weight 0..1 of the entry after it."""
        last = len(self.extinctions) - 1
        entry = self.arrays.xp.clip(self._entry(values), 0, last)
        before = self.arrays.xp.clip(self.arrays.to_int64(entry), None, last - 1)
        return before, entry - before
