"""The adaptive coder without the native library: native/coder.cpp step by step, with the same bytes. Its comments say what is done and why.

One source runs in two ways. Where numba can be imported it is compiled, and the sequences are arrays; elsewhere it is plain Python, and
they are lists, so that each number is a Python integer: faster to reach than numpy's, and never too large.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import DamagedFileError
from fhash_formats.transform.entropy.prior import (
    DECISIONS,
    KINDS,
    LANES,
    LEVELS,
    SIGN_SIZES,
    SIZES,
    State,
)

__all__ = ["decode", "encode"]

STRETCH_MAX = 2816
CONTEXTS, SIGN_CONTEXTS, UNARY = 6, 3, 14
SLOW_LIMIT, SIGN_LIMIT, FAST_LIMIT, SIMPLE_LIMIT, LEARNING_RATE = 400, 255, 20, 60, 6
MAX_MAGNITUDE = 4095
PADDING = 2
LEFT, LEFT2, ABOVE, DIAGONAL, ABOVE2, BEFORE, AROUND, BEFORE2, REFERENCE = (
    184,
    20,
    184,
    61,
    41,
    102,
    20,
    31,
    62,
)
STARTS = tuple(sum(SIZES[:i]) * DECISIONS for i in range(CONTEXTS))
SIGN_STARTS = tuple(sum(SIZES) * DECISIONS + sum(SIGN_SIZES[:i]) for i in range(SIGN_CONTEXTS))
SECOND = KINDS * DECISIONS * LANES
SIGNS = SECOND + 64 * DECISIONS * LANES
ROWS = LEVELS * 64
EMPTIES = ROWS + 8
ENCODE, DECODE, CHOOSE = 0, 1, 2

Sequence = Any
"""A list of integers, or an integer array where compiled."""


class Tables(NamedTuple):
    """The functions that are looked up."""

    stretch: Sequence
    squash: Sequence
    cost: Sequence
    log: Sequence
    rate: Sequence
    small: Sequence


class Memory(NamedTuple):
    """The state, field by field."""

    slow: Sequence
    fast: Sequence
    count: Sequence
    weights: Sequence
    chance: Sequence
    seen: Sequence


class Work(NamedTuple):
    """What a run writes to: the range (low, high, value, position); magnitudes and filled rows of all bands, the first of them a row of
    zeros; sums over a row's neighbours; and predictions, the second set of them for choices."""

    span: Sequence
    magnitudes: Sequence
    filled: Sequence
    any: Sequence
    expected: Sequence
    plane: Sequence
    before: Sequence
    below: Sequence
    around: Sequence
    rows: Sequence
    row_y: Sequence
    context: Sequence
    where: Sequence
    inputs: Sequence
    other_where: Sequence
    other_inputs: Sequence


def encode(
    integers: npt.NDArray[np.int32],
    table: npt.NDArray[np.int32],
    scaled: npt.NDArray[np.float32] | None,
    weight: float,
    state: State,
) -> bytes:
    """Code integers (t, z, y, x), in C order; with `scaled` they are chosen anew in place. The state is left as it has become."""
    compiled = _compiled()
    real = (np.zeros(0) if scaled is None else np.asarray(scaled, dtype=np.float64)).ravel()
    q: Sequence = integers.reshape(-1) if compiled else integers.ravel().tolist()
    memory = _memory(state, compiled is not None)
    mode = ENCODE if scaled is None else CHOOSE
    out = _start(
        compiled,
        mode,
        q,
        real if compiled else real.tolist(),
        weight / 2048,
        integers.shape,
        table,
        memory,
        b"",
    )[1]
    if not compiled and mode == CHOOSE:
        integers[:] = np.array(q, dtype=np.int32).reshape(integers.shape)
    state.slots[:, 0], state.slots[:, 1], state.slots[:, 2] = memory.slow, memory.fast, memory.count
    state.weights[:] = memory.weights
    state.simples[:, 0], state.simples[:, 1] = memory.chance, memory.seen
    return bytes(out)


