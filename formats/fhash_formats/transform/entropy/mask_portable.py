"""The coder of masks without the native library: twin of native/mask.cpp.

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
    keep_memory,
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

Mask = npt.NDArray[np.bool_]
Levels = npt.NDArray[np.uint8]

CONTEXTS = 10
"""Estimates that are mixed for a bit."""
LANES = 2 * CONTEXTS
"""Weights of a set."""
LEVELS = 32
"""Levels of a vertex."""
EVEN = 16
"""Level from which on a vertex is more likely occupied than not."""
NEAR = 16
"""Patterns of the four nearest bits; each has a set of weights."""
ZEROS = 0
"""State of a segment whose bits are all 0."""
ONES = 1
"""State of a segment whose bits are all 1."""
MIXED = 2
"""State of a segment that has both."""
NOTHING = 3
"""State of a segment that does not exist."""
QUIET = 12
"""Number of levels, counted from the end that agrees with a flag, in which a segment has one."""
LEARNING_RATE = 2
"""Rate at which the mixing weights learn, in 1/16."""
SIZES = (512, 1024, 4096, 2048, 2048, 1920, 2592, 4096, 4096, 2048)
"""Contexts of each estimate."""
STARTS = tuple(sum(SIZES[:i]) for i in range(CONTEXTS))
"""First slot of each estimate."""


class LevelRows(NamedTuple):
    """Places where rows of levels begin: the row itself (`at`), the next along y, z and t."""

    at: int
    south: int
    front: int
    later: int


class Work(NamedTuple):
    """Sequences of a run.

    Attributes:
        bits: the mask, which is written in decoding.
        level: first level of each vertex, 0 to 31.
        other: second level of each vertex, 0 to 15.
        marks: what `_mark` returns for each vertex, with PADDING zeros at both ends of each row,
            after a row of zeros that stands for rows that do not exist.
        states: state of each segment; one that does not exist is at the start of each row.
        where, inputs: of a decision, for `mix` and `learn`.
    """

    bits: Sequence
    level: Sequence
    other: Sequence
    marks: Sequence
    states: Sequence
    where: Sequence
    inputs: Sequence


def encode(mask: Mask, levels: tuple[Levels, Levels], state: State) -> bytes:
    """Code a mask (t, z, y, x), and adapt the state."""
    engine = _engine()
    memory = memory_of(state, engine is not None)
    out = _start(engine, False, mask.astype(np.int64).ravel(), levels, memory, b"")[1]
    keep_memory(memory, state)
    return bytes(out)


def decode(data: bytes, levels: tuple[Levels, Levels], state: State) -> Mask:
    """The mask that was coded; any other bytes give some mask."""
    engine = _engine()
    memory = memory_of(state, engine is not None)
    bits = _start(engine, True, np.zeros(levels[0].size, np.int64), levels, memory, data)[0]
    return np.array(bits, dtype=np.uint8).reshape(levels[0].shape).view(np.bool_)


def _engine() -> Callable[..., Any] | None:
    """`_run` compiled, or None where numba cannot be imported."""
    helpers: tuple[Callable[..., Any], ...]
    helpers = (rows_around, common_state, _level_rows, _mark, _states_around)
    helpers += (_code_flag, _code_segment)
    return compiled(_run, helpers)


def _start(
    engine: Callable[..., Any] | None,
    decoding: bool,
    bits: npt.NDArray[np.int64],
    levels: tuple[Levels, Levels],
    memory: Memory,
    data: bytes,
) -> tuple[Sequence, Sequence]:
    """Make room and run: the bits, and the bytes."""
    n0, n1, n2, n3 = shape = levels[0].shape
    rows, segments = n0 * n1 * n2, -(-n3 // SEGMENT)
    first, second = (level.astype(np.int64).ravel() for level in levels)
    marks = np.zeros((rows + 1) * (n3 + 2 * PADDING), np.int64)
    states = np.full(rows * (segments + 1), NOTHING, np.int64)
    where, inputs = np.zeros(CONTEXTS, np.int64), np.zeros(LANES, np.int64)
    work = Work(bits, first, second, marks, states, where, inputs)
    if engine is None:
        work = Work(*(sequence.tolist() for sequence in work))
        return work.bits, _run(decoding, shape, memory, LISTS, work, [0] * 4, data)
    span, source = np.zeros(4, np.int64), np.frombuffer(data, dtype=np.uint8).astype(np.int64)
    return work.bits, engine(decoding, shape, memory, ARRAYS, work, span, source)


def _level_rows(t: int, z: int, y: int, r: int, shape: tuple[int, int, int, int]) -> LevelRows:
    """The levels of the row (t, z, y), whose number is r, and those after it."""
    n0, n1, n2, n3 = shape
    at = r * n3
    return LevelRows(
        at,
        at + n3 if y + 1 < n2 else at,
        at + n3 * n2 if z + 1 < n1 else at,
        at + n3 * n2 * n1 if t + 1 < n0 else at,
    )


def _mark(bit: int, level: int) -> int:
    """The bit, and above it 1 for a 0 that the level spoke against, 2 for such a 1, else 0."""
    if level < EVEN:
        return 5 if bit == 1 else 0
    return 1 if bit == 1 else 2


def _states_around(
    g: int, t: int, z: int, y: int, shape: tuple[int, int, int, int], states: Sequence
) -> tuple[int, int, int, int]:
    """States of the segments before segment g, along x, y, z and t."""
    g2 = (shape[3] + SEGMENT - 1) // SEGMENT + 1
    g1 = g2 * shape[2]
    g0 = g1 * shape[1]
    return (
        states[g - 1],
        states[g - g2] if y > 0 else NOTHING,
        states[g - g1] if z > 0 else NOTHING,
        states[g - g0] if t > 0 else NOTHING,
    )


def _code_flag(
    x0: int,
    x1: int,
    same: int,
    around: int,
    informed: int,
    row: int,
    at: int,
    stream: Stream,
    memory: Memory,
    rate: Sequence,
    work: Work,
) -> int:
    """Code by a flag, if it may have one, whether a segment is uniform; its state, or NOTHING.

    Args:
        x0, x1: first vertex of the segment, and one past its last.
        same, around: what `common_state` returned.
        informed: whether any level of the mask is above 0.
        row, at: where the row begins in the marks, and in bits and levels.
        stream, memory, rate, work: of the run.
    """
    bits, level = work.bits, work.level
    low, high = LEVELS - 1, 0
    for x in range(x0, x1):
        low = min(low, level[at + x])
        high = max(high, level[at + x])
    if same == NOTHING:
        same = ZEROS if informed == 0 or high < 4 else ONES if low > LEVELS - 5 else MIXED
    if same == MIXED:
        return NOTHING
    away = 0 if informed == 0 else LEVELS - 1 - low if same == ONES else high
    if away >= QUIET:
        return NOTHING
    uniform = 1
    if not stream.decoding:
        for x in range(x0, x1):
            if bits[at + x] != same:
                uniform = 0
                break
    flag = (same * 3 + away // 4) * 5 + around
    if not code_simple(uniform, flag, stream, memory, rate):
        return NOTHING
    for x in range(x0, x1):
        bits[at + x] = same
        work.marks[row + x] = _mark(same, level[at + x])
    return same


def _code_segment(
    x0: int,
    x1: int,
    n3: int,
    rows: Rows,
    level_rows: LevelRows,
    stream: Stream,
    memory: Memory,
    tables: Tables,
    work: Work,
) -> int:
    """Code the vertices x0 to x1 - 1 of a row, bit by bit; the state of the segment.

    Bits are named as in native/mask.cpp: w, n, p and b are before the vertex along x, y, z and t; a
    second letter moves on along y (n, s), x (w, e) or z (p, f); the 2 is for two vertices before.
    """
    bits, level, marks = work.bits, work.level, work.marks
    where, inputs = work.where, work.inputs
    row, north, below, back, at = rows.row, rows.north, rows.below, rows.back, level_rows.at
    ones = 0
    for x in range(x0, x1):
        a = level[at + x]
        ahead = level[at + x + 1] if x + 1 < n3 else a
        half = a >> 1
        w, n, p, b = (
            marks[row + x - 1] & 1,
            marks[north + x] & 1,
            marks[below + x] & 1,
            marks[back + x] & 1,
        )
        nw, ne = marks[north + x - 1] & 1, marks[north + x + 1] & 1
        pw, pe = marks[below + x - 1] & 1, marks[below + x + 1] & 1
        pn, ps = marks[rows.below_n + x] & 1, marks[rows.below_s + x] & 1
        bw, be = marks[back + x - 1] & 1, marks[back + x + 1] & 1
        bn, bs = marks[rows.back_n + x] & 1, marks[rows.back_s + x] & 1
        bp, bf = marks[rows.back_b + x] & 1, marks[rows.back_f + x] & 1
        w2, n2 = marks[row + x - 2] & 1, marks[rows.north2 + x] & 1
        p2, b2 = marks[rows.below2 + x] & 1, marks[rows.back2 + x] & 1
        nearest = w | n << 1 | p << 2 | b << 3
        before = b | be << 1 | bw << 2 | bs << 3 | bn << 4 | bf << 5 | bp << 6
        sums = ((w + n + nw + ne) * 6 + p + pw + pe + ps + pn) * 8 + b + bw + be + bs + bn + bf + bp
        against = (a * 3 + (marks[row + x - 1] >> 1)) * 3 + (marks[north + x] >> 1)
        south, front, later = (
            level[level_rows.south + x] >> 2,
            level[level_rows.front + x] >> 2,
            level[level_rows.later + x] >> 2,
        )
        plane = w2 << 4 | nw << 5 | ne << 6 | n2 << 7 | pe << 8 | ps << 9 | be << 10 | bs << 11
        second = w2 << 4 | n2 << 5 | p2 << 6 | b2 << 7 | be << 8 | bs << 9 | bf << 10 | pe << 11
        where[0] = a * NEAR + nearest
        where[1] = STARTS[1] + (a * 16 + work.other[at + x]) * 2 + w
        where[2] = STARTS[2] + (nearest | plane)
        where[3] = STARTS[3] + ((half * 8 + (ahead >> 2)) * 8 + south) * 2 + w
        where[4] = STARTS[4] + ((half * 8 + front) * 8 + later) * 2 + p
        where[5] = STARTS[5] + sums * 8 + (a >> 2)
        where[6] = STARTS[6] + (against * 3 + (marks[below + x] >> 1)) * 3 + (marks[back + x] >> 1)
        where[7] = STARTS[7] + ((a >> 3) << 10 | before | w << 7 | n << 8 | p << 9)
        where[8] = STARTS[8] + (nearest | second)
        where[9] = STARTS[9] + (half << 7 | before)
        first, second = a * LANES, (LEVELS + nearest) * LANES
        bit = code_mixed(
            CONTEXTS,
            bits[at + x],
            first,
            second,
            LEARNING_RATE,
            where,
            inputs,
            stream,
            memory,
            tables,
        )
        bits[at + x] = bit
        marks[row + x] = _mark(bit, a)
        ones += bit
    return ZEROS if ones == 0 else ONES if ones == x1 - x0 else MIXED


def _run(
    decoding: bool,
    shape: tuple[int, int, int, int],
    memory: Memory,
    tables: Tables,
    work: Work,
    span: Sequence,
    data: Sequence,
) -> list[int]:
    """Code the mask; the bytes."""
    out = [0 for _ in range(0)]
    stream = Stream(decoding, span, data, out)
    n0, n1, n2, n3 = shape
    start_range(stream)
    segments = (n3 + SEGMENT - 1) // SEGMENT
    informed = 0
    for i in range(len(work.level)):
        if work.level[i] != 0:
            informed = 1
            break

    for r in range(n0 * n1 * n2):
        t, z, y = r // n2 // n1, r // n2 % n1, r % n2
        rows = rows_around(t, z, y, r, shape)
        levels = _level_rows(t, z, y, r, shape)
        for s in range(segments):
            g = r * (segments + 1) + 1 + s
            x0, x1 = s * SEGMENT, min((s + 1) * SEGMENT, n3)
            before = _states_around(g, t, z, y, shape, work.states)
            same, around = common_state(before, NOTHING, MIXED)
            state = _code_flag(
                x0,
                x1,
                same,
                around,
                informed,
                rows.row,
                levels.at,
                stream,
                memory,
                tables.rate,
                work,
            )
            if state == NOTHING:
                state = _code_segment(x0, x1, n3, rows, levels, stream, memory, tables, work)
            work.states[g] = state
    if not decoding:
        finish(stream)
    return out
