"""Tiles of few distinct values: a palette, and for each vertex its number in it.

Where the rows before have one label around a vertex, and the vertex to the left has it, a flag says
that it goes on. Elsewhere labels around a vertex are its *candidates*, those that occur more often
first. A decision asks for each of the first three whether the vertex has it; a label that is none
of them is spelled bit by bit.
"""

from __future__ import annotations

import zlib
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from reference.adaptive import Adaptive

Labels = npt.NDArray[Any]

PAD = 2
"""Entries beside a row that stand for vertices that do not exist."""
AROUND = (
    *((0, 0, -1, 0), (0, -1, 0, 0), (-1, 0, 0, 0), (0, 0, -1, -1), (0, 0, -1, 1)),
    *((0, -1, 0, 1), (0, -1, 0, -1), (0, -1, 1, 0), (0, -1, -1, 0)),
    *((-1, 0, 0, 1), (-1, 0, 0, -1), (-1, 0, 1, 0), (-1, 0, -1, 0), (-1, 1, 0, 0), (-1, -1, 0, 0)),
    *((0, 0, -2, 0), (0, -2, 0, 0), (-2, 0, 0, 0), (0, 0, 0, -1), (0, 0, 0, -2)),
)
"""Offsets to the neighbours of a vertex."""
NEAREST = (0, 1, 2, 18)
"""Numbers of the four nearest neighbours."""
BESIDE = 15
"""Number of the first neighbours, by which a run is known."""
PLANE, BELOW, BEFORE = (0, 3, 4, 15, 18, 19), (1, 5, 6, 7, 8), (9, 10, 11, 12, 13, 14)
"""Numbers of neighbours in the same layer, in the one below and in the step before."""
RUN = 16
"""Vertices of a run, at most."""
SIZES = (6144, 49152, 12288, 65536, 65536)
"""Contexts of each of the estimates of a decision about a candidate."""
STARTS = [sum(SIZES[:i]) for i in range(6)]
LANES = 16
"""Weights of a set."""
CANDIDATE_SETS = 3 * 16 + 3 * 4
ENDS, NEXT = 10, 18
"""Numbers of simple estimates: of the end of a run, and of the label after the highest so far."""


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
    """The labels known so far.

    A row that does not exist has the labels of the last row before the one that is decoded; the
    first row of all finds zeros. Beside a row its first and its last label are repeated.
    """

    def __init__(self, data: bytes | memoryview, count: int, shape: tuple[int, ...]) -> None:
        self.count, self.shape = count, shape
        self.bit_size = 256 << min((count - 1).bit_length(), 8)
        runs = [(3 * 16, 4915), (3 * 4, 0), (16, 4096), (4, 0)]
        weights = [weight for sets, weight in runs for _ in range(sets * LANES)]
        self.adaptive = Adaptive(data, STARTS[5] + 4 * self.bit_size, weights, NEXT + 1)
        self.known = np.zeros((*shape[:3], shape[3] + 2 * PAD), int)
        self.highest, self.held = 0, 1

    def run(self) -> Labels:
        """The labels (t, z, y, x)."""
        for t, z, y in product(*map(range, self.shape[:3])):
            row, rows = self.known[t, z, y], self.rows(t, z, y)
            row[:PAD] = rows[0][PAD]
            x = 0
            while x < self.shape[3]:
                label, length = int(rows[0][x + PAD]), 0
                while row[x + PAD - 1] == label and length < min(RUN, self.shape[3] - x):
                    if set(self.around(rows, x + length)[:BESIDE]) != {label}:
                        break
                    length += 1
                end = x + self.same(length)
                row[x + PAD : end + PAD] = label
                x = end
                if length and self.held:
                    continue
                around = self.around(rows, x)
                found = self.spelled([label], around) if length else self.vertex(around)
                row[x + PAD] = found
                self.highest = max(self.highest, found)
                x += 1
            row[PAD - 1], row[-PAD] = row[PAD], row[-PAD - 1]
        return self.known[..., PAD:-PAD]

    def rows(self, t: int, z: int, y: int) -> list[Labels]:
        """The row of each neighbour of a row."""

        def row(a: int, b: int, c: int) -> Labels | None:
            at = (t + a, z + b, y + c)
            exists = all(0 <= i < n for i, n in zip(at, self.shape, strict=False))
            return self.known[at] if exists else None

        nearest = [row(0, 0, -1), row(0, -1, 0), row(-1, 0, 0), np.zeros_like(self.known[0, 0, 0])]
        last = next(one for one in nearest if one is not None)
        found = [row(*offset[:3]) for offset in AROUND]
        return [last if one is None else one for one in found]

    def around(self, rows: list[Labels], x: int) -> list[int]:
        """The labels around a vertex."""
        pairs = zip(rows, AROUND, strict=True)
        return [int(row[x + offset[3] + PAD]) for row, offset in pairs]

    def same(self, length: int) -> int:
        """The number of vertices of a run that have the label of all around."""
        if not length:
            return 0
        self.held = self.adaptive.simple(2 * (length - 1).bit_length() + self.held)
        if self.held:
            return length
        for k in range(length - 1):
            if self.adaptive.simple(ENDS + min(length - 1 - k, 7)):
                return k
        return length - 1

    def vertex(self, around: list[int]) -> int:
        """Decode the label of a vertex."""
        others = [label for label in around[:BESIDE] if label != around[0]]
        found = list(dict.fromkeys([around[0], *others[:1], around[18], *around]))[:4]
        votes = {label: around.count(label) for label in found}
        for number in NEAREST:
            if around[number] in votes:
                votes[around[number]] += 2
        candidates = sorted(found, key=lambda label: -votes[label])
        tested = candidates[:3]
        for k, candidate in enumerate(tested):
            if k == self.count - 1 or self.has(k, candidates, around):
                return candidate
        return self.spelled(tested, around)

    def has(self, k: int, candidates: list[int], around: list[int]) -> int:
        """Whether the vertex has candidate k."""

        def pattern(numbers: tuple[int, ...], label: int = candidates[k]) -> int:
            return sum((around[number] == label) << i for i, number in enumerate(numbers))

        found, near = len(candidates), pattern(NEAREST)
        plane, below, before = pattern(PLANE), pattern(BELOW), pattern(BEFORE)
        rival, of_rival = 256, 0
        if found > 1:
            other = candidates[0 if k else 1]
            rival, of_rival = self.key(other), pattern(NEAREST, other)
        both = (self.key(candidates[k]) * 259 + rival) * 16 + near
        contexts = (
            (k * 64 + plane) * 32 + below,
            ((k * 16 + near) * 16 + of_rival) * 64 + before,
            ((k * 64 + before) * 2 + pattern((2,))) * 32 + below,
            both & 65535,
            (both + pattern((3, 4, 5, 6, 7, 8)) * 40503) & 65535,
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
        if following < self.count and self.adaptive.simple(NEXT):
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
                for label in (tested[0], around[2], around[1]):
                    contexts.append((label * 40503 + node) & self.bit_size - 1)
                slots = [STARTS[5] + i * self.bit_size + c for i, c in enumerate(contexts)]
                sets = (CANDIDATE_SETS + level, CANDIDATE_SETS + 16 + len(tested))
                bit = self.adaptive.mixed(slots, [number * LANES for number in sets], rate=2)
            low = middle if bit else low
            node = node * 2 + bit
        return low

    def allowed(self, low: int, high: int, tested: list[int]) -> int:
        """Labels from `low` to before `high` that are not among the tested ones."""
        there = sum(low <= label < high for label in tested)
        return max(min(high, self.count) - low, 0) - there