def decode(
    integers: npt.NDArray[np.int32], table: npt.NDArray[np.int32], data: bytes, state: State
) -> None:
    """Decode into integers (t, z, y, x), which are zeros in C order. Raises DamagedFileError for bytes that no encoder writes."""
    compiled = _compiled()
    q: Sequence = integers.reshape(-1) if compiled else [0] * integers.size
    real: Sequence = np.zeros(0) if compiled else []
    code = _start(
        compiled,
        DECODE,
        q,
        real,
        0.0,
        integers.shape,
        table,
        _memory(state, compiled is not None),
        data,
    )[0]
    if code < 0:
        raise DamagedFileError("the coded integers are damaged")
    if not compiled:
        integers[:] = np.array(q, dtype=np.int32).reshape(integers.shape)


def _tables() -> dict[str, npt.NDArray[np.int64]]:
    """The values before they are rounded down are nowhere near a whole number (a test sees to it), so every machine has the same."""
    p, logits, small = (
        (np.arange(65536) + 0.5) / 65536,
        np.arange(-STRETCH_MAX, STRETCH_MAX + 1),
        [3, 5, 7, 10, 15, 23, 37],
    )
    tables = {
        "stretch": np.clip(np.floor(np.log(p / (1 - p)) * 256 + 0.5), -STRETCH_MAX, STRETCH_MAX),
        "squash": np.clip(np.floor(65536 / (1 + np.exp(-logits / 256)) + 0.5), 1, 65535),
        "cost": np.floor(-np.log2(np.maximum(np.arange(65537), 1) / 65536) * 2048 + 0.5),
        "log": np.floor(np.log2(np.maximum(np.arange(4096), 1)) * 16 + 0.5),
        "rate": 655360 // (10 * np.arange(SLOW_LIMIT + 1) + 16),
        "small": np.array(
            [v if v < 3 else 2 + sum(v >= bound for bound in small) for v in range(38)]
        ),
    }
    return {name: values.astype(np.int64) for name, values in tables.items()}


_ARRAYS = Tables(**_tables())
_LISTS = Tables(*(values.tolist() for values in _ARRAYS))
_LOCK = threading.Lock()
_RUN: list[Callable[..., Any] | None] = []


def _compiled() -> Callable[..., Any] | None:
    """`_run` compiled, or None where numba cannot be imported."""
    with _LOCK:
        if not _RUN:
            try:
                _RUN.append(_compile(import_module("numba"), import_module("numba.extending")))
            except ImportError:
                _RUN.append(None)
    return _RUN[0]


def _compile(numba: Any, extending: Any) -> Callable[..., Any]:
    parts: tuple[Callable[..., Any], ...] = (
        _code,
        _chance,
        _finish,
        _log16,
        _small,
        _mix,
        _learn,
        _context_mix,
        _choose,
    )
    for part in (*parts, _add_centre, _add_neighbour, _prepare, _sign):
        extending.register_jitable(part)
    try:
        run: Callable[..., Any] = numba.njit(cache=True, nogil=True)(_run)
    except RuntimeError:  # nowhere to keep the compiled code
        run = numba.njit(nogil=True)(_run)
    return run


def _memory(state: State, arrays: bool) -> Memory:
    columns: list[npt.NDArray[Any]] = [
        state.slots[:, 0],
        state.slots[:, 1],
        state.slots[:, 2],
        state.weights,
    ]
    columns += [state.simples[:, 0], state.simples[:, 1]]
    return Memory(*(column.astype(np.int64) if arrays else column.tolist() for column in columns))


