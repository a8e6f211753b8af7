"""The table of a transfer function where rays are marched: colours and extinctions of values, and whether anything of a cell is seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fhash_codec.rendering.task.arrays import NUMPY, Array, Arrays
from fhash_codec.rendering.task.task import Table

__all__ = ["Palette"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Palette:
    """A `Table` in arrays of `arrays`: colours float64 (n, 3), extinctions float64 (n,), 0 wherever a value is NaN."""

    arrays: Arrays
    low: float
    high: float
    colours: Array
    extinctions: Array
    seen: Array

    @classmethod
    def of(cls, table: Table, arrays: Arrays = NUMPY) -> Palette:
        """seen: int64 (n + 1,), how many entries before one have an extinction."""
        return cls(
            arrays=arrays,
            low=table.low,
            high=table.high,
            colours=arrays.array(table.colours, "float64"),
            extinctions=arrays.array(table.extinctions, "float64"),
            seen=arrays.array(np.concatenate([[0], np.cumsum(table.extinctions > 0)]), "int64"),
        )

    def colour(self, values: Array) -> Array:
        """Colours (n, 3) of finite values (n,), linear between the entries."""
        before, share = self._located(values)
        share = share[:, None]
        return self.colours[before] * (1 - share) + self.colours[before + 1] * share

    def extinction(self, values: Array) -> Array:
        """Extinctions of finite values, both (n,), linear between the entries."""
        xp = self.arrays.xp
        before, share = self._located(values)
        low = xp.take(self.extinctions, before)
        return low + share * (xp.take(self.extinctions, before + 1) - low)

    def visible(self, low: Array, high: Array) -> Array:
        """Whether some value between two has an extinction; False where they are NaN or the lower is above the higher."""
        xp, last = self.arrays.xp, len(self.extinctions) - 1
        known = low <= high
        first, stop = (
            xp.clip(self._entry(xp.where(known, ends, 0.0)), 0, last) for ends in (low, high)
        )
        first, stop = self.arrays.whole(xp.floor(first)), self.arrays.whole(xp.ceil(stop))
        return known & (xp.take(self.seen, stop + 1) > xp.take(self.seen, first))

    def _entry(self, values: Array) -> Array:
        """Values in entries of the table, beyond what float64 holds where it is as narrow as that allows."""
        with np.errstate(over="ignore"):
            return (values - self.low) / (self.high - self.low) * (len(self.extinctions) - 1)

    def _located(self, values: Array) -> tuple[Array, Array]:
        """The entry before each value, and the share of the one after it."""
        last = len(self.extinctions) - 1
        entry = self.arrays.xp.clip(self._entry(values), 0, last)
        before = self.arrays.xp.clip(self.arrays.whole(entry), None, last - 1)
        return before, entry - before
