"""The coder of predicted integers without the native library: native/predict.cpp step by step, with the same bytes, in plain Python.

Its comments say what is done and why. It is some thousand times slower.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import DamagedFileError
from fhash_formats.transform.entropy.coder_portable import (
    _LISTS,
    _chance,
    _code,
    _finish,
    _learn,
    _log16,
    _memory,
    _mix,
)
from fhash_formats.transform.entropy.predictor import CLASSES, Pass, Predictor
from fhash_formats.transform.entropy.prior import State

__all__ = ["decode", "encode"]

Integers = npt.NDArray[np.int32]
Lattice = npt.NDArray[np.int64]
Care = npt.NDArray[np.bool_] | None

CONTEXTS, LANES, DECISIONS, UNARY, LEVELS, HALF_LEVELS, ACTIVITIES, SLOPES = (
    7,
    14,
    16,
    14,
    48,
    24,
    32,
    27,
)
SIZES = (
    LEVELS * 5,
    ACTIVITIES * SLOPES,
    CLASSES * HALF_LEVELS * 5,
    3125,
    81 * 5 * 8,
    81 * HALF_LEVELS,
    ACTIVITIES * HALF_LEVELS * 5,
)
STARTS = tuple(sum(SIZES[:i]) for i in range(CONTEXTS))
ESCAPES, ROWS = 160, 192
SIDE, BEFORE, DIAGONAL, COARSE = 20, 15, 7, 4
MOST, CLIP, ACTIVE, SLOW_LIMIT = 1 << 27, 4095, 14, 400


def encode(
    integers: Integers, care: Care, predictor: Predictor, state: State
) -> tuple[bytes, Integers]:
    """The bytes, and the integers that they decode to."""
    q = integers.astype(np.int64)
    coder = _Coder(state, None)
    coder.all(q, care, predictor)
    _finish(coder.span, coder.out)
    return bytes(coder.out), q.astype(np.int32)


def decode(data: bytes, shape: tuple[int, ...], predictor: Predictor, state: State) -> Integers:
    """The integers; raises DamagedFileError for bytes that no encoder writes."""
    q = np.zeros(shape, dtype=np.int64)
    _Coder(state, data).all(q, None, predictor)
    return q.astype(np.int32)


class _Coder:
    """One run over a tile, which decodes if it is given bytes."""

    def __init__(self, state: State, data: bytes | None) -> None:
        self.memory = _memory(state, False)
        self.decodes, self.data = data is not None, data or b""
        self.out: list[int] = []
        first = self.data[:4].ljust(4, b"\0")
        self.span = [0, 0xFFFFFFFF, int.from_bytes(first, "big"), 4]

    def all(self, q: Lattice, care: Care, predictor: Predictor) -> None:
        shift, at = list(predictor.levels), 0
        coarse: Lattice = np.zeros((0, 0, 0, 0), np.int64)
        errors: Lattice = coarse
        for part in predictor.passes:
            weights = predictor.weights[at : at + len(part.taps)]
            at += len(part.taps)
            if part.axis >= 0:
                shift[part.axis] -= 1
            where = [slice(None, None, 1 << s) for s in shift]
            fine = q[tuple(where)].shape
            if part.axis >= 0:
                where[part.axis] = slice(1 << shift[part.axis], None, 2 << shift[part.axis])
            view = q[tuple(where)]
            if not view.size:
                continue
            found: tuple[Lattice, Lattice] = (
                np.zeros(view.shape, np.int64),
                np.zeros(view.shape, np.int64),
            )
            _Run(self, part, weights, (coarse, errors), found).run(
                view, None if care is None else care[tuple(where)]
            )
            if part.axis < 0:
                coarse, errors = found
                continue
            both: tuple[Lattice, Lattice] = np.zeros(fine, np.int64), np.zeros(fine, np.int64)
            for whole, old, new in zip(both, (coarse, errors), found, strict=True):
                np.moveaxis(whole, part.axis, 0)[0::2] = np.moveaxis(old, part.axis, 0)
                np.moveaxis(whole, part.axis, 0)[1::2] = np.moveaxis(new, part.axis, 0)
            coarse, errors = both

    def simple(self, bit: int, number: int) -> int:
        return _chance(
            bit, number, self.decodes, self.memory, _LISTS.rate, self.span, self.data, self.out
        )

    def plain(self, bit: int) -> int:
        return _code(bit, 32768, self.decodes, self.span, self.data, self.out)

    def decide(self, bit: int, k: int, context: list[int], kind: int, level: int) -> int:
        where = [(STARTS[i] + context[i]) * DECISIONS + k for i in range(CONTEXTS)]
        inputs = [0] * LANES
        first, second = (kind * DECISIONS + k) * LANES, ((CLASSES + level) * DECISIONS + k) * LANES
        p = _mix(CONTEXTS, where, inputs, first, second, self.memory, _LISTS)
        bit = _code(bit, p, self.decodes, self.span, self.data, self.out)
        _learn(CONTEXTS, where, inputs, first, second, p, bit, SLOW_LIMIT, self.memory, _LISTS.rate)
        return bit


class _Run:
    """One pass: the known lattice and that of the pass, each as values and differences."""

    def __init__(
        self,
        coder: _Coder,
        part: Pass,
        weights: tuple[int, ...],
        coarse: tuple[Lattice, Lattice],
        found: tuple[Lattice, Lattice],
    ) -> None:
        self.coder, self.part, self.weights = coder, part, weights
        self.coarse, self.coarse_errors = coarse
        self.values, self.errors = found
        self.last = (0, 0, 0, 0)

    def run(self, q: Lattice, care: Care) -> None:
        for row in np.ndindex(self.values.shape[:3]):
            self._row(row, q, care)

    def _row(self, row: tuple[int, ...], q: Lattice, care: Care) -> None:
        t, z, y = row
        n = self.values.shape[3]
        coder, axis = self.coder, self.part.axis
        known, weight = self._known(row)
        if not any(known):
            wrong = 0
            if not coder.decodes:
                for x in range(n):
                    r = self._rounded(self._predict((*row, x))[0])
                    value = r if care is not None and not care[(*row, x)] else int(q[(*row, x)])
                    self.values[(*row, x)] = value
                    wrong = int(value != r)
                    if wrong:
                        break
            moved = axis >= 0 and any(self._lively((*row, x)) for x in range(n))
            wrong = coder.simple(
                wrong, ROWS + moved + (2 if t + z + y else 0) + (4 if n > 16 else 0)
            )
            if not wrong:
                for x in range(n):
                    q[(*row, x)] = self.values[(*row, x)] = self._rounded(
                        self._predict((*row, x))[0]
                    )
                return
        logs = _log16(max(weight, 1), _LISTS.log), _log16(weight + SIDE, _LISTS.log)
        for x in range(n):
            self._vertex((*row, x), q, care, known[x], logs[x > 0])

    def _vertex(
        self, at: tuple[int, ...], q: Lattice, care: Care, known: int, log_weight: int
    ) -> None:
        coder, axis, kind = self.coder, self.part.axis, self.part.kind
        t, z, y, x = at
        p, base, activity, slope, step = self._predict(at)
        r = self._rounded(p)
        fraction = p - r * 8192
        sign = -1 if fraction < 0 else 1
        part = min((fraction * sign * 10) >> 13, 4)
        left = int(self.errors[t, z, y, x - 1]) if x else 0
        above = int(self.errors[t, z, y - 1, x]) if y else 0
        under = int(self.errors[t, z - 1, y, x]) if z else 0
        ago = int(self.errors[t - 1, z, y, x]) if t else 0
        beside = 0 if axis < 0 else int(self.coarse_errors[at])
        mu = known + SIDE * _clipped(left)
        d16 = _log16(mu, _LISTS.log) - log_weight if mu else -1000
        level = min(max(1 + (d16 + 80) * 3 // 16, 1), LEVELS - 1) if mu else 0
        half = level // 2
        low = (d16 - 26) // 16 + 1 if d16 > 25 else 0
        lively, steep = _half_octaves(activity, ACTIVITIES - 1), _half_octaves(slope, SLOPES - 1)
        other = _side((base * 4096 - p) * sign)
        before = _side(0 if step is None else ((base + step) * 4096 - p) * sign)
        few = [_few(_clipped(e)) for e in (left, above, under, ago, beside)]
        turned = [
            2 if e * sign > 0 else 0 if e * sign < 0 else 1 for e in (left, above, under, ago)
        ]
        context = [
            level * 5 + part,
            lively * SLOPES + steep,
            (kind * HALF_LEVELS + half) * 5 + part,
            (((few[0] * 5 + few[1]) * 5 + few[2]) * 5 + few[3]) * 5 + few[4],
            ((other * 9 + before) * 5 + part) * 8 + half // 3,
            (((turned[0] * 3 + turned[1]) * 3 + turned[2]) * 3 + turned[3]) * HALF_LEVELS + half,
            (lively * HALF_LEVELS + half) * 5 + part,
        ]
        error = 0
        if not coder.decodes:
            if care is not None and not care[at]:
                q[at] = r
            error = int(q[at]) - r
        error = self._difference(error, sign, low, context, level)
        if abs(r + error) > MOST:
            raise DamagedFileError("the predicted integers of a tile are damaged")
        q[at] = self.values[at] = r + error
        self.errors[at] = min(max(error, -MOST), MOST)

    def _difference(self, error: int, sign: int, low: int, context: list[int], level: int) -> int:
        coder, kind = self.coder, self.part.kind
        size = abs(error)
        magnitude, positive = size >> low, int(error * sign > 0)
        zero = coder.decide(int(magnitude == 0), 0, context, kind, level)
        if not zero:
            positive = coder.decide(positive, 1, context, kind, level)
            k = 1
            while k <= UNARY and coder.decide(int(magnitude > k), k + 1, context, kind, level):
                k += 1
            if k == UNARY + 1:
                rest = magnitude - UNARY
                bits, j = max(rest, 1).bit_length() - 1, 0
                while coder.simple(int(j < bits), ESCAPES + min(j, 31)):
                    j += 1
                    if j > 28:
                        raise DamagedFileError("the predicted integers of a tile are damaged")
                v = 1
                for b in range(j - 1, -1, -1):
                    v = (v << 1) | coder.plain((rest >> b) & 1)
                k = v + UNARY
            magnitude = k
        else:
            magnitude = 0
        about = (min(low, 19) * 4 + min(magnitude, 3)) * 2
        for b in range(low - 1, -1, -1):
            bit = (size >> b) & 1
            magnitude = (magnitude << 1) | (
                coder.simple(bit, about + (b != low - 1)) if b > low - 3 else coder.plain(bit)
            )
        if zero and magnitude:
            positive = coder.decide(positive, 1, context, kind, level)
        return magnitude * (sign if positive else -sign)

    # -- what is known of a vertex ------------------------------------------------------------------------------------------------

    def _base(self, at: tuple[int, ...]) -> tuple[int, int]:
        """Twice the base, and the slope."""
        axis = self.part.axis
        if axis < 0:
            for near in (3, 2, 1, 0):
                if at[near]:
                    return 2 * int(self.values[_moved(at, near, -1)]), 0
            return 0, 0
        one = int(self.coarse[at])
        if at[axis] + 1 >= self.coarse.shape[axis]:
            return 2 * one, 0
        other = int(self.coarse[_moved(at, axis, 1)])
        return one + other, abs(one - other)

    def _taps(self, at: tuple[int, ...], own: bool) -> tuple[int, int]:
        """The weighted sum, and the activity; own: also of taps in the row itself."""
        base = self._base(at)[0]
        total = activity = 0
        for k, ((inside, *offset), weight) in enumerate(
            zip(self.part.taps, self.weights, strict=True)
        ):
            lattice = self.values if inside else self.coarse
            place = tuple(a + o for a, o in zip(at, offset, strict=True))
            in_row = bool(inside) and not any(offset[:3])
            if (in_row and not own) or not all(
                0 <= a < n for a, n in zip(place, lattice.shape, strict=True)
            ):
                continue
            d = 2 * int(lattice[place]) - base
            total += weight * d
            if k < ACTIVE and (not in_row or self.part.axis < 0):
                activity += min(abs(d), 1 << 24)
        return total, activity

    def _lively(self, at: tuple[int, ...]) -> bool:
        return bool(self._taps(at, False)[1] or self._base(at)[1])

    def _predict(self, at: tuple[int, ...]) -> tuple[int, int, int, int, int | None]:
        """The prediction in 1/8192, twice the base, activity, slope, and how the step before differed from its base."""
        base, slope = self._base(at)
        total, activity = self._taps(at, True)
        step = None
        if self.part.axis > 0 and at[0]:
            ago = _moved(at, 0, -1)
            step = 2 * int(self.values[ago]) - self._base(ago)[0]
        end = MOST << 13
        return min(max(base * 4096 + total, -end), end), base, activity, slope, step

    @staticmethod
    def _rounded(p: int) -> int:
        return (p + 4096) >> 13

    def _known(self, row: tuple[int, ...]) -> tuple[list[int], int]:
        """Weighted differences around the vertices of a row that are known beforehand, and the weights."""
        t, z, y = row
        axis, n = self.part.axis, self.values.shape[3]
        known, weight = np.zeros(n, np.int64), 0
        rows: list[tuple[Lattice, tuple[int, ...], int, int]] = []
        if axis >= 0:
            rows.append((self.coarse_errors, row, 0, COARSE))
            beyond = row if axis == 3 else _moved(row, axis, 1)
            if axis == 3 or beyond[axis] < self.coarse.shape[axis]:
                rows.append((self.coarse_errors, beyond, int(axis == 3), COARSE))
        if y:
            rows += [
                (self.errors, (t, z, y - 1), offset, DIAGONAL if offset else SIDE)
                for offset in (0, -1, 1)
            ]
        if z:
            rows.append((self.errors, (t, z - 1, y), 0, BEFORE))
        if t:
            rows += [
                (self.errors, (t - 1, z, y), 0, BEFORE),
                (self.errors, (t - 1, z, y), 1, DIAGONAL),
            ]
            if y + 1 < self.values.shape[2]:
                rows.append((self.errors, (t - 1, z, y + 1), 0, DIAGONAL))
        for errors, place, offset, factor in rows:
            line = np.minimum(np.abs(errors[place]), CLIP)
            first, last = max(0, -offset), min(n, len(line) - offset)
            known[first:last] += factor * line[first + offset : last + offset]
            weight += factor
        return known.tolist(), weight


def _moved(at: tuple[int, ...], axis: int, by: int) -> tuple[int, ...]:
    return tuple(a + by if i == axis else a for i, a in enumerate(at))


def _clipped(error: int) -> int:
    return min(abs(error), CLIP)


def _few(v: int) -> int:
    return v if v <= 1 else 2 if v <= 3 else 3 if v <= 8 else 4


def _half_octaves(v: int, most: int) -> int:
    return min(1 + _log16(v, _LISTS.log) // 8, most) if v else 0


def _side(d: int) -> int:
    a = abs(d)
    r = 0 if a < 1229 else 1 if a < 4096 else 2 if a < 9830 else 3 if a < 24576 else 4
    return 4 - r if d < 0 else 4 + r
