"""The coder of predicted integers without the native library: twin of native/predict.cpp.

It gives the same bytes in plain Python, some thousand times slower. The comments there give the
reasons.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import DamagedFileError
from fhash_formats.transform.entropy.mixing_portable import (
    LEARNING_RATE,
    LISTS,
    SLOW_LIMIT,
    Stream,
    code_bit,
    code_simple,
    finish,
    learn,
    log16,
    memory_of,
    mix,
    start_range,
)
from fhash_formats.transform.entropy.predictor import CLASSES, Pass, Predictor
from fhash_formats.transform.entropy.prior import State

__all__ = ["decode", "encode"]

Integers = npt.NDArray[np.int32]
Lattice = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]
Index = tuple[int, ...]
"""Index (t, z, y, x) of a vertex, or (t, z, y) of a row."""

CONTEXTS = 7
"""Estimates that are mixed for a decision."""
LANES = 14
"""Weights of a set."""
DECISIONS = 16
"""Decisions of a difference: zero, sign, and "more than k" for k from 1 to UNARY."""
UNARY = 14
"""Largest magnitude that is coded in unary; larger ones have an escape code."""
LEVELS = 48
"""Levels of the expected difference."""
HALF_LEVELS = 24
"""Coarser levels of the expected difference."""
ACTIVITIES = 32
"""Classes of how far the taps differ from the base."""
SLOPES = 27
"""Classes of how far the two vertices of the base differ."""
SIZES = (
    LEVELS * 5,
    ACTIVITIES * SLOPES,
    CLASSES * HALF_LEVELS * 5,
    3125,
    81 * 5 * 8,
    81 * HALF_LEVELS,
    ACTIVITIES * HALF_LEVELS * 5,
)
"""Contexts of each estimate; each context has a slot per decision."""
STARTS = tuple(sum(SIZES[:i]) for i in range(CONTEXTS))
"""First context of each estimate."""
ESCAPES = 160
"""First simple estimate of the escape code, after those of low bits."""
ROWS = 192
"""First simple estimate of rows without a difference."""
SIDE = 20
"""Weight of the differences to the left and above in the expected difference."""
BEFORE = 15
"""Weight of the differences in the layer below and the step before."""
DIAGONAL = 7
"""Weight of the differences beside those above and before."""
COARSE = 4
"""Weight of the differences in the lattice that is known."""
MAX_VALUE = 1 << 27
"""Largest magnitude of an integer."""
CLIP = 4095
"""Largest difference that contexts see."""
ACTIVE = 14
"""Number of taps, the first ones, that make up the activity."""
MAX_TAP_ACTIVITY = 1 << 24
"""Largest share of one tap in the activity."""
FRACTION_BITS = 13
"""Fractional bits of a prediction."""
DAMAGED = "the predicted integers of a tile are damaged"


class Prediction(NamedTuple):
    """Prediction of a vertex.

    Attributes:
        value: the prediction, in 1/8192.
        base: twice the base.
        activity: sum of how far the taps differ from the base.
        slope: how far the two vertices of the base differ.
        step: difference from twice the base at the same vertex one step before; None without one.
    """

    value: int
    base: int
    activity: int
    slope: int
    step: int | None

    @property
    def rounded(self) -> int:
        """The nearest integer."""
        return (self.value + (1 << FRACTION_BITS - 1)) >> FRACTION_BITS


class Conditions(NamedTuple):
    """The numbers that the decisions about one difference depend on.

    Attributes:
        context: of each estimate.
        level: class of the expected difference.
        low: number of low bits that are coded apart.
        sign: -1 where the prediction was rounded up, else 1: the sign of the likelier difference.
    """

    context: list[int]
    level: int
    low: int
    sign: int


def encode(
    integers: Integers, counted: Mask | None, predictor: Predictor, state: State
) -> tuple[bytes, Integers]:
    """The bytes, and the integers that they decode to; see `encode_predicted`."""
    q = integers.astype(np.int64)
    coder = _TileCoder(state, None)
    coder.run(q, counted, predictor)
    finish(coder.stream)
    return bytes(coder.stream.out), q.astype(np.int32)


def decode(data: bytes, shape: tuple[int, ...], predictor: Predictor, state: State) -> Integers:
    """The integers; raises DamagedFileError for bytes that no encoder writes."""
    q = np.zeros(shape, dtype=np.int64)
    _TileCoder(state, data).run(q, None, predictor)
    return q.astype(np.int32)


class _TileCoder:
    """All passes over a tile; they decode if there are bytes to decode."""

    def __init__(self, state: State, data: bytes | None) -> None:
        self.memory = memory_of(state, False)
        self.stream = Stream(data is not None, [0] * 4, data or b"", [])
        start_range(self.stream)

    def run(self, q: Lattice, counted: Mask | None, predictor: Predictor) -> None:
        """Code integers q (t, z, y, x); those that are not counted become what is predicted."""
        shift, first_weight = list(predictor.levels), 0
        coarse: Lattice = np.zeros((0, 0, 0, 0), np.int64)
        coarse_errors: Lattice = coarse
        for a_pass in predictor.passes:
            weights = predictor.weights[first_weight : first_weight + len(a_pass.taps)]
            first_weight += len(a_pass.taps)
            if a_pass.axis >= 0:
                shift[a_pass.axis] -= 1
            where = [slice(None, None, 1 << s) for s in shift]
            fine_shape = q[tuple(where)].shape
            if a_pass.axis >= 0:
                start = 1 << shift[a_pass.axis]
                where[a_pass.axis] = slice(start, None, 2 * start)
            view = q[tuple(where)]
            if not view.size:
                continue
            pass_coder = _PassCoder(self, a_pass, weights, coarse, coarse_errors, view.shape)
            pass_coder.run(view, None if counted is None else counted[tuple(where)])
            if a_pass.axis < 0:
                coarse, coarse_errors = pass_coder.values, pass_coder.errors
                continue
            axis = a_pass.axis
            coarse = _interleaved(coarse, pass_coder.values, axis, fine_shape)
            coarse_errors = _interleaved(coarse_errors, pass_coder.errors, axis, fine_shape)

    def simple(self, bit: int, number: int) -> int:
        """Code a bit that one simple estimate predicts."""
        return code_simple(bit, number, self.stream, self.memory, LISTS.rate)

    def plain(self, bit: int) -> int:
        """Code a bit at even odds."""
        return code_bit(bit, 32768, self.stream)

    def decide(self, bit: int, k: int, conditions: Conditions, kind: int) -> int:
        """Code decision k of a difference."""
        where = [(STARTS[i] + conditions.context[i]) * DECISIONS + k for i in range(CONTEXTS)]
        inputs = [0] * LANES
        first = (kind * DECISIONS + k) * LANES
        second = ((CLASSES + conditions.level) * DECISIONS + k) * LANES
        mixer = (CONTEXTS, where, inputs, first, second)
        p = mix(*mixer, self.memory, LISTS)
        bit = code_bit(bit, p, self.stream)
        learn(*mixer, p, bit, SLOW_LIMIT, LEARNING_RATE, self.memory, LISTS.rate)
        return bit


class _PassCoder:
    """One pass: the lattice that is known and the new one, each as values and as differences.

    A difference is that of a value from its rounded prediction.
    """

    def __init__(
        self,
        coder: _TileCoder,
        a_pass: Pass,
        weights: tuple[int, ...],
        coarse: Lattice,
        coarse_errors: Lattice,
        shape: tuple[int, ...],
    ) -> None:
        self.coder, self.a_pass, self.weights = coder, a_pass, weights
        self.coarse, self.coarse_errors = coarse, coarse_errors
        self.values, self.errors = np.zeros(shape, np.int64), np.zeros(shape, np.int64)

    def run(self, q: Lattice, counted: Mask | None) -> None:
        for row in np.ndindex(self.values.shape[:3]):
            self._code_row(row, q, counted)

    def _code_row(self, row: Index, q: Lattice, counted: Mask | None) -> None:
        n = self.values.shape[3]
        near, weight = self._differences_near(row)
        if not any(near) and not self._code_whole_row(row, q, counted):
            return
        log_weight = log16(max(weight, 1), LISTS.log)
        log_with_left = log16(weight + SIDE, LISTS.log)
        for x in range(n):
            self._code_vertex((*row, x), q, counted, near[x], log_with_left if x else log_weight)

    def _code_whole_row(self, row: Index, q: Lattice, counted: Mask | None) -> int:
        """Code whether a row differs from its predictions; if not, it becomes these."""
        n, coder = self.values.shape[3], self.coder
        differs = 0
        if not coder.stream.decoding:
            for x in range(n):
                at = (*row, x)
                predicted = self._predict(at).rounded
                is_free = counted is not None and not counted[at]
                self.values[at] = predicted if is_free else int(q[at])
                differs = int(self.values[at] != predicted)
                if differs:
                    break
        moved = self.a_pass.axis >= 0 and any(self._is_lively((*row, x)) for x in range(n))
        flag = ROWS + moved + (2 if any(row) else 0) + (4 if n > 16 else 0)
        differs = coder.simple(differs, flag)
        if not differs:
            for x in range(n):
                at = (*row, x)
                q[at] = self.values[at] = self._predict(at).rounded
        return differs

    def _code_vertex(
        self, at: Index, q: Lattice, counted: Mask | None, near: int, log_weight: int
    ) -> None:
        """Code one vertex.

        Args:
            at: index of the vertex.
            q: integers of the pass, written in decoding and where they are not counted.
            counted: mask of the integers that must come back.
            near: weighted sum of the differences around, but that to the left.
            log_weight: 16 log2 of the weights of all differences.
        """
        prediction = self._predict(at)
        predicted = prediction.rounded
        error = 0
        if not self.coder.stream.decoding:
            if counted is not None and not counted[at]:
                q[at] = predicted
            error = int(q[at]) - predicted
        error = self._code_difference(error, self._conditions(at, prediction, near, log_weight))
        if abs(predicted + error) > MAX_VALUE:
            raise DamagedFileError(DAMAGED)
        q[at] = self.values[at] = predicted + error
        self.errors[at] = min(max(error, -MAX_VALUE), MAX_VALUE)

    def _conditions(
        self, at: Index, prediction: Prediction, near: int, log_weight: int
    ) -> Conditions:
        """Contexts and classes of the difference at a vertex."""
        axis, kind = self.a_pass.axis, self.a_pass.kind
        t, z, y, x = at
        p, base, activity, slope, step = prediction
        fraction = p - (prediction.rounded << FRACTION_BITS)
        sign = -1 if fraction < 0 else 1
        tenths = min((fraction * sign * 10) >> FRACTION_BITS, 4)
        left = int(self.errors[t, z, y, x - 1]) if x else 0
        above = int(self.errors[t, z, y - 1, x]) if y else 0
        below = int(self.errors[t, z - 1, y, x]) if z else 0
        before = int(self.errors[t - 1, z, y, x]) if t else 0
        coarse = 0 if axis < 0 else int(self.coarse_errors[at])
        expected = near + SIDE * _clipped(left)
        # 16 log2 of the expected difference.
        d16 = log16(expected, LISTS.log) - log_weight if expected else -1000
        level = min(max(1 + (d16 + 80) * 3 // 16, 1), LEVELS - 1) if expected else 0
        half = level // 2
        low = (d16 - 26) // 16 + 1 if d16 > 25 else 0
        lively, steep = _half_octaves(activity, ACTIVITIES - 1), _half_octaves(slope, SLOPES - 1)
        base_side = _side((base * 4096 - p) * sign)
        step_side = _side(0 if step is None else ((base + step) * 4096 - p) * sign)
        sizes = 0
        for difference in (left, above, below, before, coarse):
            sizes = sizes * 5 + _few(_clipped(difference))
        signs = 0
        for difference in (left, above, below, before):
            turned = difference * sign
            signs = signs * 3 + (2 if turned > 0 else 0 if turned < 0 else 1)
        context = [
            level * 5 + tenths,
            lively * SLOPES + steep,
            (kind * HALF_LEVELS + half) * 5 + tenths,
            sizes,
            ((base_side * 9 + step_side) * 5 + tenths) * 8 + half // 3,
            signs * HALF_LEVELS + half,
            (lively * HALF_LEVELS + half) * 5 + tenths,
        ]
        return Conditions(context, level, low, sign)

    def _code_difference(self, error: int, conditions: Conditions) -> int:
        """Code a difference: zero flag, sign and magnitude, without its low bits; then these."""
        coder, kind = self.coder, self.a_pass.kind
        low, sign = conditions.low, conditions.sign
        size = abs(error)
        magnitude, positive = size >> low, int(error * sign > 0)
        zero = coder.decide(int(magnitude == 0), 0, conditions, kind)
        if zero:
            magnitude = 0
        else:
            positive = coder.decide(positive, 1, conditions, kind)
            k = 1
            while k <= UNARY and coder.decide(int(magnitude > k), k + 1, conditions, kind):
                k += 1
            magnitude = k if k <= UNARY else self._code_escape(magnitude - UNARY) + UNARY
        first_flag = (min(low, 19) * 4 + min(magnitude, 3)) * 2
        for b in range(low - 1, -1, -1):
            bit = (size >> b) & 1
            if b > low - 3:
                bit = coder.simple(bit, first_flag + (b != low - 1))
            else:
                bit = coder.plain(bit)
            magnitude = (magnitude << 1) | bit
        if zero and magnitude:
            positive = coder.decide(positive, 1, conditions, kind)
        return magnitude * (sign if positive else -sign)

    def _code_escape(self, rest: int) -> int:
        """Code a number from 1 on as an Exp-Golomb number."""
        bits, j = max(rest, 1).bit_length() - 1, 0
        while self.coder.simple(int(j < bits), ESCAPES + min(j, 31)):
            j += 1
            if j > 28:
                raise DamagedFileError(DAMAGED)
        v = 1
        for b in range(j - 1, -1, -1):
            v = (v << 1) | self.coder.plain((rest >> b) & 1)
        return v

    def _base(self, at: Index) -> tuple[int, int]:
        """Twice the base, and the slope."""
        axis = self.a_pass.axis
        if axis < 0:
            for near in (3, 2, 1, 0):
                if at[near]:
                    return 2 * int(self.values[_moved(at, near, -1)]), 0
            return 0, 0
        first = int(self.coarse[at])
        if at[axis] + 1 >= self.coarse.shape[axis]:
            return 2 * first, 0
        second = int(self.coarse[_moved(at, axis, 1)])
        return first + second, abs(first - second)

    def _sum_taps(self, at: Index, with_row: bool) -> tuple[int, int]:
        """The weighted sum, and the activity; with_row: also of taps in the row itself."""
        base = self._base(at)[0]
        total = activity = 0
        taps = zip(self.a_pass.taps, self.weights, strict=True)
        for k, ((in_pass, *offset), weight) in enumerate(taps):
            lattice = self.values if in_pass else self.coarse
            place = tuple(a + o for a, o in zip(at, offset, strict=True))
            in_row = bool(in_pass) and not any(offset[:3])
            exists = all(0 <= a < n for a, n in zip(place, lattice.shape, strict=True))
            if not exists or (in_row and not with_row):
                continue
            d = 2 * int(lattice[place]) - base
            total += weight * d
            if k < ACTIVE and (not in_row or self.a_pass.axis < 0):
                activity += min(abs(d), MAX_TAP_ACTIVITY)
        return total, activity

    def _is_lively(self, at: Index) -> bool:
        return bool(self._sum_taps(at, False)[1] or self._base(at)[1])

    def _predict(self, at: Index) -> Prediction:
        base, slope = self._base(at)
        total, activity = self._sum_taps(at, True)
        step = None
        if self.a_pass.axis > 0 and at[0]:
            one_before = _moved(at, 0, -1)
            step = 2 * int(self.values[one_before]) - self._base(one_before)[0]
        end = MAX_VALUE << FRACTION_BITS
        return Prediction(min(max(base * 4096 + total, -end), end), base, activity, slope, step)

    def _differences_near(self, row: Index) -> tuple[list[int], int]:
        """Weighted sums of the differences known before a row, and the sum of the weights."""
        t, z, y = row
        axis, n = self.a_pass.axis, self.values.shape[3]
        near, weight = np.zeros(n, np.int64), 0
        # Differences, row, offset along x and weight of each neighbour.
        neighbours: list[tuple[Lattice, Index, int, int]] = []
        if axis >= 0:
            neighbours.append((self.coarse_errors, row, 0, COARSE))
            beyond = row if axis == 3 else _moved(row, axis, 1)
            if axis == 3 or beyond[axis] < self.coarse.shape[axis]:
                neighbours.append((self.coarse_errors, beyond, int(axis == 3), COARSE))
        if y:
            neighbours += [
                (self.errors, (t, z, y - 1), 0, SIDE),
                (self.errors, (t, z, y - 1), -1, DIAGONAL),
                (self.errors, (t, z, y - 1), 1, DIAGONAL),
            ]
        if z:
            neighbours.append((self.errors, (t, z - 1, y), 0, BEFORE))
        if t:
            neighbours += [
                (self.errors, (t - 1, z, y), 0, BEFORE),
                (self.errors, (t - 1, z, y), 1, DIAGONAL),
            ]
            if y + 1 < self.values.shape[2]:
                neighbours.append((self.errors, (t - 1, z, y + 1), 0, DIAGONAL))
        for errors, place, offset, factor in neighbours:
            line = np.minimum(np.abs(errors[place]), CLIP)
            first, last = max(0, -offset), min(n, len(line) - offset)
            near[first:last] += factor * line[first + offset : last + offset]
            weight += factor
        return near.tolist(), weight


def _interleaved(even: Lattice, odd: Lattice, axis: int, shape: tuple[int, ...]) -> Lattice:
    """Two lattices as one of a shape, their vertices by turns along an axis."""
    both: Lattice = np.zeros(shape, np.int64)
    np.moveaxis(both, axis, 0)[0::2] = np.moveaxis(even, axis, 0)
    np.moveaxis(both, axis, 0)[1::2] = np.moveaxis(odd, axis, 0)
    return both


def _moved(at: Index, axis: int, by: int) -> Index:
    return tuple(a + by if i == axis else a for i, a in enumerate(at))


def _clipped(error: int) -> int:
    return min(abs(error), CLIP)


def _few(v: int) -> int:
    """The class, 0 to 4, of a clipped difference."""
    return v if v <= 1 else 2 if v <= 3 else 3 if v <= 8 else 4


def _half_octaves(v: int, most: int) -> int:
    """The class of a number: 0 for 0, then two per doubling, at most `most`."""
    return min(1 + log16(v, LISTS.log) // 8, most) if v else 0


def _side(d: int) -> int:
    """The class, 0 to 8, of how far and to which side another prediction lies; d: in 1/8192."""
    a = abs(d)
    r = 0 if a < 1229 else 1 if a < 4096 else 2 if a < 9830 else 3 if a < 24576 else 4
    return 4 - r if d < 0 else 4 + r