def _start(
    compiled: Callable[..., Any] | None,
    mode: int,
    q: Sequence,
    scaled: Sequence,
    price: float,
    shape: tuple[int, ...],
    table: npt.NDArray[np.int32],
    memory: Memory,
    data: bytes,
) -> tuple[int, list[int]]:
    """Make room for the bands and run."""
    bands = table.astype(np.int64)
    sizes = bands[:, 4:8] - bands[:, :4]
    width = int(sizes[:, 3].max(initial=0)) + 2 * PADDING
    rows = sizes[:, 0] * sizes[:, 1] * sizes[:, 2]
    # After the columns of the table: where the band's magnitudes and its rows begin.
    first = np.cumsum([width, *(rows * (sizes[:, 3] + 2 * PADDING))])
    bands = np.column_stack([bands, first[:-1], np.cumsum([0, *rows])[:-1]])
    lengths = [
        4,
        int(first[-1]),
        int(rows.sum()),
        len(bands),
        width,
        width,
        width,
        width,
        4 * width,
        4,
        4,
        CONTEXTS,
        CONTEXTS,
        LANES,
    ]
    lengths += [CONTEXTS, LANES]
    if compiled is None:
        work = Work(*([0] * length for length in lengths))
        return _run(mode, q, scaled, price, shape, bands.tolist(), memory, _LISTS, work, data)
    work = Work(*(np.zeros(length, dtype=np.int64) for length in lengths))
    source = np.frombuffer(data, dtype=np.uint8).astype(np.int64)
    code, out = compiled(mode, q, scaled, price, shape, bands, memory, _ARRAYS, work, source)
    return code, out


def _code(bit: int, p: int, decoding: bool, span: Sequence, data: Sequence, out: Sequence) -> int:
    low, high = span[0], span[1]
    middle = low + (((high - low) * p) >> 16)
    if decoding:
        bit = 1 if span[2] <= middle else 0
    if bit:
        high = middle
    else:
        low = middle + 1
    while ((low ^ high) & 0xFF000000) == 0:
        if decoding:
            at = span[3]
            span[2] = ((span[2] << 8) & 0xFFFFFFFF) | (data[at] if at < len(data) else 0)
            span[3] = at + 1
        else:
            out.append(high >> 24)
        low = (low << 8) & 0xFFFFFFFF
        high = ((high << 8) & 0xFFFFFFFF) | 255
    span[0], span[1] = low, high
    return bit


def _chance(
    bit: int,
    at: int,
    decoding: bool,
    memory: Memory,
    rate: Sequence,
    span: Sequence,
    data: Sequence,
    out: Sequence,
) -> int:
    p, seen = memory.chance[at], memory.seen[at]
    bit = _code(bit, min(max(p, 32), 65504), decoding, span, data, out)
    memory.chance[at] = p + ((((65535 if bit else 0) - p) * rate[seen]) >> 16)
    if seen < SIMPLE_LIMIT:
        memory.seen[at] = seen + 1
    return bit


def _log16(v: int, log: Sequence) -> int:
    shift = 0
    while (v >> shift) >= 4096:
        shift += 1
    return int(log[v >> shift]) + 16 * shift


def _small(v: int, small: Sequence) -> int:
    if v < 37:
        return int(small[v])
    return 9 if v <= 64 else 10 if v <= 140 else 11


def _mix(
    n: int,
    where: Sequence,
    inputs: Sequence,
    first: int,
    second: int,
    memory: Memory,
    tables: Tables,
) -> int:
    """The probability of a 1; `second` is negative where there is one set of weights."""
    weights, dot = memory.weights, 0
    for i in range(n):
        at = where[i]
        slow, fast, seen = (
            tables.stretch[memory.slow[at]],
            tables.stretch[memory.fast[at]],
            memory.count[at] + 1,
        )
        if seen <= 12:
            # Rounded towards 0.
            slow = slow * seen // 13 if slow >= 0 else -(-slow * seen // 13)
            fast = fast * seen // 13 if fast >= 0 else -(-fast * seen // 13)
        inputs[2 * i], inputs[2 * i + 1] = slow, fast
        w, v = weights[first + 2 * i], weights[first + 2 * i + 1]
        if second >= 0:
            w, v = w + weights[second + 2 * i], v + weights[second + 2 * i + 1]
        dot += ((w * slow) >> 2) + ((v * fast) >> 2)
    return int(tables.squash[min(max(dot >> 12, -STRETCH_MAX), STRETCH_MAX) + STRETCH_MAX])


