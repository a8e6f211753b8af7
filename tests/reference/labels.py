"""Tiles of few distinct values: a palette, and for each vertex its number in it.

Labels around a vertex that are known are its *candidates*, those that occur more often first. A
decision asks for each of the first three whether the vertex has it; a label that is none of them
is spelled bit by bit. Where all labels around are alike, one estimate tells whether the vertex has
that label, too. Rows have segments with flags, as masks have.
"""

from __future__ import annotations

import zlib
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from reference.adaptive import Adaptive
from reference.masks import PAD, SEGMENT, common

Labels = npt.NDArray[Any]

NONE, MIXED, NOTHING = 65536, 65537, 65538
"""Label of a vertex that does not exist; states of segments, as of masks."""
AROUND = (
    *((0, 0, 0, -1), (0, 0, -1, 0), (0, -1, 0, 0), (-1, 0, 0, 0)),
    *((0, 0, -1, -1), (0, 0, -1, 1)),
    *((0, -1, 0, 1), (0, -1, 0, -1), (0, -1, 1, 0), (0, -1, -1, 0)),
    *((-1, 0, 0, 1), (-1, 0, 0, -1), (-1, 0, 1, 0), (-1, 0, -1, 0), (-1, 1, 0, 0), (-1, -1, 0, 0)),
    *((0, 0, 0, -2), (0, 0, -2, 0), (0, -2, 0, 0), (-2, 0, 0, 0)),
)
"""Offsets to the neighbours of a vertex; the first four are the nearest."""
PLANE, BELOW, BEFORE = (0, 1, 4, 5, 16, 17), (2, 6, 7, 8, 9), (3, 10, 11, 12, 13, 14, 15)
"""Numbers of the neighbours in the same layer, in the one below and in the step before."""
DIAGONAL = (6, 8, 10, 12)
SIZES = (3072, 6144, 6144, 8192, 65536, 1008, 12288, 12288)
"""Contexts of each of the eight estimates of a decision about a candidate."""
STARTS = [sum(SIZES[:i]) for i in range(9)]
LANES = 16
"""Weights of a set."""
CANDIDATE_SETS = 3 * 16 + 3 * 4
ALIKE, RUNS = 11, 4
"""First simple estimate of vertices amid equal labels; classes of how many had the label, too."""


def unpack_labelled(
    body: memoryview, shape: tuple[int, ...], dtype: np.dtype[Any], masked: bool
) -> tuple[Labels, npt.NDArray[Any] | None]:
    """The values of a tile of labels, and which are occupied; None without a mask."""
    size, body = number_in(body)
    length, body = number_in(body)
    steps = unpack_planes(body[:length], np.dtype(f"u{dtype.itemsize}"))
    palette = np.cumsum(steps, dtype=steps.dtype)
    # The label after the last of the palette stands for vertices that are not occupied.
    labels = LabelDecoder(body[length:], size + masked, shape).run()
    values = np.append(palette, [palette.dtype.type(0)])[labels]
    return values.view(dtype), labels < size if masked else None


def number_in(data: memoryview) -> tuple[int, memoryview]:
    """The number at the start of some bytes (LEB128), and the bytes after it."""
    number = shift = 0
    while True:
        byte, data = data[0], data[1:]
        number |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            return number, data


def unpack_planes(data: memoryview, dtype: np.dtype[Any]) -> Labels:
    """Values of deflated bytes: the lowest bytes of all values, then the next ones, and so on."""
    plain = np.frombuffer(zlib.decompress(data), np.uint8)
    planes = np.ascontiguousarray(plain.reshape(dtype.itemsize, -1).T)
    return planes.view(dtype.newbyteorder("<")).reshape(-1).astype(dtype)


