"""The coder of labels without the native library: twin of native/labels.cpp.

It follows that file step by step and gives the same bytes. The comments there give the reasons.
mixing_portable.py says how it runs with numba and without.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fhash_formats.transform.entropy.mixing_portable import (
    ARRAYS,
    LISTS,
    Memory,
    Sequence,
    Stream,
    Tables,
    code_mixed,
    code_simple,
    compiled,
    finish,
    memory_of,
    start_range,
)
from fhash_formats.transform.entropy.prior import State
from fhash_formats.transform.entropy.rows_portable import (
    PADDING,
    SEGMENT,
    Rows,
    common_state,
    rows_around,
)

__all__ = ["decode", "encode"]

Labels = npt.NDArray[Any]
"""Labels of type uint8, or uint16 where there are more than MAX_NARROW."""

CONTEXTS = 8
"""Estimates that are mixed for a decision about a candidate."""
BIT_CONTEXTS = 4
"""Estimates that are mixed for a bit of a label."""
LANES = 2 * CONTEXTS
"""Weights of a set."""
TESTED = 3
"""Candidates that are tested."""
FOUND = 4
"""Candidates that are looked for."""
AROUND = 20
"""Neighbours."""
NEAR = 16
"""Patterns of the four nearest neighbours."""
MAX_NARROW = 256
"""Most labels that are coded without hashes."""
NONE = 65536
"""Label of vertices that do not exist."""
ALONE = 256
"""Stands for a second candidate where there is one only."""
MIXED = NONE + 1
"""State of a segment of more than one label."""
NOTHING = NONE + 2
"""State of a segment that does not exist."""
NEXT = 10
"""Simple estimate of the label after the highest so far."""
SCATTER = 40503
"""Multiplier of hashes: 2^16 over the golden ratio."""
LEARNING_RATE = 2
"""Rate at which the mixing weights learn, in 1/16."""
SIZES = (3072, 6144, 6144, 8192, 65536, 1008, 12288, 12288, 256, 16384, 16384, 16384)
"""Contexts of each estimate: of candidates, then of bits."""
WIDE_SIZES = (*SIZES[:CONTEXTS], 65536, 65536, 65536, 65536)
"""`SIZES` of more than MAX_NARROW labels."""
STARTS = tuple(sum(SIZES[:i]) for i in range(CONTEXTS + 1))
"""First slot of each estimate of candidates, and of the first one of bits."""
CANDIDATE_SETS = TESTED * NEAR + TESTED * FOUND
"""Sets of weights of candidates."""


class Work(NamedTuple):
    """Sequences of a run.

    Attributes:
        labels: the labels, which are written in decoding.
        known: the labels that are known, with PADDING vertices at both ends of each row, after a
            row of vertices that do not exist.
        states: state of each segment, between two that do not exist at the ends of each row, after
            a row of those.
        around: labels of the neighbours of a vertex.
        candidates, votes: labels around a vertex, and how often they occur.
        where, inputs: of a decision, for `mix` and `learn`.
        highest: one entry, the highest label so far.
    """

    labels: Sequence
    known: Sequence
    states: Sequence
    around: Sequence
    candidates: Sequence
    votes: Sequence
    where: Sequence
    inputs: Sequence
    highest: Sequence


def encode(labels: Labels, count: int, state: State) -> bytes:
    """Code labels (t, z, y, x), each below `count`, and adapt the state."""
    source = labels.astype(np.int64).ravel()
    return bytes(_start(False, source, count, labels.shape, state, b"")[1])


def decode(data: bytes, count: int, shape: tuple[int, ...], state: State) -> Labels:
    """The labels that were coded; any other bytes give some labels below `count`."""
    blank = np.zeros(int(np.prod(shape)), np.int64)
    labels = _start(True, blank, count, shape, state, data)[0]
    dtype = np.uint8 if count <= MAX_NARROW else np.uint16
    return np.array(labels, dtype=dtype).reshape(shape)


def _start(
    decoding: bool,
    labels: npt.NDArray[np.int64],
    count: int,
    shape: tuple[int, ...],
    state: State,
    data: bytes,
) -> tuple[Sequence, Sequence]:
    """Make room and run: the labels, and the bytes."""
    helpers: tuple[Callable[..., Any], ...]
    helpers = (rows_around, common_state, _key, _beside, _test, _allowed, _spell)
    helpers += (_vertex, _gather, _states_around)
    engine = compiled(_run, helpers)
    memory = memory_of(state, engine is not None)
    n0, n1, n2, n3 = shape
    rows, segments = n0 * n1 * n2, -(-n3 // SEGMENT)
    work = Work(
        labels,
        np.full((rows + 1) * (n3 + 2 * PADDING), NONE, np.int64),
        np.full((rows + 1) * (segments + 2), NOTHING, np.int64),
        np.zeros(AROUND, np.int64),
        np.zeros(FOUND, np.int64),
        np.zeros(FOUND, np.int64),
        np.zeros(CONTEXTS, np.int64),
        np.zeros(LANES, np.int64),
        np.full(1, -1, np.int64),
    )
    lengths = (n0, n1, n2, n3)
    if engine is None:
        work = Work(*(sequence.tolist() for sequence in work))
        return work.labels, _run(decoding, lengths, count, memory, LISTS, work, [0] * 4, data)
    span, source = np.zeros(4, np.int64), np.frombuffer(data, dtype=np.uint8).astype(np.int64)
    out = engine(decoding, lengths, count, memory, ARRAYS, work, span, source)
    return work.labels, out


def _key(label: int, wide: bool) -> int:
    """Number below 256 by which a label chooses its estimates."""
    return (label * SCATTER >> 8) & 255 if wide else label


def _beside(label: int, node: int, wide: bool) -> int:
    """Context of a bit of a label, by another label."""
    return (label * SCATTER + node) & 65535 if wide else (label * 256 + node) & 16383


def _test(
    bit: int,
    k: int,
    found: int,
    wide: bool,
    stream: Stream,
    memory: Memory,
    tables: Tables,
    work: Work,
) -> int:
    """Code whether a vertex has candidate k of `found`."""
    around, where, inputs = work.around, work.where, work.inputs
    candidate = work.candidates[k]
    c, other = _key(candidate, wide), ALONE
    if found > 1:
        other = _key(work.candidates[0 if k > 0 else 1], wide)
    near = plane = below = before = second = sum_plane = sum_below = sum_before = mixed = 0
    for i in range(AROUND):
        if around[i] != candidate:
            continue
        if i < 4:
            near |= 1 << i
        if i < 2 or i == 4 or i == 5 or i == 16 or i == 17:
            plane |= 1 << (i if i < 2 else i - 2 if i < 6 else i - 12)
            sum_plane += 1
        if i == 2 or 6 <= i < 10:
            below |= 1 << (0 if i == 2 else i - 5)
            sum_below += 1
        if i == 3 or 10 <= i < 16:
            before |= 1 << (0 if i == 3 else i - 9)
            sum_before += 1
        if i >= 16:
            second |= 1 << (i - 16)
        if i == 2 or i == 3:
            mixed |= 1 << (i + 4)
        if i == 6 or i == 8 or i == 10 or i == 12:
            mixed |= 1 << (8 + (i - 6) // 2)
    where[0] = ((k * FOUND + found - 1) * NEAR + near) * 16 + second
    where[1] = STARTS[1] + (k * 64 + plane) * 32 + below
    where[2] = STARTS[2] + (k * 128 + before) * NEAR + near
    where[3] = STARTS[3] + ((256 if k > 0 else 0) + c) * NEAR + near
    where[4] = STARTS[4] + ((c * 259 + other) & 4095) * NEAR + near
    where[5] = STARTS[5] + ((k * 7 + sum_plane) * 6 + sum_below) * 8 + sum_before
    where[6] = STARTS[6] + (k << 12 | mixed | plane)
    where[7] = STARTS[7] + (k << 12 | before << 5 | below)
    first = (k * NEAR + near) * LANES
    last = (TESTED * NEAR + k * FOUND + found - 1) * LANES
    return code_mixed(
        CONTEXTS, bit, first, last, LEARNING_RATE, where, inputs, stream, memory, tables
    )


def _allowed(low: int, high: int, count: int, tested: int, candidates: Sequence) -> int:
    """Number of labels from `low` to `high` - 1 not among the first `tested` candidates."""
    n = max(min(high, count) - low, 0)
    for i in range(tested):
        if low <= candidates[i] < high:
            n -= 1
    return n


def _spell(
    label: int,
    count: int,
    tested: int,
    stream: Stream,
    memory: Memory,
    tables: Tables,
    work: Work,
) -> int:
    """Code a label that is none of the first `tested` candidates, from its highest bit on."""
    around, candidates, where, inputs = work.around, work.candidates, work.where, work.inputs
    wide, following = count > MAX_NARROW, work.highest[0] + 1
    is_next = 1 if label == following else 0
    if wide and following < count and code_simple(is_next, NEXT, stream, memory, tables.rate):
        return int(following)
    levels = 16 if wide else 8
    size = 65536 if wide else 16384
    at = STARTS[CONTEXTS] + (65536 if wide else 256)
    low, node, level = 0, 1, 0
    while (count - 1) >> level > 0:
        level += 1
    while level > 0:
        level -= 1
        middle = low + (1 << level)
        bit = 1 if label >= middle else 0
        if _allowed(low, middle, count, tested, candidates) == 0:
            bit = 1
        elif _allowed(middle, middle + (1 << level), count, tested, candidates) == 0:
            bit = 0
        else:
            where[0] = STARTS[CONTEXTS] + node
            where[1] = at + _beside(candidates[0] if tested > 0 else 0, node, wide)
            where[2] = at + size + _beside(around[3], node, wide)
            where[3] = at + 2 * size + _beside(around[2], node, wide)
            first = (CANDIDATE_SETS + level) * LANES
            last = (CANDIDATE_SETS + levels + tested) * LANES
            bit = code_mixed(
                BIT_CONTEXTS, bit, first, last, LEARNING_RATE, where, inputs, stream, memory, tables
            )
        if bit:
            low = middle
        node = node * 2 + bit
    return low


def _vertex(
    label: int, count: int, stream: Stream, memory: Memory, tables: Tables, work: Work
) -> int:
    """Code the label of the vertex whose neighbours are in `work.around`."""
    around, candidates, votes = work.around, work.candidates, work.votes
    found = 0
    for i in range(AROUND):
        v = around[i]
        if v == NONE:
            continue
        k = 0
        while k < found and candidates[k] != v:
            k += 1
        if k == FOUND:
            continue
        if k == found:
            candidates[found] = v
            votes[found] = 0
            found += 1
        votes[k] += 3 if i < 4 else 1
        while k > 0 and votes[k] > votes[k - 1]:
            votes[k], votes[k - 1] = votes[k - 1], votes[k]
            candidates[k], candidates[k - 1] = candidates[k - 1], candidates[k]
            k -= 1
    tested = min(found, TESTED)
    for k in range(tested):
        if k == count - 1:
            return int(candidates[k])
        bit = 1 if label == candidates[k] else 0
        if _test(bit, k, found, count > MAX_NARROW, stream, memory, tables, work):
            return int(candidates[k])
    return _spell(label, count, tested, stream, memory, tables, work)


def _gather(x: int, rows: Rows, work: Work) -> None:
    """Put the labels around vertex x of a row into `work.around`."""
    around, known = work.around, work.known
    row, north, below, back = rows.row + x, rows.north + x, rows.below + x, rows.back + x
    around[0], around[1], around[2], around[3] = (
        known[row - 1],
        known[north],
        known[below],
        known[back],
    )
    around[4], around[5] = known[north - 1], known[north + 1]
    around[6], around[7] = known[below + 1], known[below - 1]
    around[8], around[9] = known[rows.below_s + x], known[rows.below_n + x]
    around[10], around[11] = known[back + 1], known[back - 1]
    around[12], around[13] = known[rows.back_s + x], known[rows.back_n + x]
    around[14], around[15] = known[rows.back_f + x], known[rows.back_b + x]
    around[16], around[17] = known[row - 2], known[rows.north2 + x]
    around[18], around[19] = known[rows.below2 + x], known[rows.back2 + x]


def _states_around(
    s: int, t: int, z: int, y: int, r: int, shape: tuple[int, int, int, int], states: Sequence
) -> tuple[int, int]:
    """The state that all segments around segment s have, and the number of the flag's estimate."""
    g2 = (shape[3] + SEGMENT - 1) // SEGMENT + 2
    g1 = g2 * shape[2]
    g0 = g1 * shape[1]
    g = (r + 1) * g2 + 1 + s
    north = g - g2 if y > 0 else 1 + s
    below = g - g1 if z > 0 else 1 + s
    back = g - g0 if t > 0 else 1 + s
    near = (states[g - 1], states[north], states[below], states[back])
    same, around = common_state(near, NOTHING, MIXED)
    differing = 0
    for state in (states[north + 1], states[below + 1], states[back + 1]):
        if state not in (NOTHING, same):
            differing = 1
    return same, around * 2 + differing