def _learn(
    n: int,
    where: Sequence,
    inputs: Sequence,
    first: int,
    second: int,
    p: int,
    bit: int,
    limit: int,
    memory: Memory,
    rate: Sequence,
) -> None:
    weights = memory.weights
    target = 65535 if bit else 0
    error = ((target - p) * LEARNING_RATE) >> 4
    for i in range(2 * n):
        step = (error * inputs[i] + 32768) >> 16
        weights[first + i] = min(max(weights[first + i] + step, -32767), 32767)
        if second >= 0:
            weights[second + i] = min(max(weights[second + i] + step, -32767), 32767)
    for i in range(n):
        at = where[i]
        slow, fast, seen = memory.slow[at], memory.fast[at], memory.count[at]
        memory.slow[at] = slow + (((target - slow) * rate[seen]) >> 16)
        memory.fast[at] = fast + (((target - fast) * rate[min(seen, FAST_LIMIT)]) >> 16)
        if seen < limit:
            memory.count[at] = seen + 1


def _context_mix(
    k: int,
    where: Sequence,
    inputs: Sequence,
    context: Sequence,
    first: int,
    second: int,
    memory: Memory,
    tables: Tables,
) -> int:
    for i in range(CONTEXTS):
        where[i] = STARTS[i] + context[i] * DECISIONS + k
    return _mix(CONTEXTS, where, inputs, first, second, memory, tables)


def _choose(
    s: float,
    p: int,
    price: float,
    first: int,
    second: int,
    memory: Memory,
    tables: Tables,
    work: Work,
) -> int:
    s = s if s < 1e9 else 1e9
    nearest = int(s + 0.5)
    if nearest == 0 or nearest >= UNARY:
        return nearest
    cost, where, inputs, context = tables.cost, work.other_where, work.other_inputs, work.context
    by_kind, by_level = KINDS * LANES, 64 * LANES  # weights of a decision
    zero = s * s + price * cost[p]
    other_than_zero = price * (cost[65536 - p] + 2048)
    stop = _context_mix(
        nearest,
        where,
        inputs,
        context,
        first + nearest * by_kind,
        second + nearest * by_level,
        memory,
        tables,
    )
    if nearest == 1:
        return 0 if zero <= (s - 1) * (s - 1) + price * cost[65536 - stop] + other_than_zero else 1
    k = nearest - 1
    before = _context_mix(
        k, where, inputs, context, first + k * by_kind, second + k * by_level, memory, tables
    )
    same = (s - nearest) * (s - nearest) + price * (cost[before] + cost[65536 - stop])
    less = (s - nearest + 1) * (s - nearest + 1) + price * cost[65536 - before]
    if nearest == 2 and zero < min(same, less) + other_than_zero:
        return 0
    return nearest - 1 if less < same else nearest


def _add_centre(sums: Sequence, row: int, n: int, work: Work) -> None:
    m = work.magnitudes
    for x in range(n):
        sides = m[row + x - 1] + m[row + x + 1]
        work.expected[x] += BEFORE * m[row + x] + AROUND * sides
        sums[x] += 2 * m[row + x] + sides


def _add_neighbour(sums: Sequence, row: int, n: int, work: Work) -> None:
    m = work.magnitudes
    for x in range(n):
        work.expected[x] += AROUND * m[row + x]
        sums[x] += m[row + x]