class LabelDecoder:
    """The labels known so far."""

    def __init__(self, data: bytes | memoryview, count: int, shape: tuple[int, ...]) -> None:
        self.count, self.shape = count, shape
        self.bit_size = 256 << min((count - 1).bit_length(), 8)
        runs = [(3 * 16, 3072), (3 * 4, 0), (16, 4096), (4, 0)]
        weights = [weight for sets, weight in runs for _ in range(sets * LANES)]
        self.adaptive = Adaptive(data, STARTS[8] + 4 * self.bit_size, weights, ALIKE + 8 * RUNS)
        self.known = np.full([n + 2 * PAD for n in shape], NONE)
        segments = [*shape[:3], -(-shape[3] // SEGMENT)]
        self.states = np.full([n + 2 for n in segments], NOTHING)  # one more at each end
        self.highest = -1
        self.run_length = 0  # of vertices amid equal labels that had the label, in this segment

    def run(self) -> Labels:
        """The labels (t, z, y, x)."""
        for t, z, y in product(*map(range, self.shape[:3])):
            row = self.known[t + PAD, z + PAD, y + PAD, PAD:]
            for s in range(self.states.shape[3] - 2):
                end = min((s + 1) * SEGMENT, self.shape[3])
                same, flag = self.around_segment(t + 1, z + 1, y + 1, s + 1)
                if same < NONE and self.adaptive.simple(flag):
                    row[s * SEGMENT : end] = same
                    state = same
                else:
                    self.run_length = 0
                    for x in range(s * SEGMENT, end):
                        row[x] = self.vertex(t, z, y, x)
                        self.highest = max(self.highest, int(row[x]))
                    found = set(row[s * SEGMENT : end].tolist())
                    state = found.pop() if len(found) == 1 else MIXED
                self.states[t + 1, z + 1, y + 1, s + 1] = state
        return self.known[(slice(PAD, -PAD),) * 4]

    def around_segment(self, t: int, z: int, y: int, s: int) -> tuple[int, int]:
        """The state that all segments around one have, and the number of the flag's estimate."""
        rows = [self.states[t, z, y - 1], self.states[t, z - 1, y], self.states[t - 1, z, y]]
        near = [int(self.states[t, z, y, s - 1]), *(int(row[s]) for row in rows)]
        same, existing = common(near, NOTHING, MIXED)
        differing = any(row[s + 1] not in (NOTHING, same) for row in rows)
        return same, existing * 2 + differing

    def vertex(self, t: int, z: int, y: int, x: int) -> int:
        """Decode the label of a vertex."""
        around = [
            int(self.known[t + a + PAD, z + b + PAD, y + c + PAD, x + d + PAD])
            for a, b, c, d in AROUND
        ]
        if estimate := self.amid_equal(t, z, y, around):
            if self.adaptive.simple(estimate):
                self.run_length += 1
                return around[0]
            self.run_length = 0
            return self.spelled(around[:1], around)
        first = list(dict.fromkeys(label for label in around if label != NONE))[:4]
        # The nearest four count threefold; of those that occur as often the first is the first.
        candidates = sorted(first, key=lambda v: -around.count(v) - 2 * around[:4].count(v))
        tested = candidates[:3]
        for k, candidate in enumerate(tested):
            if k == self.count - 1 or self.has(k, candidates, around):
                return candidate
        return self.spelled(tested, around)

    def amid_equal(self, t: int, z: int, y: int, around: list[int]) -> int:
        """The simple estimate of a vertex where all labels around are alike; 0 where they differ.

        In a row that exists, a vertex beyond its ends differs from all others.
        """
        lengths = self.shape[:3]
        rows = [(t + a, z + b, y + c) for a, b, c, _ in AROUND]
        exists = [all(0 <= i < n for i, n in zip(row, lengths, strict=True)) for row in rows]
        labels = {label for label, there in zip(around, exists, strict=True) if there}
        before = (y > 0) + 2 * (z > 0) + 4 * (t > 0)
        if self.count == 1 or not before or len(labels) > 1:
            return 0
        return ALIKE + before * RUNS + min(self.run_length, RUNS - 1)

    def has(self, k: int, candidates: list[int], around: list[int]) -> int:
        """Whether the vertex has candidate k."""
        equal = [int(label == candidates[k]) for label in around]

        def pattern(numbers: tuple[int, ...]) -> int:
            return sum(equal[number] << i for i, number in enumerate(numbers))

        c, found = self.key(candidates[k]), len(candidates)
        other = self.key(candidates[0 if k else 1]) if found > 1 else 256
        near, second = pattern((0, 1, 2, 3)), pattern((16, 17, 18, 19))
        plane, below, before = pattern(PLANE), pattern(BELOW), pattern(BEFORE)
        in_plane, in_below, in_before = (
            sum(equal[number] for number in group) for group in (PLANE, BELOW, BEFORE)
        )
        mixed = (equal[2] << 6) | (equal[3] << 7) | pattern(DIAGONAL) << 8
        contexts = (
            ((k * 4 + found - 1) * 16 + near) * 16 + second,
            (k * 64 + plane) * 32 + below,
            (k * 128 + before) * 16 + near,
            ((256 if k else 0) + c) * 16 + near,
            (c * 259 + other & 4095) * 16 + near,
            ((k * 7 + in_plane) * 6 + in_below) * 8 + in_before,
            k << 12 | mixed | plane,
            k << 12 | before << 5 | below,
        )
        slots = [start + context for start, context in zip(STARTS, contexts, strict=False)]
        sets = ((k * 16 + near) * LANES, (3 * 16 + k * 4 + found - 1) * LANES)
        return self.adaptive.mixed(slots, sets, rate=2)

    def key(self, label: int) -> int:
        """A number below 256 for a label."""
        return (label * 40503 >> 8) & 255

    def spelled(self, tested: list[int], around: list[int]) -> int:
        """A label that is none of the tested ones, from its highest bit on."""
        following = self.highest + 1
        if following < self.count and self.adaptive.simple(10):
            return following
        low, node = 0, 1
        for level in range((self.count - 1).bit_length() - 1, -1, -1):
            middle = low + (1 << level)
            lower = self.allowed(low, middle, tested)
            upper = self.allowed(middle, middle + (1 << level), tested)
            if not (lower and upper):
                bit = int(not lower)
            else:
                contexts = [node]
                for label in (tested[0] if tested else 0, around[3], around[2]):
                    contexts.append((label * 40503 + node) & self.bit_size - 1)
                slots = [STARTS[8] + i * self.bit_size + c for i, c in enumerate(contexts)]
                sets = (CANDIDATE_SETS + level, CANDIDATE_SETS + 16 + len(tested))
                bit = self.adaptive.mixed(slots, [number * LANES for number in sets], rate=2)
            low = middle if bit else low
            node = node * 2 + bit
        return low

    def allowed(self, low: int, high: int, tested: list[int]) -> int:
        """Labels from `low` to before `high` that are not among the tested ones."""
        there = sum(low <= label < high for label in tested)
        return max(min(high, self.count) - low, 0) - there
