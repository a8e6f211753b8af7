"""Masks: which vertices are occupied, one bit each.

The coder gets two levels of each vertex, from the decoded values: how likely it is occupied. A row
is coded in segments of 16 vertices. A segment whose surroundings agree has a flag for "all as
these". Otherwise each bit is predicted from the bits and levels around it.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from reference.adaptive import Adaptive
from reference.kernels import mask_prior_state

Levels = npt.NDArray[Any]

SEGMENT = 16
"""Vertices of a row that share a flag."""
PAD = 2
"""Vertices around a tile that do not exist."""
BOUNDS = (
    *(1, 2, 3, 4, 6, 8, 11, 15, 20, 27, 36, 48, 64, 85, 110, 128, 155, 190, 230, 275, 325),
    *(385, 455, 540, 640, 760, 900, 1100, 1350, 1700, 2200),
)
"""Sums of scores from which on a vertex has level 1, 2, ..."""
SIZES = (512, 1024, 4096, 2048, 2048, 1920, 2592, 4096, 4096, 2048)
"""Contexts of each of the ten estimates of a bit."""
STARTS = [sum(SIZES[:i]) for i in range(len(SIZES))]
MIXED, NOTHING = 2, 3
"""States of a segment that has both bits, and of one that does not exist."""


def mask_levels(values: npt.NDArray[Any], settings: dict[str, Any]) -> tuple[Levels, Levels]:
    """The two levels, 0 to 31 and 0 to 15, of each vertex, from decoded values."""
    with np.errstate(over="ignore"):
        edges = np.array(settings["edges"], values.dtype)
    classes = sum((values >= edge).astype(int) for edge in edges) + np.zeros(values.shape, int)
    reach, scores = settings["reach"], np.array(settings["scores"][0])[classes]
    levels = np.array([bisect_right(BOUNDS, n) for n in range(4096)])
    others = [summed(np.array(one)[classes], reach) for one in settings["scores"][1:]]
    second = others[0] if others else scores
    return levels[summed(scores, reach)], levels[second] // 2


def summed(scores: Levels, reach: int) -> Levels:
    """Sums of all scores within `reach` along z, then y, then x, each at most 4095."""
    for axis in (1, 2, 3) if reach else ():
        padded = np.pad(scores, [(reach * (i == axis),) * 2 for i in range(4)])
        n = scores.shape[axis]
        windows = (padded.take(range(k, k + n), axis) for k in range(2 * reach + 1))
        scores = np.minimum(sum(windows), 4095)
    return scores


def unpack_mask(packed: bytes | memoryview, levels: tuple[Levels, Levels]) -> npt.NDArray[Any]:
    """The mask in a section: bool (t, z, y, x). All are occupied where the section is empty."""
    if not len(packed):
        return np.ones(levels[0].shape, bool)
    return MaskDecoder(packed, levels).run()


def common(states: Sequence[int], nothing: int, mixed: int) -> tuple[int, int]:
    """The state that segments have, as far as they exist, or `mixed`; and how many exist."""
    existing = [state for state in states if state != nothing]
    same = nothing if not existing else existing[0] if len(set(existing)) == 1 else mixed
    return same, len(existing)


class MaskDecoder:
    """The bits known so far, and the levels of all.

    A mark of a known vertex is its bit, and above it 1 for a 0 that the level spoke against and 2
    for such a 1.
    """

    def __init__(self, data: bytes | memoryview, levels: tuple[Levels, Levels]) -> None:
        prior = mask_prior_state()
        self.adaptive = Adaptive(data, prior.slots, prior.weights, prior.simples)
        self.first, self.second = (level.astype(int) for level in levels)
        self.shape = self.first.shape
        self.informed = bool(self.first.any())
        self.marks = np.zeros([n + 2 * PAD for n in self.shape], int)
        segments = [*self.shape[:3], -(-self.shape[3] // SEGMENT)]
        self.states = np.full([n + 1 for n in segments], NOTHING)  # index -1 is none

    def run(self) -> npt.NDArray[Any]:
        """The mask."""
        for t, z, y in product(*map(range, self.shape[:3])):
            for s in range(self.states.shape[3] - 1):
                row = range(s * SEGMENT, min((s + 1) * SEGMENT, self.shape[3]))
                state = self.uniform(t, z, y, s, row)
                if state == NOTHING:
                    bits = {self.bit(t, z, y, x) for x in row}
                    state = bits.pop() if len(bits) == 1 else MIXED
                self.states[t, z, y, s] = state
        return (self.marks[(slice(PAD, -PAD),) * 4] & 1).astype(bool)

    def uniform(self, t: int, z: int, y: int, s: int, row: range) -> int:
        """The state of a segment whose flag says that its bits are all the same; else NOTHING."""
        states = self.states
        before = (states[t, z, y, s - 1], states[t, z, y - 1, s] if y else NOTHING)
        before += (
            states[t, z - 1, y, s] if z else NOTHING,
            states[t - 1, z, y, s] if t else NOTHING,
        )
        same, existing = common([int(state) for state in before], NOTHING, MIXED)
        levels = self.first[t, z, y, row.start : row.stop]
        low, high = int(levels.min()), int(levels.max())
        if same == NOTHING:
            same = 0 if not self.informed or high < 4 else 1 if low > 27 else MIXED
        away = 0 if not self.informed else 31 - low if same == 1 else high
        if same == MIXED or away >= 12:
            return NOTHING
        if not self.adaptive.simple((same * 3 + away // 4) * 5 + existing):
            return NOTHING
        for x in row:
            self.keep(t, z, y, x, same)
        return same

    def keep(self, t: int, z: int, y: int, x: int, bit: int) -> None:
        """Keep the bit of a vertex."""
        expected = int(self.first[t, z, y, x] >= 16)
        surprise = (2 if bit else 1) if bit != expected else 0
        self.marks[t + PAD, z + PAD, y + PAD, x + PAD] = bit | surprise << 1

    def bit(self, t: int, z: int, y: int, x: int) -> int:
        """Decode the bit of a vertex."""

        def mark(*offset: int) -> int:
            at = tuple(i + PAD + by for i, by in zip((t, z, y, x), offset, strict=True))
            return int(self.marks[at])

        def known(*offset: int) -> int:
            return mark(*offset) & 1

        def level(axis: int) -> int:
            at = [t, z, y, x]
            at[axis] = min(at[axis] + 1, self.shape[axis] - 1)
            return int(self.first[tuple(at)])

        w, n, p, b = known(0, 0, 0, -1), known(0, 0, -1, 0), known(0, -1, 0, 0), known(-1, 0, 0, 0)
        nw, ne = known(0, 0, -1, -1), known(0, 0, -1, 1)
        pw, pe, pn, ps = (known(0, -1, j, i) for j, i in ((0, -1), (0, 1), (-1, 0), (1, 0)))
        bw, be, bn, bs = (known(-1, 0, j, i) for j, i in ((0, -1), (0, 1), (-1, 0), (1, 0)))
        bp, bf = known(-1, -1, 0, 0), known(-1, 1, 0, 0)
        w2, n2, p2, b2 = (
            known(0, 0, 0, -2),
            known(0, 0, -2, 0),
            known(0, -2, 0, 0),
            known(-2, 0, 0, 0),
        )
        a = int(self.first[t, z, y, x])
        ahead, south, front, later = (level(axis) >> 2 for axis in (3, 2, 1, 0))
        nearest = digits(w, n, p, b)
        before = digits(b, be, bw, bs, bn, bf, bp)
        sums = (w + n + nw + ne) * 6 + p + pw + pe + ps + pn
        sums = sums * 8 + b + bw + be + bs + bn + bf + bp
        against = a
        for offset in ((0, 0, 0, -1), (0, 0, -1, 0), (0, -1, 0, 0), (-1, 0, 0, 0)):
            against = against * 3 + (mark(*offset) >> 1)
        contexts = (
            a * 16 + nearest,
            (a * 16 + int(self.second[t, z, y, x])) * 2 + w,
            nearest | digits(w2, nw, ne, n2, pe, ps, be, bs) << 4,
            (((a >> 1) * 8 + ahead) * 8 + south) * 2 + w,
            (((a >> 1) * 8 + front) * 8 + later) * 2 + p,
            sums * 8 + (a >> 2),
            against,
            (a >> 3) << 10 | before | digits(w, n, p) << 7,
            nearest | digits(w2, n2, p2, b2, be, bs, bf, pe) << 4,
            (a >> 1) << 7 | before,
        )
        slots = [start + context for start, context in zip(STARTS, contexts, strict=True)]
        bit = self.adaptive.mixed(slots, (a * 20, (32 + nearest) * 20), rate=2)
        self.keep(t, z, y, x, bit)
        return bit


def digits(*bits: int) -> int:
    """Bits as one number, the lowest first."""
    return sum(bit << i for i, bit in enumerate(bits))