def _prepare(
    t: int, z: int, y: int, r: int, band: Sequence, table: Sequence, work: Work, width: int
) -> int:
    """What is known of a row beforehand, into the sums of `work`; the weight of the neighbours that exist."""
    n1, n2, n = band[5] - band[1], band[6] - band[2], band[7] - band[3]
    m, filled, expected, plane, before, below = (
        work.magnitudes,
        work.filled,
        work.expected,
        work.plane,
        work.before,
        work.below,
    )
    m2 = n + 2 * PADDING
    m1, m0, r1, r0 = m2 * n2, m2 * n2 * n1, n2, n1 * n2
    f, row = band[30] + r, band[29] + r * m2 + PADDING
    for x in range(n):
        expected[x] = plane[x] = before[x] = below[x] = 0
    weight = LEFT + LEFT2
    if y > 0:
        weight += ABOVE + 2 * DIAGONAL
        if filled[f - 1]:
            for p in range(row - m2, row - m2 + n):
                sides = m[p - 1] + m[p + 1]
                expected[p - row + m2] += ABOVE * m[p] + DIAGONAL * sides
                plane[p - row + m2] += 2 * m[p] + sides
    if y > 1:
        weight += ABOVE2
        if filled[f - 2]:
            for x in range(n):
                expected[x] += ABOVE2 * m[row - 2 * m2 + x]
                plane[x] += m[row - 2 * m2 + x]
    if t > 0:
        weight += BEFORE + 4 * AROUND
        if filled[f - r0]:
            _add_centre(before, row - m0, n, work)
        if y > 0 and filled[f - r0 - 1]:
            _add_neighbour(before, row - m0 - m2, n, work)
        if y + 1 < n2 and filled[f - r0 + 1]:
            _add_neighbour(before, row - m0 + m2, n, work)
        if z > 0 and filled[f - r0 - r1]:
            _add_neighbour(before, row - m0 - m1, n, work)
        if z + 1 < n1 and filled[f - r0 + r1]:
            _add_neighbour(before, row - m0 + m1, n, work)
    if t > 1:
        weight += BEFORE2
        if filled[f - 2 * r0]:
            for x in range(n):
                expected[x] += BEFORE2 * m[row - 2 * m0 + x]
    if z > 0:
        weight += BEFORE + 4 * AROUND
        if filled[f - r1]:
            _add_centre(below, row - m1, n, work)
        if y > 0 and filled[f - r1 - 1]:
            _add_neighbour(below, row - m1 - m2, n, work)
        if y + 1 < n2 and filled[f - r1 + 1]:
            _add_neighbour(below, row - m1 + m2, n, work)
    if z > 1:
        weight += BEFORE2
        if filled[f - 2 * r1]:
            for x in range(n):
                expected[x] += BEFORE2 * m[row - 2 * m1 + x]
    for k in range(4):
        number, shift = band[9 + 5 * k], band[13 + 5 * k]
        if number >= 0:
            weight += REFERENCE + 2 * AROUND
        base = work.rows[k]
        if base < 0:
            for x in range(n):
                work.around[k * width + x] = 0
            continue
        other = table[number]
        last, stride = other[7] - other[3] - 1, other[7] - other[3] + 2 * PADDING
        up = base - stride if work.row_y[k] > 0 else PADDING
        down = base + stride if work.row_y[k] + 1 < other[6] - other[2] else PADDING
        for x in range(n):
            i = min(x >> shift, last)
            total = 2 * m[base + i] + m[base + i - 1] + m[base + i + 1] + m[up + i] + m[down + i]
            work.around[k * width + x] = total
            expected[x] += REFERENCE * m[base + i] + AROUND * total
    return weight


