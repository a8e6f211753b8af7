"""Coded integers: coefficients, residuals, missing values, and blocks of settings.

Integers come band by band, each band row by row along x. A decision is predicted from what is
known around the vertex in its band and around the vertices of earlier bands that refer to the same
place: a zero flag; a sign; then "more than k" for k = 1, 2, ... up to an escape code. With two
quantisers the coded number is an index, of which each class of quantisers makes other integers.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from reference.adaptive import Adaptive, clamp, log16, squashed
from reference.bands import Band, single_band
from reference.kernels import prior_state

KINDS, LEVELS, DECISIONS = 64, 128, 16
UNARY = 14
"""Magnitudes from this one on have an escape code."""
MOST = 4095
"""Largest magnitude that contexts see."""
SIZES = (LEVELS, 729, 12**3, 7**4)
"""Contexts of each of the four estimates of a magnitude, which has a slot for each decision."""
SIGN_SIZES = tuple(KINDS * n for n in (27, 108, 81, 25))
"""Contexts of each of the four estimates of a sign."""


def starts(sizes: Sequence[int], first: int = 0) -> list[int]:
    """The beginnings of some runs that follow each other."""
    return [first + sum(sizes[:i]) for i in range(len(sizes))]


MAGNITUDE_STARTS = starts([size * DECISIONS for size in SIZES])
SIGN_STARTS = starts(SIGN_SIZES, sum(SIZES) * DECISIONS)
LANES = 8
"""Weights of a set for magnitudes."""
BY_LEVEL = DECISIONS * KINDS * LANES
"""First weight of the sets chosen by the expected magnitude, after those chosen by the kind."""
SIGN_SETS = BY_LEVEL + DECISIONS * 64 * LANES
"""First weight of signs."""
SIGN_SET = 16
"""Weights of a set for signs: two of each estimate, then that of the linear logit."""
LINEAR = SIGN_SETS + KINDS * SIGN_SET
"""First weight of the linear predictors of signs."""
INPUTS = 96
"""Inputs of a linear predictor."""
EMPTY_ROWS = LEVELS * 64
"""First simple estimate of empty rows, after those of the escape code."""
EMPTY_BANDS = EMPTY_ROWS + 8

AFTER = ((0, 2), (5, 7), (1, 3), (6, 4), (2, 0), (4, 6), (3, 1), (7, 5))
"""State of the two quantisers after an even and after an odd index."""

LEFT = {(0, 0, 0, -1): 184, (0, 0, 0, -2): 20}
ABOVE = {(0, 0, -1, 0): 184, (0, 0, -1, -1): 61, (0, 0, -1, 1): 61}
ABOVE2 = {(0, 0, -2, 0): 41}
SIDES = ((0, -1), (0, 1), (-1, 0), (1, 0))
BEFORE = {(-1, 0, 0, 0): 102, **{(-1, 0, y, x): 20 for y, x in SIDES}}
BEFORE_Z = {(-1, -1, 0, 0): 20, (-1, 1, 0, 0): 20}
BEFORE2 = {(-2, 0, 0, 0): 31}
BELOW = {(0, -1, 0, 0): 102, **{(0, -1, y, x): 20 for y, x in SIDES}}
BELOW2 = {(0, -2, 0, 0): 31}
NEIGHBOURS = {**LEFT, **ABOVE, **ABOVE2, **BEFORE, **BEFORE_Z, **BEFORE2, **BELOW, **BELOW2}
"""Offsets along t, z, y, x to vertices known before, and their weights in the expected magnitude
in 1/1024."""
REFERENCE = 62
"""Weight of the vertex of a reference; the sum around it has 20."""

CONSISTENT = (
    *((3, 0, 0, 0, -1), (6, 0, 0, -1, 0), (13, 0, -1, 0, 0)),
    *((25, -1, 0, 0, 0), (5, 0, 0, -1, -1), (7, 0, 0, -1, 1)),
)
"""Inputs of a sign that are compared with what a reference has at the same offset."""
PAD = 4
"""Zeros around a band on each side, for vertices that do not exist."""


class BandNumbers:
    """The integers of a band, or indices of two quantisers, within +-MOST, with zeros around."""

    def __init__(self, band: Band) -> None:
        self.band = band
        self.n = tuple(high - low for low, high in zip(band.low, band.high, strict=True))
        padded = [length + 2 * PAD for length in self.n]
        self.strides = tuple(int(np.prod(padded[axis + 1 :])) for axis in range(4))
        self.numbers = [0] * int(np.prod(padded))
        self.filled = np.zeros(self.n[:3], bool)

    def offset(self, *moves: int) -> int:
        """Distance in `numbers` between two vertices, some vertices apart along t, z, y, x."""
        return sum(i * stride for i, stride in zip(moves, self.strides, strict=True))

    def place(self, *index: int) -> int:
        """Place of a vertex in `numbers`."""
        return PAD * sum(self.strides) + self.offset(*index)


def decode_block(data: bytes | memoryview, shape: Sequence[int]) -> npt.NDArray[np.int32]:
    """Integers (t, z, y, x) that were not transformed."""
    return decode_integers(data, shape, single_band(shape))


def decode_integers(
    data: bytes | memoryview,
    shape: Sequence[int],
    bands: Sequence[Band],
    two_quantisers: bool = False,
) -> npt.NDArray[np.int32]:
    """Integers (t, z, y, x) of a shape, 0 outside the bands."""
    result = np.zeros(tuple(shape), np.int32)
    decoder = IntegerDecoder(data, two_quantisers)
    for band in bands:
        decoder.decode_band(band, result)
    return result


class IntegerDecoder:
    """The decoder of a tile: the bands known so far, and what was learned from them."""

    def __init__(self, data: bytes | memoryview, two_quantisers: bool) -> None:
        prior = prior_state(two_quantisers)
        self.adaptive = Adaptive(data, prior.slots, prior.weights, prior.simples)
        self.signs = [LinearSigns(self.adaptive, kind) for kind in range(KINDS)]
        self.two_quantisers = two_quantisers
        self.state = 0
        self.known: list[BandNumbers] = []

    def decode_band(self, band: Band, result: npt.NDArray[np.int32]) -> None:
        """Decode the next band into its place in `result`."""
        known = BandNumbers(band)
        self.known.append(known)
        self.present, self.kind = known, band.kind
        self.reach = {offset: known.offset(*offset) for offset in NEIGHBOURS}
        box = result[tuple(slice(a, b) for a, b in zip(band.low, band.high, strict=True))]
        if not self.adaptive.simple(EMPTY_BANDS + band.kind):
            self.skip_zeros(box.size)
            return
        for t, z, y in product(*map(range, known.n[:3])):
            row = box[t, z, y]
            if self.row_is_coded(t, z, y):
                offset = 160 - log16(self.weight_of_neighbours(t, z, y))
                for x in range(len(row)):
                    row[x] = self.vertex(t, z, y, x, offset)
            else:
                self.skip_zeros(row.size)

    def skip_zeros(self, n: int) -> None:
        """Follow the state over n zeros; it repeats after at most four."""
        for _ in range(n % 4):
            self.state = AFTER[self.state][0]

    def row_is_coded(self, t: int, z: int, y: int) -> bool:
        """Whether a row has integers other than 0; without any around, a decision tells."""
        filled = self.present.filled
        around = (y and filled[t, z, y - 1]) or (z and filled[t, z - 1, y])
        around = around or (t and filled[t - 1, z, y])
        parent = self.present.band.references[0]
        if parent is not None:
            other = self.known[parent.band]
            at = self._referred(parent, (t, z, y))
            around = around or other.filled[at]
        if around:
            return True
        number = EMPTY_ROWS + 2 * (self.present.n[3] > 24) + 4 * (t == z == y == 0)
        return bool(self.adaptive.simple(number + bool(y > 1 and filled[t, z, y - 2])))

    def _referred(self, reference: Any, at: Sequence[int]) -> tuple[int, ...]:
        """The index in the band of a reference for an index in the present band."""
        n = self.known[reference.band].n
        return tuple(min(i >> k, m - 1) for i, k, m in zip(at, reference.halvings, n, strict=False))

    def weight_of_neighbours(self, t: int, z: int, y: int) -> int:
        """Sum of the weights in the expected magnitude of a row's vertices."""
        groups = [LEFT, *[ABOVE] * (y > 0), *[ABOVE2] * (y > 1), *[BEFORE] * (t > 0)]
        groups += [*[BEFORE2] * (t > 1), *[BELOW] * (z > 0), *[BELOW2] * (z > 1)]
        weight = sum(sum(group.values()) for group in groups)
        references = sum(r is not None for r in self.present.band.references)
        return weight + references * (REFERENCE + 2 * 20)

    def vertex(self, t: int, z: int, y: int, x: int, offset: int) -> int:
        """The integer at a vertex of the present band.

        offset: what 16 log2 of the weighted sum is less than 16 log2 of the expected magnitude.
        """
        known, band = self.present, self.present.band
        at = known.place(t, z, y, x)
        m = {place: abs(known.numbers[at + by]) for place, by in self.reach.items()}
        expected = sum(weight * m[place] for place, weight in NEIGHBOURS.items())
        around = [0, 0, 0, 0]  # sums around the vertices of the references
        for k, reference in enumerate(band.references):
            if reference is not None:
                other = self.known[reference.band]
                to = other.place(*self._referred(reference, (t, z, y, x)))
                centre = abs(other.numbers[to])
                around[k] = 2 * centre + sum(
                    abs(other.numbers[to + by])
                    for by in (-1, 1, -other.strides[2], other.strides[2])
                )
                expected += REFERENCE * centre + 20 * around[k]
        level = clamp((log16(expected) + offset) // 4 + 1, 0, LEVELS - 1) if expected else 0
        self.contexts(level, m, around)

        one = self.state & 1 if self.two_quantisers else 0  # class of the quantiser
        if self.decision(0, one):
            self.state = AFTER[self.state][0]
            return 0
        known.filled[t, z, y] = True
        negative = self.sign(t, z, y, x, at)
        k = 1
        while k < UNARY and self.decision(k, one):
            k += 1
        if k == UNARY:
            k = self.escaped(level)
        if self.two_quantisers:
            self.state = AFTER[self.state][k & 1]
        known.numbers[at] = -min(k, MOST) if negative else min(k, MOST)
        magnitude = min(2 * k - one if self.two_quantisers else k, 0x7FFFFFFF)
        return -magnitude if negative else magnitude

    def contexts(self, level: int, m: dict[Any, int], around: list[int]) -> None:
        """Choose the contexts of the four estimates, and the sets of mixing weights."""
        left, left2, up = m[0, 0, 0, -1], m[0, 0, 0, -2], m[0, 0, -1, 0]
        up_left, up_right = m[0, 0, -1, -1], m[0, 0, -1, 1]
        near = 2 * up + up_left + up_right + m[0, 0, -2, 0] + 2 * left + left2
        before = m[-1, 0, 0, 0] + sum(m[place] for place in (*BEFORE, *BEFORE_Z))
        below = m[0, -1, 0, 0] + sum(m[place] for place in BELOW)
        coarse = min(level // 2, 63)
        beside = 0
        for magnitude in (left, up, up_left, up_right, m[-1, 0, 0, 0], m[0, -1, 0, 0]):
            beside = beside * 3 + min(magnitude, 2)
        others = 0
        for total in around:
            others = others * 7 + min(size_class(total), 6)
        self.coarse = coarse
        self.context = (
            level,
            beside,
            (size_class(near) * 12 + size_class(before)) * 12 + size_class(below),
            others,
        )

    def decision(self, k: int, one: int) -> int:
        """Decision k at the present vertex: whether it is 0 for k = 0, else whether more than k.

        The first two are others for class 1 of two quantisers.
        """
        k = UNARY + k if one and k < 2 else k
        slots = [
            start + context * DECISIONS + k
            for start, context in zip(MAGNITUDE_STARTS, self.context, strict=True)
        ]
        by_kind = (k * KINDS + self.kind) * LANES
        return self.adaptive.mixed(slots, (by_kind, BY_LEVEL + (k * 64 + self.coarse) * LANES))

    def escaped(self, level: int) -> int:
        """A magnitude from UNARY on: an Exp-Golomb number."""
        first, bits = level * 64, 0
        while self.adaptive.simple(first + min(bits, 20)):
            bits += 1
            if bits > 30:
                raise ValueError("an escape code of more than 30 bits")
        value = 1
        for i in range(bits - 1, -1, -1):
            number = first + 21 + min(bits, 19) * 2 + (i != bits - 1)
            value = value << 1 | self.adaptive.simple(number)
        return min(value + UNARY - 1, 0x7FFFFFFF)

    def sign(self, t: int, z: int, y: int, x: int, at: int) -> int:
        """Whether the integer at a vertex is negative."""
        inputs = self.sign_inputs(t, z, y, x, at)
        return self.signs[self.kind].decode(inputs, y, x)

    def sign_inputs(self, t: int, z: int, y: int, x: int, at: int) -> list[int]:
        """The 96 inputs of a linear predictor of a sign: logarithms with signs."""

        def near(*offset: int) -> int:
            return octaves(self.present.numbers[at + self.present.offset(*offset)])

        to = [near(0, 0, 0, i) for i in (-4, -3, -2, -1)]
        to += [near(0, 0, -1, i) for i in (-2, -1, 0, 1)]
        to += [near(0, -1, row, i) for row in (-1, 0, 1) for i in (-1, 0, 1, 2)]
        to += [near(-1, 0, row, i) for row in (-1, 0, 1) for i in (-1, 0, 1, 2)]
        to += [near(0, 0, -1, 2), near(0, 0, -2, 0), near(0, -2, 0, 0)]
        to += [near(-1, -1, 0, 0), near(-1, 1, 0, 0), near(-2, 0, 0, 0)]
        to += [0] * (INPUTS - len(to))
        for k, reference in enumerate(self.present.band.references):
            if reference is None:
                continue
            other = self.known[reference.band]
            place = other.place(*self._referred(reference, (t, z, y, x)))

            def there(*offset: int, other: BandNumbers = other, place: int = place) -> int:
                return octaves(other.numbers[place + other.offset(*offset)])

            first = 40 + 8 * k
            to[first : first + 4] = [there(0, 0, 0, i) for i in (-1, 0, 1, 2)]
            to[first + 4 : first + 6] = [there(0, 0, -1, 0), there(0, 0, 1, 0)]
            to[first + 6 : first + 8] = [there(0, -1, 0, 0), there(0, 1, 0, 0)]
            centre = there(0, 0, 0, 0)
            if k == 0:
                to[38] = centre if x & 1 else -centre
                to[39] = centre if y & 1 else -centre
            if reference.halvings[3] == 0:  # a neighbour here, the same there, and the centre there
                for i, (number, *by) in enumerate(CONSISTENT):
                    to[72 + 6 * k + i] = consistent(to[number], there(*by), centre)
        return to


class LinearSigns:
    """The linear predictor of signs of one kind, and the estimates that are mixed with it.

    A weight learns at a rate by the mean square of its gradient.
    """

    RATES = tuple(
        min(int(0.006 * 8388608 * np.exp(-i / 32 * 0.69314718055994531) + 0.5), 32767)
        for i in range(241)
    )
    """Rate of each class of a mean square, 16 to an octave."""

    def __init__(self, adaptive: Adaptive, kind: int) -> None:
        first = LINEAR + kind * 2 * INPUTS
        self.adaptive, self.kind = adaptive, kind
        self.weights = adaptive.weights[first : first + INPUTS]
        self.squares = adaptive.weights[first + INPUTS : first + 2 * INPUTS]
        self.rates = [self.rate(square) for square in self.squares]
        self.sums, self.uses = [0] * INPUTS, 0

    def rate(self, square: int) -> int:
        """Rate of a weight whose gradient has this mean square."""
        return self.RATES[min(log16(max(square, 1)), 240)]

    def decode(self, inputs: list[int], y: int, x: int) -> int:
        """A sign, 1 for a negative one, of a vertex whose indices are y and x."""
        dot = sum(w * i for w, i in zip(self.weights, inputs, strict=True))
        dot = (dot + (1 << 31)) % (1 << 32) - (1 << 31)  # the sum wraps at 32 bits
        logit = clamp(dot >> 14, -2047, 2047)
        sets = (SIGN_SETS + self.kind * SIGN_SET,)
        slots = self.slots(inputs, logit, y, x)
        bit = self.adaptive.mixed(slots, sets, most_uses=255, more=[logit])
        self.learn(inputs, (65535 * bit - squashed(logit)) >> 1)
        return bit

    def slots(self, inputs: list[int], logit: int, y: int, x: int) -> list[int]:
        """The four estimates of a sign."""
        sign = [sign_class(value) for value in inputs]
        left, up, up_left, up_right = (sign[i] for i in (3, 6, 5, 7))
        below, before = (sign[i] for i in (13, 25))
        parent, parent_t, parent_z = (sign[i] for i in (41, 49, 57))
        contexts = (
            in_threes(before, below, left),
            in_threes(parent, parent_t, parent_z) * 4 + (x & 1) * 2 + (y & 1),
            in_threes(up_left, up_right, left, up),
            clamp((logit + 12 * 85 + 42) // 85, 0, 24),
        )
        sizes = (size // KINDS for size in SIGN_SIZES)
        return [
            start + self.kind * size + context
            for start, size, context in zip(SIGN_STARTS, sizes, contexts, strict=True)
        ]

    def learn(self, inputs: list[int], error: int) -> None:
        """Learn from half the difference between the bit and the linear prediction."""
        for i, value in enumerate(inputs):
            gradient = clamp((error * value + 32768) >> 16, -181, 181)
            change = (gradient * self.rates[i] + 256) >> 9
            self.weights[i] = clamp(self.weights[i] + change, -32767, 32767)
            self.sums[i] += gradient * gradient >> 4
        self.uses += 1
        if self.uses % 32 == 0:
            for i in range(INPUTS):
                self.squares[i] += ((self.sums[i] >> 1) - self.squares[i] + 8) >> 4
                self.rates[i] = self.rate(self.squares[i])
            self.sums = [0] * INPUTS


OCTAVES: list[int] = np.floor(256 * np.log2(1.0 + np.arange(MOST + 1)) + 0.5).astype(int).tolist()


def octaves(number: int) -> int:
    """256 log2(1 + |number|), with the sign of the number."""
    return OCTAVES[number] if number >= 0 else -OCTAVES[-number]


def sign_class(number: int) -> int:
    """0 for a negative number, 1 for 0, 2 for a positive number."""
    return (number > 0) - (number < 0) + 1


def in_threes(*classes: int) -> int:
    """Classes from 0 to 2 as the digits of one number."""
    return int("".join(map(str, classes)), 3)


def size_class(magnitude: int) -> int:
    """The class, 0 to 11, of a magnitude or of a sum of some."""
    bounds = (1, 2, 3, 5, 7, 10, 15, 23, 37, 65, 141)
    return sum(magnitude >= bound for bound in bounds)


def consistent(a: int, b: int, c: int) -> int:
    """The least of three magnitudes, with the product of their signs."""
    least = min(abs(a), abs(b), abs(c))
    return -least if (a < 0) ^ (b < 0) ^ (c < 0) else least
