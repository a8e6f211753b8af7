"""The coder of masks without the native library: native/mask.cpp step by step, with the same bytes. Its comments say what is done and why.

Compiled where numba can be imported, plain Python elsewhere, as the coder of integers is (coder_portable.py), whose parts it takes.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.transform.entropy import coder_portable
from fhash_formats.transform.entropy.coder_portable import (
    _ARRAYS,
    _LISTS,
    Memory,
    Sequence,
    Tables,
    _chance,
    _code,
    _finish,
    _memory,
    _mix,
)
from fhash_formats.transform.entropy.prior import State

__all__ = ["decode", "encode"]

Mask = npt.NDArray[np.bool_]
Levels = npt.NDArray[np.uint8]

CONTEXTS, LEVELS, EVEN, SEGMENT, NEAR, PADDING, NOTHING, QUIET, LIMIT, RATE, FAST = (
    10,
    32,
    16,
    16,
    16,
    2,
    3,
    12,
    400,
    2,
    20,
)
SIZES = (512, 1024, 4096, 2048, 2048, 1920, 2592, 4096, 4096, 2048)
STARTS = tuple(sum(SIZES[:i]) for i in range(CONTEXTS))
LANES = 2 * CONTEXTS


def encode(mask: Mask, levels: tuple[Levels, Levels], state: State) -> bytes:
    """Code a mask (t, z, y, x). The state is left as it has become."""
    compiled = _compiled()
    memory = _memory(state, compiled is not None)
    out = _start(compiled, False, mask.astype(np.int64).ravel(), levels, memory, b"")[1]
    state.slots[:, 0], state.slots[:, 1], state.slots[:, 2] = memory.slow, memory.fast, memory.count
    state.weights[:] = memory.weights
    state.simples[:, 0], state.simples[:, 1] = memory.chance, memory.seen
    return bytes(out)


def decode(data: bytes, levels: tuple[Levels, Levels], state: State) -> Mask:
    """The mask that was coded; any other bytes give some mask."""
    compiled = _compiled()
    bits = _start(
        compiled,
        True,
        np.zeros(levels[0].size, np.int64),
        levels,
        _memory(state, compiled is not None),
        data,
    )[0]
    return np.array(bits, dtype=np.uint8).reshape(levels[0].shape).view(np.bool_)


_LOCK = threading.Lock()
_RUN: list[Callable[..., Any] | None] = []


def _compiled() -> Callable[..., Any] | None:
    """`_run` compiled, or None where numba cannot be imported."""
    # First the parts that both coders have.
    if coder_portable._compiled() is None:
        return None
    with _LOCK:
        if not _RUN:
            numba, extending = import_module("numba"), import_module("numba.extending")
            extending.register_jitable(_learn)
            try:
                _RUN.append(numba.njit(cache=True, nogil=True)(_run))
            except RuntimeError:  # nowhere to keep the compiled code
                _RUN.append(numba.njit(nogil=True)(_run))
    return _RUN[0]


def _start(
    compiled: Callable[..., Any] | None,
    decoding: bool,
    bits: npt.NDArray[np.int64],
    levels: tuple[Levels, Levels],
    memory: Memory,
    data: bytes,
) -> tuple[Sequence, Sequence]:
    """Make room and run: the bits, and the bytes."""
    n0, n1, n2, n3 = shape = levels[0].shape
    rows, segments = n0 * n1 * n2, -(-n3 // SEGMENT)
    # The first row stands for those that do not exist.
    known, states = (
        np.zeros((rows + 1) * (n3 + 2 * PADDING), np.int64),
        np.full(rows * (segments + 1), NOTHING, np.int64),
    )
    first, second = (level.astype(np.int64).ravel() for level in levels)
    source = np.frombuffer(data, dtype=np.uint8).astype(np.int64)
    span, where, inputs = (
        np.zeros(4, np.int64),
        np.zeros(CONTEXTS, np.int64),
        np.zeros(LANES, np.int64),
    )
    work: list[Sequence] = [bits, first, second, known, states, source, span, where, inputs]
    if compiled is None:
        work = [part.tolist() for part in work]
    out = (compiled or _run)(decoding, shape, memory, _ARRAYS if compiled else _LISTS, *work)
    return work[0], out


def _learn(
    where: Sequence,
    inputs: Sequence,
    first: int,
    second: int,
    p: int,
    bit: int,
    memory: Memory,
    rate: Sequence,
) -> None:
    weights = memory.weights
    target = 65535 if bit else 0
    error = ((target - p) * RATE) >> 4
    for i in range(LANES):
        step = (error * inputs[i] + 32768) >> 16
        weights[first + i] = min(max(weights[first + i] + step, -32767), 32767)
        weights[second + i] = min(max(weights[second + i] + step, -32767), 32767)
    for i in range(CONTEXTS):
        at = where[i]
        slow, fast, seen = memory.slow[at], memory.fast[at], memory.count[at]
        memory.slow[at] = slow + (((target - slow) * rate[seen]) >> 16)
        memory.fast[at] = fast + (((target - fast) * rate[min(seen, FAST)]) >> 16)
        if seen < LIMIT:
            memory.count[at] = seen + 1


def _run(
    decoding: bool,
    shape: tuple[int, int, int, int],
    memory: Memory,
    tables: Tables,
    bits: Sequence,
    level: Sequence,
    other: Sequence,
    known: Sequence,
    states: Sequence,
    data: Sequence,
    span: Sequence,
    where: Sequence,
    inputs: Sequence,
) -> list[int]:
    out = [0 for _ in range(0)]
    rate = tables.rate
    n0, n1, n2, n3 = shape
    span[1] = 0xFFFFFFFF
    if decoding:
        for i in range(4):
            span[2] = (span[2] << 8) | (data[i] if i < len(data) else 0)
        span[3] = 4
    segments = (n3 + SEGMENT - 1) // SEGMENT
    m2, g2 = n3 + 2 * PADDING, segments + 1
    m1, g1 = m2 * n2, g2 * n2
    m0, g0 = m1 * n1, g1 * n1
    s1 = n3 * n2
    s0 = s1 * n1
    informed = 0
    for i in range(len(level)):
        if level[i] != 0:
            informed = 1
            break

    for r in range(n0 * n1 * n2):
        t, z, y = r // n2 // n1, r // n2 % n1, r % n2
        at, row, g = r * n3, (r + 1) * m2 + PADDING, r * g2 + 1
        north = row - m2 if y > 0 else PADDING
        north2 = row - 2 * m2 if y > 1 else PADDING
        below = row - m1 if z > 0 else PADDING
        below2 = row - 2 * m1 if z > 1 else PADDING
        below_n = row - m1 - m2 if z > 0 and y > 0 else PADDING
        below_s = row - m1 + m2 if z > 0 and y + 1 < n2 else PADDING
        back = row - m0 if t > 0 else PADDING
        back2 = row - 2 * m0 if t > 1 else PADDING
        back_n = row - m0 - m2 if t > 0 and y > 0 else PADDING
        back_s = row - m0 + m2 if t > 0 and y + 1 < n2 else PADDING
        back_b = row - m0 - m1 if t > 0 and z > 0 else PADDING
        back_f = row - m0 + m1 if t > 0 and z + 1 < n1 else PADDING
        south = at + n3 if y + 1 < n2 else at
        front = at + s1 if z + 1 < n1 else at
        later = at + s0 if t + 1 < n0 else at

        for s in range(segments):
            x0, x1 = s * SEGMENT, min((s + 1) * SEGMENT, n3)
            low, high = LEVELS - 1, 0
            for x in range(x0, x1):
                low = min(low, level[at + x])
                high = max(high, level[at + x])
            same, around = NOTHING, 0
            for k in range(4):
                near = NOTHING
                if k == 0:
                    near = states[g + s - 1]
                elif k == 1 and y > 0:
                    near = states[g + s - g2]
                elif k == 2 and z > 0:
                    near = states[g + s - g1]
                elif k == 3 and t > 0:
                    near = states[g + s - g0]
                if near == NOTHING:
                    continue
                around += 1
                same = near if same in (NOTHING, near) else 2
            if same == NOTHING:
                same = 0 if informed == 0 or high < 4 else 1 if low > LEVELS - 5 else 2
            if same < 2:
                away = 0 if informed == 0 else LEVELS - 1 - low if same == 1 else high
                if away < QUIET:
                    uniform = 1
                    if not decoding:
                        for x in range(x0, x1):
                            if bits[at + x] != same:
                                uniform = 0
                                break
                    if _chance(
                        uniform,
                        (same * 3 + away // 4) * 5 + around,
                        decoding,
                        memory,
                        rate,
                        span,
                        data,
                        out,
                    ):
                        for x in range(x0, x1):
                            bits[at + x] = same
                            if level[at + x] < EVEN:
                                known[row + x] = 5 if same == 1 else 0
                            else:
                                known[row + x] = 1 if same == 1 else 2
                        states[g + s] = same
                        continue
            ones = 0
            for x in range(x0, x1):
                a = level[at + x]
                ahead = level[at + x + 1] if x + 1 < n3 else a
                half = a >> 1
                w, n, p, b = (
                    known[row + x - 1] & 1,
                    known[north + x] & 1,
                    known[below + x] & 1,
                    known[back + x] & 1,
                )
                nw, ne = known[north + x - 1] & 1, known[north + x + 1] & 1
                pw, pe, ps, pn = (
                    known[below + x - 1] & 1,
                    known[below + x + 1] & 1,
                    known[below_s + x] & 1,
                    known[below_n + x] & 1,
                )
                bw, be, bs, bn = (
                    known[back + x - 1] & 1,
                    known[back + x + 1] & 1,
                    known[back_s + x] & 1,
                    known[back_n + x] & 1,
                )
                bf, bp = known[back_f + x] & 1, known[back_b + x] & 1
                w2, above2, p2, b2 = (
                    known[row + x - 2] & 1,
                    known[north2 + x] & 1,
                    known[below2 + x] & 1,
                    known[back2 + x] & 1,
                )
                nearest = w | n << 1 | p << 2 | b << 3
                before = b | be << 1 | bw << 2 | bs << 3 | bn << 4 | bf << 5 | bp << 6
                sums = (
                    ((w + n + nw + ne) * 6 + p + pw + pe + ps + pn) * 8
                    + b
                    + bw
                    + be
                    + bs
                    + bn
                    + bf
                    + bp
                )
                against = (a * 3 + (known[row + x - 1] >> 1)) * 3 + (known[north + x] >> 1)
                where[0] = a * NEAR + nearest
                where[1] = STARTS[1] + (a * 16 + other[at + x]) * 2 + w
                where[2] = STARTS[2] + (
                    nearest
                    | w2 << 4
                    | nw << 5
                    | ne << 6
                    | above2 << 7
                    | pe << 8
                    | ps << 9
                    | be << 10
                    | bs << 11
                )
                where[3] = (
                    STARTS[3] + ((half * 8 + (ahead >> 2)) * 8 + (level[south + x] >> 2)) * 2 + w
                )
                where[4] = (
                    STARTS[4]
                    + ((half * 8 + (level[front + x] >> 2)) * 8 + (level[later + x] >> 2)) * 2
                    + p
                )
                where[5] = STARTS[5] + sums * 8 + (a >> 2)
                where[6] = (
                    STARTS[6] + (against * 3 + (known[below + x] >> 1)) * 3 + (known[back + x] >> 1)
                )
                where[7] = STARTS[7] + ((a >> 3) << 10 | before | w << 7 | n << 8 | p << 9)
                where[8] = STARTS[8] + (
                    nearest
                    | w2 << 4
                    | above2 << 5
                    | p2 << 6
                    | b2 << 7
                    | be << 8
                    | bs << 9
                    | bf << 10
                    | pe << 11
                )
                where[9] = STARTS[9] + (half << 7 | before)
                first, second = a * LANES, (LEVELS + nearest) * LANES
                probability = _mix(CONTEXTS, where, inputs, first, second, memory, tables)
                bit = _code(bits[at + x], probability, decoding, span, data, out)
                _learn(where, inputs, first, second, probability, bit, memory, rate)
                bits[at + x] = bit
                if a < EVEN:
                    known[row + x] = 5 if bit == 1 else 0
                else:
                    known[row + x] = 1 if bit == 1 else 2
                ones += bit
            states[g + s] = 0 if ones == 0 else 1 if ones == x1 - x0 else 2
    if not decoding:
        _finish(span, out)
    return out