def _run(
    mode: int,
    q: Sequence,
    scaled: Sequence,
    price: float,
    shape: tuple[int, ...],
    table: Sequence,
    memory: Memory,
    tables: Tables,
    work: Work,
    data: Sequence,
) -> tuple[int, list[int]]:
    """0 or -1, and the bytes."""
    decoding = mode == DECODE
    out = [0 for _ in range(0)]
    log, rate, small = tables.log, tables.rate, tables.small
    span, m, where, inputs, context, width = (
        work.span,
        work.magnitudes,
        work.where,
        work.inputs,
        work.context,
        len(work.expected),
    )
    span[1] = 0xFFFFFFFF
    if decoding:
        for i in range(4):
            span[2] = (span[2] << 8) | (data[i] if i < len(data) else 0)
        span[3] = 4
    s2 = shape[3]
    s1 = s2 * shape[2]
    s0 = s1 * shape[1]

    for number in range(len(table)):
        band = table[number]
        n0, n1, n2, n3, kind = (
            band[4] - band[0],
            band[5] - band[1],
            band[6] - band[2],
            band[7] - band[3],
            band[8],
        )
        origin = band[0] * s0 + band[1] * s1 + band[2] * s2 + band[3]
        some = 0
        if not decoding:
            for r in range(n0 * n1 * n2):
                begin = origin + r // n2 // n1 * s0 + r // n2 % n1 * s1 + r % n2 * s2
                for at in range(begin, begin + n3):
                    if q[at] != 0:
                        some = 1
                        break
                if some:
                    break
        some = _chance(some, EMPTIES + kind, decoding, memory, rate, span, data, out)
        work.any[number] = some
        if not some:
            continue
        r1, r0, m2 = n2, n1 * n2, n3 + 2 * PADDING
        m1, m0 = m2 * n2, m2 * n2 * n1

        for r in range(n0 * n1 * n2):
            t, z, y = r // n2 // n1, r // n2 % n1, r % n2
            begin = origin + t * s0 + z * s1 + y * s2
            row, f = band[29] + r * m2 + PADDING, band[30] + r

            # The row of each reference that stands for this row.
            parent_filled = 0
            for k in range(4):
                to = band[9 + 5 * k]
                work.rows[k] = -1
                if to < 0 or not work.any[to]:
                    continue
                other = table[to]
                rt, rz = (
                    min(t >> band[10 + 5 * k], other[4] - other[0] - 1),
                    min(z >> band[11 + 5 * k], other[5] - other[1] - 1),
                )
                ry = min(y >> band[12 + 5 * k], other[6] - other[2] - 1)
                to_row = (rt * (other[5] - other[1]) + rz) * (other[6] - other[2]) + ry
                work.row_y[k] = ry
                work.rows[k] = other[29] + to_row * (other[7] - other[3] + 2 * PADDING) + PADDING
                if k == 0:
                    parent_filled = work.filled[other[30] + to_row]
            known = (
                (y > 0 and work.filled[f - 1])
                or (z > 0 and work.filled[f - r1])
                or (t > 0 and work.filled[f - r0])
            )
            if not (known or parent_filled):
                some = 0
                if not decoding:
                    for at in range(begin, begin + n3):
                        if q[at] != 0:
                            some = 1
                            break
                at = (
                    ROWS
                    + (2 if n3 > 24 else 0)
                    + (1 if y > 1 and work.filled[f - 2] else 0)
                    + (4 if r == 0 else 0)
                )
                if not _chance(some, at, decoding, memory, rate, span, data, out):
                    continue

            offset = 160 - _log16(_prepare(t, z, y, r, band, table, work, width), log)
            above = row - m2 if y > 0 else PADDING
            under = row - m1 if z > 0 else PADDING
            back = row - m0 if t > 0 else PADDING

            for x in range(n3):
                left, left2 = m[row + x - 1], m[row + x - 2]
                mu = work.expected[x] + LEFT * left + LEFT2 * left2
                level = min(max((_log16(mu, log) + offset) // 4 + 1, 0), LEVELS - 1) if mu else 0
                coarse = min(level // 2, 63)
                near, before, below = (
                    work.plane[x] + 2 * left + left2,
                    work.before[x],
                    work.below[x],
                )
                parent = _small(work.around[x], small)
                beside = (
                    (min(left, 2) * 3 + min(m[above + x], 2)) * 3 + min(m[above + x - 1], 2)
                ) * 3 + min(m[above + x + 1], 2)
                others = (min(parent, 6) * 7 + min(_small(work.around[width + x], small), 6)) * 7
                others = (others + min(_small(work.around[2 * width + x], small), 6)) * 7
                context[0] = level
                context[1] = kind * 64 + coarse
                context[2] = (beside * 3 + min(m[back + x], 2)) * 3 + min(m[under + x], 2)
                context[3] = (_small(near, small) * 12 + _small(before, small)) * 12 + _small(
                    below, small
                )
                context[4] = others + min(_small(work.around[3 * width + x], small), 6)
                context[5] = (
                    _small((near + before + below) // 2, small) * 12 + parent
                ) * KINDS + kind

                first, second = kind * LANES, SECOND + coarse * LANES
                p = _context_mix(0, where, inputs, context, first, second, memory, tables)
                at = begin + x
                value = 0 if decoding else q[at]
                if mode == CHOOSE:
                    best = _choose(abs(scaled[at]), p, price, first, second, memory, tables, work)
                    value = -best if scaled[at] < 0 else best
                    q[at] = value
                magnitude = abs(value)
                zero = _code(1 if magnitude == 0 else 0, p, decoding, span, data, out)
                _learn(CONTEXTS, where, inputs, first, second, p, zero, SLOW_LIMIT, memory, rate)
                if zero:
                    continue
                work.filled[f] = 1

                left_sign = _sign(q[at - 1]) if x > 0 else 1
                left2_sign = _sign(q[at - 2]) if x > 1 else 1
                y_sign = _sign(q[at - s2]) if y > 0 else 1
                y2_sign = _sign(q[at - 2 * s2]) if y > 1 else 1
                z_sign = _sign(q[at - s1]) if z > 0 else 1
                t_sign = _sign(q[at - s0]) if t > 0 else 1
                where[0] = SIGN_STARTS[0] + kind * 27 + (left_sign * 3 + y_sign) * 3 + t_sign
                where[1] = (
                    SIGN_STARTS[1]
                    + kind * 81
                    + ((left_sign * 3 + left2_sign) * 3 + y_sign) * 3
                    + y2_sign
                )
                where[2] = SIGN_STARTS[2] + kind * 27 + (t_sign * 3 + z_sign) * 3 + left_sign
                weights = SIGNS + kind * LANES
                p = _mix(SIGN_CONTEXTS, where, inputs, weights, -1, memory, tables)
                negative = _code(1 if value < 0 else 0, p, decoding, span, data, out)
                _learn(
                    SIGN_CONTEXTS, where, inputs, weights, -1, p, negative, SIGN_LIMIT, memory, rate
                )

                k = 1
                while k < UNARY:
                    first += KINDS * LANES
                    second += 64 * LANES
                    p = _context_mix(k, where, inputs, context, first, second, memory, tables)
                    more = _code(1 if magnitude > k else 0, p, decoding, span, data, out)
                    _learn(
                        CONTEXTS, where, inputs, first, second, p, more, SLOW_LIMIT, memory, rate
                    )
                    if not more:
                        break
                    k += 1
                if k == UNARY:
                    escape, rest, bits, j = level * 64, 0, 0, 0
                    if not decoding:
                        rest = magnitude - UNARY + 1
                        while (rest >> bits) > 1:
                            bits += 1
                    while _chance(
                        1 if j < bits else 0,
                        escape + min(j, 20),
                        decoding,
                        memory,
                        rate,
                        span,
                        data,
                        out,
                    ):
                        j += 1
                        if j > 30:
                            return -1, out
                    v = 1
                    for i in range(j - 1, -1, -1):
                        place = escape + 21 + min(j, 19) * 2 + (1 if i != j - 1 else 0)
                        v = (v << 1) | _chance(
                            (rest >> i) & 1, place, decoding, memory, rate, span, data, out
                        )
                    k = min(v + UNARY - 1, 0x7FFFFFFF)
                if decoding:
                    magnitude = k
                    q[at] = -k if negative else k
                m[row + x] = min(magnitude, MAX_MAGNITUDE)

    if not decoding:
        _finish(span, out)
    return 0, out


def _finish(span: Sequence, out: Sequence) -> None:
    # The fewest bytes that name a number from low to high; the decoder reads zeros past the end.
    low, high = span[0], span[1]
    for keep in range(5):
        v = high & ~(0xFFFFFFFF >> (8 * keep)) & 0xFFFFFFFF if keep else 0
        if v < low:
            continue
        for i in range(keep):
            out.append((v >> (24 - 8 * i)) & 255)
        break
    while len(out) > 0 and out[-1] == 0:
        out.pop()


def _sign(v: int) -> int:
    return 2 if v > 0 else 0 if v < 0 else 1
