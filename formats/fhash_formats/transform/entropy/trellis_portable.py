"""The search for the integers of a trellis without the native library: twin of native/trellis.cpp.

It chooses the same integers: all costs are whole numbers, and their few products are made in
float32 in the same order. The comments there give the reasons.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fhash_formats.transform.entropy.coder_portable import (
    ABOVE,
    ABOVE2,
    AROUND,
    BEFORE,
    BEFORE2,
    DIAGONAL,
    LEFT,
    LEFT2,
    MAX_MAGNITUDE,
    REFERENCE,
)
from fhash_formats.transform.entropy.mixing_portable import Sequence, compiled
from fhash_formats.transform.entropy.table import (
    BAND,
    HIGH,
    LOW,
    REFERENCE_COLUMNS,
    REFERENCE_COUNT,
    REFERENCES,
    SHIFT,
    Table,
)
from fhash_formats.transform.entropy.two_quantisers import AFTER

__all__ = ["choose", "count"]

BEFORE_EVEN = tuple(next(s for s in range(8) if AFTER[2 * s] == to) for to in range(8))
"""State before each state, where an even index lies between them."""
BEFORE_ODD = tuple(next(s for s in range(8) if AFTER[2 * s + 1] == to) for to in range(8))
"""State before each state, where an odd index lies between them."""
FIRST_BUCKET = 2 * (127 - 10)
"""Half octave that is bucket 1: 2^-10, by the bits of a float32."""
COST = 32768
"""Costs of a squared step."""
NEAR_ZERO = 0.5
"""Magnitudes below it have no other candidate than zero."""
GUESSED_ZEROS = (1.3, 0.8)
"""Magnitudes that are guessed to become zero, by quantiser."""
GUESS = (0.45, 0.95)
"""Number added to half of a magnitude before it is rounded down to a guess, by quantiser."""
UNREACHED = 1 << 60
"""Cost of a state that no path has reached yet, and of a candidate that there is not."""
CHUNK = 1 << 16
"""Vertices whose candidates are found at a time."""

Integers = npt.NDArray[np.int32]


def count(
    source: npt.NDArray[Any],
    table: Table,
    buckets: npt.NDArray[np.uint8],
    counts: npt.NDArray[np.int64],
) -> None:
    """Find the buckets of all vertices and count the indices by quantiser, bucket and index."""
    found: list[Integers] = []
    begin, state = 0, 0
    for row in table:
        values = source[_place(row)]
        if source.dtype == np.int32:
            indices = (np.abs(values) + 1) // 2
            quantisers, state = _follow((indices & 1).ravel().tolist(), state)
        else:
            quantisers = np.arange(begin, begin + values.size) & 1
            indices = _guessed(values, quantisers.reshape(values.shape))
        found.append(np.minimum(indices, MAX_MAGNITUDE))
        band = buckets[begin : begin + indices.size]
        band[:] = _buckets(found, row, table).ravel()
        of = np.minimum(found[-1].ravel(), counts.shape[2] - 1)
        np.add.at(counts, (quantisers, band.astype(np.int64), of), 1)
        begin += indices.size


def choose(
    scaled: npt.NDArray[Any],
    table: Table,
    buckets: npt.NDArray[np.uint8],
    rates: Integers,
    levels: Integers,
) -> None:
    """Choose the levels of the cheapest path."""
    chunks = list(_chunks(table))
    choices = np.zeros(buckets.size, np.uint8)
    cost: Sequence = [0, *[UNREACHED] * 7]
    for row, begin, first in chunks:
        values = scaled[_place(row)].reshape(-1)[begin : begin + CHUNK]
        part = slice(first, first + values.size)
        _extend(_candidates(values, buckets[part], rates), cost, choices[part])
    state = int(np.argmin(cost))
    for row, begin, first in reversed(chunks):
        place = _place(row)
        values = scaled[place].reshape(-1)[begin : begin + CHUNK]
        part = slice(first, first + values.size)
        candidates = _candidates(values, buckets[part], rates)
        chosen, state = _trace(candidates, choices[part], state)
        band = levels[place].reshape(-1)  # a copy where the band is not the whole tile
        band[begin : begin + CHUNK] = np.where(values < 0, -chosen, chosen)
        levels[place] = band.reshape(levels[place].shape)


class _Candidates(NamedTuple):
    """Candidates of some vertices; each by quantiser and vertex.

    Attributes:
        even, odd: cost of the best index of even and of odd magnitude.
        even_index, odd_index: their magnitudes.
    """

    even: npt.NDArray[np.int64]
    odd: npt.NDArray[np.int64]
    even_index: npt.NDArray[np.int64]
    odd_index: npt.NDArray[np.int64]


def _place(row: npt.NDArray[np.int32]) -> tuple[slice, ...]:
    """The place of a band in its tile."""
    return tuple(slice(row[LOW + axis], row[HIGH + axis]) for axis in range(4))


def _chunks(table: Table) -> Iterator[tuple[npt.NDArray[np.int32], int, int]]:
    """Yield the row of a band, the first vertex of a chunk within it, and within all bands."""
    first = 0
    for row in table:
        size = int(np.prod(row[HIGH : HIGH + 4] - row[LOW : LOW + 4]))
        for begin in range(0, size, CHUNK):
            yield row, begin, first + begin
        first += size


def _follow(odd: list[int], state: int) -> tuple[npt.NDArray[np.int64], int]:
    """The quantiser of each vertex of a band, and the state after it."""
    quantisers = []
    for parity in odd:
        quantisers.append(state & 1)
        state = AFTER[2 * state + parity]
    return np.array(quantisers, np.int64), state


def _guessed(values: npt.NDArray[Any], quantisers: npt.NDArray[np.int64]) -> Integers:
    """The guess of indices where no path was found yet."""
    kind = values.dtype.type
    magnitude = np.abs(values)
    added = np.array(GUESS, np.float32).astype(kind)[quantisers]
    indices = np.maximum((magnitude * kind(0.5) + added).astype(np.int32), 1)
    is_zero = magnitude < np.array(GUESSED_ZEROS, np.float32).astype(kind)[quantisers]
    return np.where(is_zero, 0, indices).astype(np.int32)


def _shifted(padded: Integers, t: int, z: int, y: int, x: int) -> Integers:
    """A band moved by some vertices; `padded` has two zeros at all its ends."""
    return padded[
        2 + t : padded.shape[0] - 2 + t,
        2 + z : padded.shape[1] - 2 + z,
        2 + y : padded.shape[2] - 2 + y,
        2 + x : padded.shape[3] - 2 + x,
    ]


_NEIGHBOURS = (
    (ABOVE, ((0, 0, -1, 0),)),
    (DIAGONAL, ((0, 0, -1, -1), (0, 0, -1, 1))),
    (ABOVE2, ((0, 0, -2, 0),)),
    (BEFORE, ((-1, 0, 0, 0), (0, -1, 0, 0))),
    (AROUND, ((-1, 0, 0, -1), (-1, 0, 0, 1), (-1, 0, -1, 0), (-1, 0, 1, 0))),
    (AROUND, ((-1, -1, 0, 0), (-1, 1, 0, 0))),
    (AROUND, ((0, -1, 0, -1), (0, -1, 0, 1), (0, -1, -1, 0), (0, -1, 1, 0))),
    (BEFORE2, ((-2, 0, 0, 0), (0, -2, 0, 0))),
    (LEFT, ((0, 0, 0, -1),)),
    (LEFT2, ((0, 0, 0, -2),)),
)
"""Neighbours within a band by their weight in the expected magnitude: steps along t, z, y, x."""


def _weights(row: npt.NDArray[np.int32], sizes: Any) -> npt.NDArray[np.int64]:
    """Sum of the weights that exist by (t, z, y), of shape (t, z, y, 1)."""
    t, z, y = (np.arange(size) for size in sizes[:3])
    along_t = (t > 0) * (BEFORE + 4 * AROUND) + (t > 1) * BEFORE2
    along_z = (z > 0) * (BEFORE + 4 * AROUND) + (z > 1) * BEFORE2
    along_y = (y > 0) * (ABOVE + 2 * DIAGONAL) + (y > 1) * ABOVE2
    number = sum(row[REFERENCES + k * REFERENCE_COLUMNS] >= 0 for k in range(REFERENCE_COUNT))
    weight = along_t[:, None, None] + along_z[:, None] + along_y
    total: npt.NDArray[np.int64] = weight[..., None] + LEFT + LEFT2
    total += number * (REFERENCE + 2 * AROUND)
    return total


def _buckets(found: list[Integers], row: npt.NDArray[np.int32], table: Table) -> Integers:
    """The buckets of the vertices of the last band that was found."""
    own = found[-1]
    if not own.any():
        return np.zeros(own.shape, np.int32)
    padded, filled = np.pad(own, 2), own.any(axis=3)
    known = np.pad(filled, ((1, 0), (1, 0), (1, 0)))
    seen = filled | known[1:, 1:, :-1] | known[1:, :-1, 1:] | known[:-1, 1:, 1:]
    expected = np.zeros(own.shape, np.int32)
    for weight, steps in _NEIGHBOURS:
        for step in steps:
            expected += weight * _shifted(padded, *step)
    for k in range(REFERENCE_COUNT):
        reference = row[REFERENCES + k * REFERENCE_COLUMNS :][:REFERENCE_COLUMNS]
        if reference[BAND] < 0 or not found[reference[BAND]].any():
            continue
        other = found[reference[BAND]]
        wide = np.pad(other, ((0, 0), (0, 0), (1, 1), (1, 1)))
        around = 2 * other + wide[:, :, 1:-1, :-2] + wide[:, :, 1:-1, 2:]
        around += wide[:, :, :-2, 1:-1] + wide[:, :, 2:, 1:-1]
        share = REFERENCE * other + AROUND * around
        at = [
            np.minimum(np.arange(own.shape[axis]) >> reference[SHIFT + axis], other.shape[axis] - 1)
            for axis in range(4)
        ]
        expected += share[np.ix_(*at)]
        if k == 0:
            seen |= other.any(axis=3)[np.ix_(*at[:3])]
    scale = np.float32(1) / _weights(row, own.shape).astype(np.float32)
    mean: npt.NDArray[np.float32] = expected.astype(np.float32) * scale
    bucket = np.clip((mean.view(np.int32) >> 22) - FIRST_BUCKET + 1, 1, 63)
    return np.where((expected == 0) | ~seen[..., None], 0, bucket).astype(np.int32)


def _cost(error: npt.NDArray[np.float32]) -> npt.NDArray[np.int64]:
    """The costs of errors in steps."""
    # Candidates that are not looked at may be far away.
    near = np.minimum(error, np.float32(100))
    costs: npt.NDArray[np.int64]
    costs = (near * near * np.float32(COST) + np.float32(0.5)).astype(np.int64)
    return costs


def _candidates(
    values: npt.NDArray[Any], buckets: npt.NDArray[np.uint8], rates: Integers
) -> _Candidates:
    """The candidates of some vertices in both quantisers."""
    kind = values.dtype.type
    magnitude = np.abs(values)
    small = magnitude.astype(np.float32)
    near_zero = magnitude < kind(NEAR_ZERO)
    results = []
    for quantiser in range(2):
        of = rates[quantiser][buckets].astype(np.int64)
        shifted = magnitude + kind(quantiser)
        low = (shifted * kind(0.5)).astype(np.int32)
        above = (shifted - kind(2) * low.astype(values.dtype)).astype(np.float32)
        below = np.float32(2) - above
        last, place = rates.shape[2] - 1, np.arange(values.size)
        at_low = _cost(np.where(low > 0, above, small)) + of[place, np.minimum(low, last)]
        at_high = _cost(below) + of[place, np.minimum(low + 1, last)]
        at_zero = _cost(small) + of[:, 0]
        is_odd = (low & 1) == 1
        to_zero = (low == 1) & (at_zero <= at_high)
        even = np.where(is_odd, np.where(to_zero, at_zero, at_high), at_low)
        odd = np.where(is_odd, at_low, at_high)
        even_index = np.where(is_odd, np.where(to_zero, 0, low + 1), low)
        odd_index = np.where(is_odd, low, low + 1)
        results.append(
            (
                np.where(near_zero, of[:, 0], even),
                np.where(near_zero, UNREACHED, odd),
                np.where(near_zero, 0, even_index).astype(np.int64),
                odd_index.astype(np.int64),
            )
        )
    return _Candidates(*(np.stack(pair) for pair in zip(*results, strict=True)))


def _extend(candidates: _Candidates, cost: Sequence, choices: npt.NDArray[np.uint8]) -> None:
    """Extend the paths by some vertices: change their costs, and write the choices."""
    engine = compiled(_extended, ())
    even, odd = candidates.even, candidates.odd
    if engine is None:
        choices[:] = _extended(even.tolist(), odd.tolist(), cost, [0] * 8, [0] * choices.size)
        return
    kept = np.array(cost, dtype=np.int64)
    choices[:] = engine(even, odd, kept, np.zeros(8, np.int64), np.zeros(choices.size, np.int64))
    cost[:] = kept.tolist()


def _extended(
    even: Sequence, odd: Sequence, cost: Sequence, following: Sequence, choices: Sequence
) -> Sequence:
    """Extend the paths; `choices` with a bit for each state, 1 where its best index is odd."""
    for x in range(len(choices)):
        bits = 0
        for to in range(8):
            before, other = BEFORE_EVEN[to], BEFORE_ODD[to]
            by_even = cost[before] + even[before & 1][x]
            by_odd = cost[other] + odd[other & 1][x]
            if by_even > by_odd:
                bits |= 1 << to
                by_even = by_odd
            following[to] = by_even
        for to in range(8):
            cost[to] = min(following[to], UNREACHED)
        choices[x] = bits
    return choices


def _trace(
    candidates: _Candidates, choices: npt.NDArray[np.uint8], state: int
) -> tuple[Integers, int]:
    """The magnitudes of the levels of some vertices, and the state before them."""
    odd_before, levels = choices.tolist(), []
    even_index, odd_index = candidates.even_index.tolist(), candidates.odd_index.tolist()
    for x in range(len(odd_before) - 1, -1, -1):
        odd = odd_before[x] >> state & 1
        state = BEFORE_ODD[state] if odd else BEFORE_EVEN[state]
        index = (odd_index if odd else even_index)[state & 1][x]
        levels.append(2 * index - (state & 1) if index else 0)
    return np.array(levels[::-1], np.int32), state
