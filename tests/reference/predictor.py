"""Tiles coded by prediction: integers on ever finer lattices.

The first lattice has every 2^levels-th vertex. Each pass doubles the resolution along one axis. A
vertex of a pass lies between two known ones; its prediction is their mean, the *base*, plus a
weighted sum of how far other known vertices, the *taps*, differ from it. What is coded is the
difference from the rounded prediction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Any

import numpy as np
import numpy.typing as npt

from reference.adaptive import Adaptive, clamp, log16
from reference.integers import decode_block, starts

Lattice = npt.NDArray[Any]
Place = tuple[int, ...]

KINDS, DECISIONS, LANES = 16, 16, 14
UNARY = 14
"""Largest magnitude without an escape code."""
SIZES = (48 * 5, 32 * 27, KINDS * 24 * 5, 3125, 81 * 5 * 8, 81 * 24, 32 * 24 * 5)
"""Contexts of each of the seven estimates, with a slot for each decision."""
STARTS = starts(SIZES)
ESCAPES, ROWS = 160, 192
"""First simple estimates of the escape code and of rows without differences, after low bits."""
LARGEST = 1 << 27
"""Largest magnitude of an integer."""


@dataclass(frozen=True)
class Pass:
    """A pass along an axis (-1 for the first lattice), with its kind, taps and their weights.

    A tap is whether it lies in the lattice of the pass, and its offset there.
    """

    axis: int
    kind: int
    taps: tuple[tuple[bool, Place], ...]
    weights: tuple[int, ...] = ()


def passes_of(levels: Sequence[int], order: Sequence[int], reach: int, coded: bytes) -> list[Pass]:
    """The passes of a predictor whose weights are a coded block."""
    axes = [axis for level in range(max(levels), 0, -1) for axis in order if levels[axis] >= level]
    passes = [Pass(-1, KINDS - 1, first_taps())]
    for i, axis in enumerate(axes):
        passes.append(Pass(axis, min(len(axes) - 1 - i, KINDS - 2), taps_of(axis, reach)))
    count = sum(len(one.taps) for one in passes)
    weights = decode_block(coded, (1, 1, 1, count)).ravel().tolist()
    result = []
    for one in passes:
        own, weights = weights[: len(one.taps)], weights[len(one.taps) :]
        result.append(Pass(one.axis, one.kind, one.taps, tuple(own)))
    return result


def at(*moves: tuple[int, int]) -> Place:
    """The offset of moves, each an axis and a distance."""
    offsets = dict(moves)
    return tuple(offsets.get(axis, 0) for axis in range(4))


def first_taps() -> tuple[tuple[bool, Place], ...]:
    """Taps of the first lattice: vertices before this one."""
    pairs = list(combinations(range(4), 2))
    places = [at((axis, -1)) for axis in range(4)]
    places += [at((a, -1), (b, -1)) for a, b in pairs]
    places += [at((axis, -2)) for axis in range(4)]
    places += [at((a, -1), (b, 1)) for a, b in pairs]
    return tuple((True, place) for place in places)


def taps_of(axis: int, reach: int) -> tuple[tuple[bool, Place], ...]:
    """Taps of a pass; vertices 0 and 1 of the known lattice lie beside the vertex."""
    others = [other for other in range(4) if other != axis]
    known = [at((axis, 1)), at((axis, -1)), at((axis, 2))]
    known += [at((axis, n), (other, s)) for other in others for n in (0, 1) for s in (-1, 1)]
    own = [at((axis, -1)), *(at((other, -1)) for other in others)]
    if reach > 0:
        own += [at((other, -2)) for other in others]
        pairs = [*combinations(others, 2), *((min(axis, o), max(axis, o)) for o in others)]
        own += [at((first, -1), (second, side)) for first, second in pairs for side in (-1, 1)]
    corners = []
    if reach > 1:
        sides = list(product((0, 1), (-1, 1), (-1, 1)))
        corners = [
            at((axis, near), (first, a), (second, b))
            for first, second in combinations(others, 2)
            for near, a, b in sides
        ]
    return (
        *((False, place) for place in known),
        *((True, place) for place in own),
        *((False, place) for place in corners),
    )


def decode_predicted(
    data: bytes | memoryview, shape: Sequence[int], levels: Sequence[int], passes: Sequence[Pass]
) -> Lattice:
    """The integers (t, z, y, x) of a tile."""
    weights = [4096] * (KINDS * DECISIONS * LANES) + [0] * (48 * DECISIONS * LANES)
    adaptive = Adaptive(data, sum(SIZES) * DECISIONS, weights, 200)
    result, shift = np.zeros(tuple(shape), np.int64), list(levels)
    errors = np.zeros_like(result)  # differences of all known integers from their predictions
    for one in passes:
        known = tuple(slice(None, None, 1 << s) for s in shift)
        where = list(known)
        if one.axis >= 0:
            shift[one.axis] -= 1
            step = 1 << shift[one.axis]
            where[one.axis] = slice(step, None, 2 * step)
        new = tuple(where)
        coder = PassDecoder(adaptive, one, (result[known], errors[known]), result[new].shape)
        coder.run()
        result[new], errors[new] = coder.values, coder.errors
    return result.astype(np.int32)


class PassDecoder:
    """One pass: the known lattice and its own, each as values and as differences (`errors`)."""

    def __init__(
        self, adaptive: Adaptive, one: Pass, known: tuple[Lattice, Lattice], shape: Place
    ) -> None:
        self.adaptive, self.one = adaptive, one
        self.known, self.known_errors = known
        self.values, self.errors = np.zeros(shape, np.int64), np.zeros(shape, np.int64)

    def run(self) -> None:
        """Decode all vertices in C order, row by row."""
        n = self.values.shape[3]
        for row in product(*map(range, self.values.shape[:3])):
            near, weight = self.errors_near(row)
            vertices = [(*row, x) for x in range(n)]
            if not near.any() and n:  # a decision tells whether the row differs at all
                lively = self.one.axis >= 0 and any(self.is_lively(place) for place in vertices)
                if not self.adaptive.simple(ROWS + lively + 2 * any(row) + 4 * (n > 16)):
                    for place in vertices:
                        self.values[place] = rounded(self.predict(place)[0])
                    continue
            for place in vertices:
                total = weight + 20 * (place[3] > 0)
                self.vertex(place, int(near[place[3]]), log16(max(total, 1)))

    def errors_near(self, row: Place) -> tuple[Lattice, int]:
        """Weighted sums of the differences known before a row; and the sum of the weights."""
        t, z, y = row
        axis, n = self.one.axis, self.values.shape[3]
        terms: list[tuple[Lattice, Place, int, int]] = []  # lattice, row, offset along x, weight
        if axis >= 0:
            terms.append((self.known_errors, row, 0, 4))
            beyond = tuple(i + (k == axis) for k, i in enumerate(row))
            if axis == 3 or beyond[axis] < self.known.shape[axis]:
                terms.append((self.known_errors, beyond, int(axis == 3), 4))
        if y:
            terms += [(self.errors, (t, z, y - 1), x, w) for x, w in ((0, 20), (-1, 7), (1, 7))]
        if z:
            terms.append((self.errors, (t, z - 1, y), 0, 15))
        if t:
            terms += [(self.errors, (t - 1, z, y), 0, 15), (self.errors, (t - 1, z, y), 1, 7)]
            if y + 1 < self.values.shape[2]:
                terms.append((self.errors, (t - 1, z, y + 1), 0, 7))
        near = np.zeros(n, np.int64)
        for lattice, place, offset, weight in terms:
            line = np.minimum(np.abs(lattice[place]), 4095)
            first, last = max(0, -offset), min(n, len(line) - offset)
            near[first:last] += weight * line[first + offset : last + offset]
        return near, sum(weight for *_, weight in terms)

    def base(self, place: Place) -> tuple[int, int]:
        """Twice the base, and how far the two vertices of it differ."""
        axis = self.one.axis
        if axis < 0:
            before = next((moved(place, k, -1) for k in (3, 2, 1, 0) if place[k]), None)
            return (2 * int(self.values[before]) if before else 0), 0
        first = second = int(self.known[place])
        if place[axis] + 1 < self.known.shape[axis]:
            second = int(self.known[moved(place, axis, 1)])
        return first + second, abs(first - second)

    def taps(self, place: Place, with_row: bool) -> tuple[int, int]:
        """Weighted sum of the taps, and the activity: how far the first 14 differ from the base.

        with_row: whether taps in the row itself count.
        """
        base, total, activity = self.base(place)[0], 0, 0
        taps = zip(self.one.taps, self.one.weights, strict=True)
        for k, ((own, offset), weight) in enumerate(taps):
            lattice = self.values if own else self.known
            there = tuple(i + by for i, by in zip(place, offset, strict=True))
            in_row = own and not any(offset[:3])
            exists = all(0 <= i < n for i, n in zip(there, lattice.shape, strict=True))
            if exists and (with_row or not in_row):
                difference = 2 * int(lattice[there]) - base
                total += weight * difference
                if k < 14 and (not in_row or self.one.axis < 0):
                    activity += min(abs(difference), 1 << 24)
        return total, activity

    def is_lively(self, place: Place) -> bool:
        """Whether anything known outside the row differs from the base."""
        return bool(self.taps(place, False)[1] or self.base(place)[1])

    def predict(self, place: Place) -> tuple[int, int]:
        """The prediction in 1/8192, and the activity."""
        total, activity = self.taps(place, True)
        end = LARGEST << 13
        return clamp(self.base(place)[0] * 4096 + total, -end, end), activity

    def vertex(self, place: Place, near: int, log_weight: int) -> None:
        """Decode a vertex.

        near: weighted sum of the differences around it, but that to the left. log_weight: 16 log2
        of the sum of all weights.
        """
        prediction, activity = self.predict(place)
        whole = rounded(prediction)
        fraction = prediction - (whole << 13)
        sign = -1 if fraction < 0 else 1  # of the likelier difference
        around = [
            int(self.errors[moved(place, axis, -1)]) if place[axis] else 0 for axis in (3, 2, 1, 0)
        ]
        low, level = 0, 0
        if expected := near + 20 * min(abs(around[0]), 4095):
            octaves = log16(expected) - log_weight
            level = clamp(1 + (octaves + 80) * 3 // 16, 1, 47)
            low = (octaves - 26) // 16 + 1 if octaves > 25 else 0
        sides = [side(gap * sign) for gap in self.other_predictions(place, prediction)]
        # The contexts of the seven estimates.
        sizes = signs = 0
        for error in (*around, 0 if self.one.axis < 0 else int(self.known_errors[place])):
            sizes = sizes * 5 + sum(abs(error) >= bound for bound in (1, 2, 4, 9))
        for error in around:
            signs = signs * 3 + (error * sign > 0) - (error * sign < 0) + 1
        tenths, half = min((fraction * sign * 10) >> 13, 4), level // 2
        lively, steep = half_octaves(activity, 31), half_octaves(self.base(place)[1], 26)
        context = (
            level * 5 + tenths,
            lively * 27 + steep,
            (self.one.kind * 24 + half) * 5 + tenths,
            sizes,
            ((sides[0] * 9 + sides[1]) * 5 + tenths) * 8 + half // 3,
            signs * 24 + half,
            (lively * 24 + half) * 5 + tenths,
        )
        error = self.difference(sign, low, level, context)
        if abs(whole + error) > LARGEST:
            raise ValueError("a predicted integer is too large")
        self.values[place] = whole + error
        self.errors[place] = clamp(error, -LARGEST, LARGEST)

    def other_predictions(self, place: Place, prediction: int) -> tuple[int, int]:
        """Distances to the base, and to the base with its error of the step before."""
        base = self.base(place)[0]
        if self.one.axis <= 0 or not place[0]:
            return base * 4096 - prediction, 0
        before = moved(place, 0, -1)
        change = 2 * int(self.values[before]) - self.base(before)[0]
        return base * 4096 - prediction, (base + change) * 4096 - prediction

    def difference(self, sign: int, low: int, level: int, context: Sequence[int]) -> int:
        """Decode a difference: zero flag, sign, magnitude; then its `low` lowest bits."""

        def decision(k: int) -> int:
            slots = [(a + b) * DECISIONS + k for a, b in zip(STARTS, context, strict=True)]
            sets = (self.one.kind * DECISIONS + k, (KINDS + level) * DECISIONS + k)
            return self.adaptive.mixed(slots, [number * LANES for number in sets])

        magnitude = positive = 0
        zero = decision(0)
        if not zero:
            positive, magnitude = decision(1), 1
            while magnitude <= UNARY and decision(magnitude + 1):
                magnitude += 1
            if magnitude > UNARY:
                magnitude = UNARY + self.escaped()
        first = (min(low, 19) * 4 + min(magnitude, 3)) * 2
        for i in range(low - 1, -1, -1):
            plain = i <= low - 3
            bit = self.plain() if plain else self.adaptive.simple(first + (i != low - 1))
            magnitude = magnitude << 1 | bit
        if zero and magnitude:
            positive = decision(1)
        return magnitude * (sign if positive else -sign)

    def escaped(self) -> int:
        """A number from 1 on as an Exp-Golomb number."""
        bits, value = 0, 1
        while self.adaptive.simple(ESCAPES + min(bits, 31)):
            bits += 1
            if bits > 28:
                raise ValueError("an escape code of more than 28 bits")
        for _ in range(bits):
            value = value << 1 | self.plain()
        return value

    def plain(self) -> int:
        """A bit at even odds."""
        return self.adaptive.range.bit(32768)


def rounded(prediction: int) -> int:
    """The nearest integer of a prediction."""
    return (prediction + 4096) >> 13


def moved(place: Place, axis: int, by: int) -> Place:
    """A place some vertices on along an axis."""
    return tuple(i + by * (k == axis) for k, i in enumerate(place))


def half_octaves(value: int, most: int) -> int:
    """0 for 0; then two classes for each doubling."""
    return min(1 + log16(value) // 8, most) if value else 0


def side(gap: int) -> int:
    """The class, 0 to 8, of the distance to another prediction, in 1/8192, and of its side."""
    size = sum(abs(gap) >= bound for bound in (1229, 4096, 9830, 24576))
    return 4 - size if gap < 0 else 4 + size