def _run(
    decoding: bool,
    shape: tuple[int, int, int, int],
    count: int,
    memory: Memory,
    tables: Tables,
    work: Work,
    span: Sequence,
    data: Sequence,
) -> list[int]:
    """Code the labels; the bytes."""
    out = [0 for _ in range(0)]
    stream = Stream(decoding, span, data, out)
    n0, n1, n2, n3 = shape
    start_range(stream)
    segments = (n3 + SEGMENT - 1) // SEGMENT
    labels, known, states = work.labels, work.known, work.states
    for r in range(n0 * n1 * n2):
        t, z, y = r // n2 // n1, r // n2 % n1, r % n2
        rows = rows_around(t, z, y, r, shape)
        at, row = r * n3, rows.row
        for s in range(segments):
            g = (r + 1) * (segments + 2) + 1 + s
            x0, x1 = s * SEGMENT, min((s + 1) * SEGMENT, n3)
            same, flag = _states_around(s, t, z, y, r, shape, states)
            if same < NONE:
                uniform = 1
                if not decoding:
                    for x in range(x0, x1):
                        if labels[at + x] != same:
                            uniform = 0
                            break
                if code_simple(uniform, flag, stream, memory, tables.rate):
                    for x in range(x0, x1):
                        labels[at + x] = same
                        known[row + x] = same
                    states[g] = same
                    continue
            first, differs = 0, False
            for x in range(x0, x1):
                _gather(x, rows, work)
                label = _vertex(labels[at + x], count, stream, memory, tables, work)
                labels[at + x] = label
                known[row + x] = label
                work.highest[0] = max(work.highest[0], label)
                if x == x0:
                    first = label
                if label != first:
                    differs = True
            states[g] = MIXED if differs else first
    if not decoding:
        finish(stream)
    return out
