"""The adaptive coder of integers without the native library: twin of native/coder.cpp.

It follows that file step by step and gives the same bytes. The comments there give the reasons.
mixing_portable.py says how it runs with numba and without.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.transform.entropy.linear_portable import linear_learn, linear_logit
from fhash_formats.transform.entropy.magnitudes_portable import (
    MagnitudeWork,
    gather_magnitudes,
    learn_magnitude,
    magnitude_work,
    predict_magnitude,
)
from fhash_formats.transform.entropy.mixing_portable import (
    ARRAYS,
    LEARNING_RATE,
    LISTS,
    SLOW_LIMIT,
    Memory,
    Sequence,
    Stream,
    Tables,
    code_bit,
    code_simple,
    compiled,
    finish,
    keep_memory,
    learn,
    log16,
    memory_of,
    mix,
    start_range,
)
from fhash_formats.transform.entropy.prior import (
    CODERS,
    DECISIONS,
    KINDS,
    LANES,
    LEVELS,
    SIGN_SIZES,
    SIZES,
    State,
)
from fhash_formats.transform.entropy.signs_portable import (
    SIGN_LIMIT,
    SignWork,
    code_linear_sign,
    consistent,
    find_places,
    gather_signs,
    log_at,
    octaves,
    sign,
    sign_work,
)
from fhash_formats.transform.entropy.table import (
    BAND,
    COLUMNS,
    HIGH,
    KIND,
    LOW,
    REFERENCE_COLUMNS,
    REFERENCE_COUNT,
    REFERENCES,
    SHIFT,
)
from fhash_formats.transform.entropy.two_quantisers import (
    AFTER,
    MISPLACED,
    NO_TRELLIS,
    after_zeros,
)

__all__ = ["decode", "encode"]

CONTEXTS = 6
"""Estimates that are mixed for a decision about a magnitude."""
SIGN_CONTEXTS = 3
"""Estimates that are mixed for a sign."""
UNARY = 14
"""Magnitudes from this one on are coded by an escape code."""
SHARED = 2
"""Decisions from this one on are one for both quantisers; those of class 1 before it have the slots
and weights from UNARY on."""
MAX_MAGNITUDE = 4095
"""Largest magnitude that contexts see."""
PADDING = 2
"""Zeros at both ends of a row of magnitudes."""

LEFT = 184
"""Weight of the left neighbour in the expected magnitude; this and the next ones in 1/1024."""
LEFT2 = 20
"""Weight of the second left neighbour."""
ABOVE = 184
"""Weight of the neighbour above."""
DIAGONAL = 61
"""Weight of each neighbour beside the one above."""
ABOVE2 = 41
"""Weight of the second neighbour above."""
BEFORE = 102
"""Weight of the vertex one step before, and of the one in the layer below."""
AROUND = 20
"""Weight of each vertex around those two, and of the sum around a vertex of a reference."""
BEFORE2 = 31
"""Weight of the vertex two steps before, and of the one two layers below."""
REFERENCE = 62
"""Weight of the vertex of a reference."""

STARTS = tuple(sum(SIZES[:i]) * DECISIONS for i in range(CONTEXTS))
"""First slot of each estimate of a magnitude."""
SIGN_STARTS = tuple(sum(SIZES) * DECISIONS + sum(SIGN_SIZES[:i]) for i in range(SIGN_CONTEXTS))
"""First slot of each estimate of a sign."""
BY_KIND = KINDS * LANES
"""Weights of one decision in the sets that are chosen by the kind of the band."""
BY_LEVEL = 64 * LANES
"""Weights of one decision in the sets that are chosen by the expected magnitude."""
SECOND = DECISIONS * BY_KIND
"""First weight of the sets that are chosen by the expected magnitude."""
SIGNS = SECOND + DECISIONS * BY_LEVEL
"""First weight of the signs."""
ROWS = LEVELS * 64
"""First simple estimate of empty rows, after those of the escape code."""
EMPTIES = ROWS + 8
"""First simple estimate of empty bands."""

ENCODE = 0
"""Mode of a run that encodes."""
DECODE = 1
"""Mode of a run that decodes."""
CHOOSE = 2
"""Mode of a run that encodes magnitudes which it chooses by rate and distortion."""
LINEAR = 2
"""Number in CODERS of the coder with linear predictors of magnitudes."""
TRELLIS = 4
"""Added to ENCODE or DECODE: the integers are those of two quantisers."""

SIZE = COLUMNS
"""First of four columns that follow those of the table: lengths of the band along t, z, y, x."""
FIRST_ROW = COLUMNS + 4
"""Column: where the rows of the band begin in `Work.filled`."""
FIRST_MAGNITUDE = COLUMNS + 5
"""Column: where the magnitudes of the band begin in `Work.magnitudes`."""


class Work(NamedTuple):
    """Sequences that a run writes to.

    Attributes:
        any: by band, whether it has an integer other than 0.
        magnitudes: of all bands, with PADDING zeros at both ends of each row, after a row of zeros
            that stands for rows that do not exist.
        filled: by row of all bands, whether it has an integer other than 0.
        expected: by vertex of a row, the sum over its neighbours for the expected magnitude, but
            those to the left.
        plane, before, below: by vertex, sums over the rows above, the step before, the layer below.
        around: by reference and vertex, sums around the vertex of the reference.
        rows: by reference, where the row begins that stands for this row, or -1.
        row_y: by reference, the index of that row along y.
        context: of each estimate.
        where, inputs: of a decision, for `mix` and `learn`.
        other_where, other_inputs: the same for magnitudes that are only tried.
    """

    any: Sequence
    magnitudes: Sequence
    filled: Sequence
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
    coder: str,
    trellis: bool,
) -> bytes:
    """Code integers (t, z, y, x), in C order, and adapt the state.

    With `scaled` the integers are chosen anew, in place. With `trellis` they are those of two
    quantisers; raises InputError for others.
    """
    engine = _engine()
    real = (np.zeros(0) if scaled is None else np.asarray(scaled, dtype=np.float64)).ravel()
    mode = TRELLIS if trellis else ENCODE if scaled is None else CHOOSE
    shape = integers.shape
    memory = memory_of(state, engine is not None)
    q: Sequence
    if engine is None:
        q = integers.ravel().tolist()
        values = real.tolist()
        code, out = _start(engine, mode, coder, q, values, weight, shape, table, memory, b"")
        if mode == CHOOSE:
            integers[:] = np.array(q, dtype=np.int32).reshape(integers.shape)
    else:
        q = integers.reshape(-1)
        code, out = _start(engine, mode, coder, q, real, weight, shape, table, memory, b"")
    if code < 0:
        raise InputError(MISPLACED)
    keep_memory(memory, state)
    return bytes(out)


def decode(
    integers: npt.NDArray[np.int32],
    table: npt.NDArray[np.int32],
    data: bytes,
    state: State,
    coder: str,
    trellis: bool,
) -> None:
    """Decode into integers (t, z, y, x), which are zeros in C order.

    Raises DamagedFileError for bytes that no encoder writes.
    """
    engine = _engine()
    q: Sequence = [0] * integers.size if engine is None else integers.reshape(-1)
    real: Sequence = [] if engine is None else np.zeros(0)
    memory = memory_of(state, engine is not None)
    mode = DECODE | TRELLIS if trellis else DECODE
    code = _start(engine, mode, coder, q, real, 0.0, integers.shape, table, memory, data)[0]
    if code < 0:
        raise DamagedFileError("the coded integers are damaged")
    if engine is None:
        integers[:] = np.array(q, dtype=np.int32).reshape(integers.shape)


def _engine() -> Callable[..., Any] | None:
    """`_run` compiled, or None where numba cannot be imported."""
    helpers = (
        *(_small, _context_mix, _choose, _add_centre, _add_neighbour, _prepare),
        *(_any_nonzero, _find_references, _code_escape, _code_sign, after_zeros),
        *(code_linear_sign, consistent, find_places, gather_signs, log_at, octaves, sign),
        *(linear_learn, linear_logit, _predict, _learn),
        *(gather_magnitudes, predict_magnitude, learn_magnitude),
    )
    return compiled(_run, helpers)


def _start(
    engine: Callable[..., Any] | None,
    mode: int,
    coder: str,
    q: Sequence,
    scaled: Sequence,
    weight: float,
    shape: tuple[int, ...],
    table: npt.NDArray[np.int32],
    memory: Memory,
    data: bytes,
) -> tuple[int, list[int]]:
    """Make room for the bands and run."""
    bands = table.astype(np.int64)
    sizes = bands[:, HIGH : HIGH + 4] - bands[:, LOW : LOW + 4]
    width = int(sizes[:, 3].max(initial=0)) + 2 * PADDING
    rows = sizes[:, 0] * sizes[:, 1] * sizes[:, 2]
    first_row = np.cumsum([0, *rows])
    first_magnitude = np.cumsum([width, *(rows * (sizes[:, 3] + 2 * PADDING))])
    bands = np.column_stack([bands, sizes, first_row[:-1], first_magnitude[:-1]])
    lengths = {
        "any": len(bands),
        "magnitudes": int(first_magnitude[-1]),
        "filled": int(first_row[-1]),
        **dict.fromkeys(("expected", "plane", "before", "below"), width),
        "around": REFERENCE_COUNT * width,
        **dict.fromkeys(("rows", "row_y"), REFERENCE_COUNT),
        **dict.fromkeys(("context", "where", "other_where"), CONTEXTS),
        **dict.fromkeys(("inputs", "other_inputs"), LANES),
    }
    price = weight / 2048  # squared steps that 1/2048 bit is worth
    signs = sign_work(coder, memory.weights, shape, mode >= TRELLIS, compiled=engine is not None)
    magnitudes = magnitude_work(coder, memory.weights, signs.strides, compiled=engine is not None)
    model = CODERS.index(coder)
    if engine is None:
        work = Work(**{name: [0] * length for name, length in lengths.items()})
        span: Sequence = [0] * 4
        rows = bands.tolist()
        return _run(
            mode,
            model,
            q,
            scaled,
            price,
            shape,
            rows,
            memory,
            LISTS,
            work,
            signs,
            magnitudes,
            span,
            data,
        )
    work = Work(**{name: np.zeros(length, dtype=np.int64) for name, length in lengths.items()})
    span, source = np.zeros(4, np.int64), np.frombuffer(data, dtype=np.uint8).astype(np.int64)
    code, out = engine(
        mode,
        model,
        q,
        scaled,
        price,
        shape,
        bands,
        memory,
        ARRAYS,
        work,
        signs,
        magnitudes,
        span,
        source,
    )
    return code, out


def _small(v: int, small: Sequence) -> int:
    """The class, 0 to 11, of a magnitude or of a sum of some."""
    if v < 37:
        return int(small[v])
    return 9 if v <= 64 else 10 if v <= 140 else 11


def _any_nonzero(q: Sequence, begin: int, n: int) -> int:
    for at in range(begin, begin + n):
        if q[at] != 0:
            return 1
    return 0


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
    """Probability of a 1 in decision k: 0 is the zero flag, any other asks "more than k"."""
    for i in range(CONTEXTS):
        where[i] = STARTS[i] + context[i] * DECISIONS + k
    return mix(CONTEXTS, where, inputs, first, second, memory, tables)


def _predict(
    model: int,
    k: int,
    kind: int,
    coarse: int,
    near: int,
    where: Sequence,
    inputs: Sequence,
    work: Work,
    magnitudes: MagnitudeWork,
    memory: Memory,
    tables: Tables,
) -> int:
    """Probability of a 1 in decision k of the present vertex, by the model of the coder."""
    if model == LINEAR:
        for i in range(CONTEXTS):
            where[i] = STARTS[i] + work.context[i] * DECISIONS + k
        return predict_magnitude(k, where, near, magnitudes, memory, tables)
    first, second = (k * KINDS + kind) * LANES, SECOND + (k * 64 + coarse) * LANES
    return _context_mix(k, where, inputs, work.context, first, second, memory, tables)


def _learn(
    model: int,
    k: int,
    kind: int,
    coarse: int,
    p: int,
    bit: int,
    work: Work,
    magnitudes: MagnitudeWork,
    memory: Memory,
    tables: Tables,
) -> None:
    """Learn from the bit that came after `_predict`, which returned p."""
    if model == LINEAR:
        learn_magnitude(k, bit, work.where, magnitudes, memory, tables)
        return
    first, second = (k * KINDS + kind) * LANES, SECOND + (k * 64 + coarse) * LANES
    learn(
        CONTEXTS,
        work.where,
        work.inputs,
        first,
        second,
        p,
        bit,
        SLOW_LIMIT,
        LEARNING_RATE,
        memory,
        tables.rate,
    )


def _choose(
    s: float,
    p: int,
    price: float,
    model: int,
    kind: int,
    coarse: int,
    near: int,
    work: Work,
    magnitudes: MagnitudeWork,
    memory: Memory,
    tables: Tables,
) -> int:
    """The magnitude next to `s` that costs least: the nearest one, one less, or zero."""
    s = s if s < 1e9 else 1e9
    nearest = int(s + 0.5)
    if nearest == 0 or nearest >= UNARY:
        return nearest
    cost, where, inputs = tables.cost, work.other_where, work.other_inputs
    zero = s * s + price * cost[p]
    other_than_zero = price * (cost[65536 - p] + 2048)
    before = 0
    if nearest > 1:
        k = nearest - 1
        before = _predict(
            model, k, kind, coarse, near, where, inputs, work, magnitudes, memory, tables
        )
    stop = _predict(
        model, nearest, kind, coarse, near, where, inputs, work, magnitudes, memory, tables
    )
    if nearest == 1:
        return 0 if zero <= (s - 1) * (s - 1) + price * cost[65536 - stop] + other_than_zero else 1
    same = (s - nearest) * (s - nearest) + price * (cost[before] + cost[65536 - stop])
    less = (s - nearest + 1) * (s - nearest + 1) + price * cost[65536 - before]
    if nearest == 2 and zero < min(same, less) + other_than_zero:
        return 0
    return nearest - 1 if less < same else nearest


def _add_centre(sums: Sequence, row: int, n: int, work: Work) -> None:
    """Add the row one step before or one layer below."""
    m = work.magnitudes
    for x in range(n):
        sides = m[row + x - 1] + m[row + x + 1]
        work.expected[x] += BEFORE * m[row + x] + AROUND * sides
        sums[x] += 2 * m[row + x] + sides


def _add_neighbour(sums: Sequence, row: int, n: int, work: Work) -> None:
    """Add a row beside that one."""
    m = work.magnitudes
    for x in range(n):
        work.expected[x] += AROUND * m[row + x]
        sums[x] += m[row + x]


def _prepare(
    t: int, z: int, y: int, r: int, band: Sequence, table: Sequence, work: Work, width: int
) -> int:
    """Sum over the neighbours of a row that are coded before it, into the sums of `work`.

    Args:
        t, z, y: indices of the row within its band.
        r: number of the row within its band.
        band: row of the table.
        table: all bands.
        work: sequences of the run.
        width: length of `work.expected`.

    Returns:
        Sum of the weights of the neighbours that exist, those to the left included.
    """
    n1, n2, n = band[SIZE + 1], band[SIZE + 2], band[SIZE + 3]
    m, filled, expected, plane, before, below = (
        work.magnitudes,
        work.filled,
        work.expected,
        work.plane,
        work.before,
        work.below,
    )
    # Strides along y, z and t: of magnitudes (m2, m1, m0) and of rows (1, r1, r0).
    m2 = n + 2 * PADDING
    m1, m0, r1, r0 = m2 * n2, m2 * n2 * n1, n2, n1 * n2
    f, row = band[FIRST_ROW] + r, band[FIRST_MAGNITUDE] + r * m2 + PADDING
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
    for k in range(REFERENCE_COUNT):
        reference = REFERENCES + k * REFERENCE_COLUMNS
        number, shift = band[reference + BAND], band[reference + SHIFT + 3]
        if number >= 0:
            weight += REFERENCE + 2 * AROUND
        base = work.rows[k]
        if base < 0:
            for x in range(n):
                work.around[k * width + x] = 0
            continue
        other = table[number]
        last, stride = other[SIZE + 3] - 1, other[SIZE + 3] + 2 * PADDING
        up = base - stride if work.row_y[k] > 0 else PADDING
        down = base + stride if work.row_y[k] + 1 < other[SIZE + 2] else PADDING
        for x in range(n):
            i = min(x >> shift, last)
            total = 2 * m[base + i] + m[base + i - 1] + m[base + i + 1] + m[up + i] + m[down + i]
            work.around[k * width + x] = total
            expected[x] += REFERENCE * m[base + i] + AROUND * total
    return weight


def _find_references(t: int, z: int, y: int, band: Sequence, table: Sequence, work: Work) -> int:
    """Find the row of each reference for this row; whether the row of the parent is filled."""
    parent_filled = 0
    for k in range(REFERENCE_COUNT):
        reference = REFERENCES + k * REFERENCE_COLUMNS
        number = band[reference + BAND]
        work.rows[k] = -1
        if number < 0 or not work.any[number]:
            continue
        other = table[number]
        other_t = min(t >> band[reference + SHIFT], other[SIZE] - 1)
        other_z = min(z >> band[reference + SHIFT + 1], other[SIZE + 1] - 1)
        other_y = min(y >> band[reference + SHIFT + 2], other[SIZE + 2] - 1)
        row = (other_t * other[SIZE + 1] + other_z) * other[SIZE + 2] + other_y
        stride = other[SIZE + 3] + 2 * PADDING
        work.row_y[k] = other_y
        work.rows[k] = other[FIRST_MAGNITUDE] + row * stride + PADDING
        if k == 0:
            parent_filled = work.filled[other[FIRST_ROW] + row]
    return parent_filled


def _code_escape(magnitude: int, level: int, stream: Stream, memory: Memory, rate: Sequence) -> int:
    """Code a magnitude from UNARY on as an Exp-Golomb number; -1 for one that no encoder writes."""
    escape, rest, bits, j = level * 64, 0, 0, 0
    if not stream.decoding:
        rest = magnitude - UNARY + 1
        while (rest >> bits) > 1:
            bits += 1
    while code_simple(1 if j < bits else 0, escape + min(j, 20), stream, memory, rate):
        j += 1
        if j > 30:
            return -1
    v = 1
    for i in range(j - 1, -1, -1):
        at = escape + 21 + min(j, 19) * 2 + (1 if i != j - 1 else 0)
        v = (v << 1) | code_simple((rest >> i) & 1, at, stream, memory, rate)
    return min(v + UNARY - 1, 0x7FFFFFFF)


def _code_sign(
    bit: int,
    q: Sequence,
    at: int,
    t: int,
    z: int,
    y: int,
    x: int,
    kind: int,
    strides: tuple[int, int, int],
    work: Work,
    stream: Stream,
    memory: Memory,
    tables: Tables,
) -> int:
    """Code the sign of integer `at` by contexts alone; neighbours that do not exist count as 0."""
    s0, s1, s2 = strides
    left = sign(q[at - 1]) if x > 0 else 1
    left2 = sign(q[at - 2]) if x > 1 else 1
    up = sign(q[at - s2]) if y > 0 else 1
    up2 = sign(q[at - 2 * s2]) if y > 1 else 1
    below = sign(q[at - s1]) if z > 0 else 1
    before = sign(q[at - s0]) if t > 0 else 1
    where, inputs = work.where, work.inputs
    where[0] = SIGN_STARTS[0] + kind * 27 + (left * 3 + up) * 3 + before
    where[1] = SIGN_STARTS[1] + kind * 81 + (left * 3 + left2) * 9 + up * 3 + up2
    where[2] = SIGN_STARTS[2] + kind * 27 + (before * 3 + below) * 3 + left
    signs = SIGNS + kind * LANES
    p = mix(SIGN_CONTEXTS, where, inputs, signs, -1, memory, tables)
    bit = code_bit(bit, p, stream)
    learn(
        SIGN_CONTEXTS,
        where,
        inputs,
        signs,
        -1,
        p,
        bit,
        SIGN_LIMIT,
        LEARNING_RATE,
        memory,
        tables.rate,
    )
    return bit


def _run(
    mode: int,
    model: int,
    q: Sequence,
    scaled: Sequence,
    price: float,
    shape: tuple[int, ...],
    table: Sequence,
    memory: Memory,
    tables: Tables,
    work: Work,
    signs: SignWork,
    magnitudes: MagnitudeWork,
    span: Sequence,
    data: Sequence,
) -> tuple[int, list[int]]:
    """Code all bands: 0, -1 for bytes that no encoder writes, or NO_TRELLIS; and the bytes."""
    two_quantisers = mode >= TRELLIS
    mode -= TRELLIS if two_quantisers else 0
    decoding, state, one = mode == DECODE, 0, 0
    out = [0 for _ in range(0)]
    stream = Stream(decoding, span, data, out)
    rate, log, small = tables.rate, tables.log, tables.small
    m, where, inputs = work.magnitudes, work.where, work.inputs
    context, width = work.context, len(work.expected)
    start_range(stream)
    s2 = shape[3]
    s1 = s2 * shape[2]
    s0 = s1 * shape[1]

    for number in range(len(table)):
        band = table[number]
        n0, n1, n2, n3 = band[SIZE], band[SIZE + 1], band[SIZE + 2], band[SIZE + 3]
        kind = band[KIND]
        origin = band[LOW] * s0 + band[LOW + 1] * s1 + band[LOW + 2] * s2 + band[LOW + 3]
        some = 0
        if not decoding:
            for r in range(n0 * n1 * n2):
                begin = origin + r // n2 // n1 * s0 + r // n2 % n1 * s1 + r % n2 * s2
                some = _any_nonzero(q, begin, n3)
                if some:
                    break
        some = code_simple(some, EMPTIES + kind, stream, memory, rate)
        work.any[number] = some
        if not some:
            state = after_zeros(state, n0 * n1 * n2 * n3, AFTER)
            continue
        # Strides along y, z and t: of magnitudes (m2, m1, m0) and of rows (1, r1, r0).
        r1, r0, m2 = n2, n1 * n2, n3 + 2 * PADDING
        m1, m0 = m2 * n2, m2 * n2 * n1

        for r in range(n0 * n1 * n2):
            t, z, y = r // n2 // n1, r // n2 % n1, r % n2
            begin = origin + t * s0 + z * s1 + y * s2
            row, f = band[FIRST_MAGNITUDE] + r * m2 + PADDING, band[FIRST_ROW] + r

            parent_filled = _find_references(t, z, y, band, table, work)
            filled_beside = (
                (y > 0 and work.filled[f - 1])
                or (z > 0 and work.filled[f - r1])
                or (t > 0 and work.filled[f - r0])
            )
            if not (filled_beside or parent_filled):
                some = 0 if decoding else _any_nonzero(q, begin, n3)
                at = ROWS + (2 if n3 > 24 else 0) + (4 if r == 0 else 0)
                at += 1 if y > 1 and work.filled[f - 2] else 0
                if not code_simple(some, at, stream, memory, rate):
                    state = after_zeros(state, n3, AFTER)
                    continue

            offset = 160 - log16(_prepare(t, z, y, r, band, table, work, width), log)
            above = row - m2 if y > 0 else PADDING
            under = row - m1 if z > 0 else PADDING
            back = row - m0 if t > 0 else PADDING

            for x in range(n3):
                left, left2 = m[row + x - 1], m[row + x - 2]
                expected = work.expected[x] + LEFT * left + LEFT2 * left2
                level = 0
                if expected:
                    level = min(max((log16(expected, log) + offset) // 4 + 1, 0), LEVELS - 1)
                coarse = min(level // 2, 63)
                near = work.plane[x] + 2 * left + left2
                before, below = work.before[x], work.below[x]
                parent = _small(work.around[x], small)
                beside = (min(left, 2) * 3 + min(m[above + x], 2)) * 3 + min(m[above + x - 1], 2)
                beside = beside * 3 + min(m[above + x + 1], 2)
                others = (min(parent, 6) * 7 + min(_small(work.around[width + x], small), 6)) * 7
                others = (others + min(_small(work.around[2 * width + x], small), 6)) * 7
                sides = _small(before, small) * 12 + _small(below, small)
                both = _small((near + before + below) // 2, small)
                context[0] = level
                context[1] = kind * 64 + coarse
                context[2] = (beside * 3 + min(m[back + x], 2)) * 3 + min(m[under + x], 2)
                context[3] = _small(near, small) * 144 + sides
                context[4] = others + min(_small(work.around[3 * width + x], small), 6)
                context[5] = (both * 12 + parent) * KINDS + kind
                plain_near = near

                # The zero flag.
                one = state & 1 if two_quantisers else 0  # class of the quantiser
                near = min(_small(near, small), 6)
                if model == LINEAR:
                    vertex = magnitudes.vertex
                    vertex[0], vertex[1], vertex[2], vertex[6] = kind, coarse, plain_near, one
                    vertex[3] = min(_small(before + below, small), 6)
                    vertex[4] = min(parent, 6)
                    vertex[5] = max(log16(expected, log) + offset + 4, 0) if expected else 0
                    gather_magnitudes(q, band, table, t, z, y, x, magnitudes)
                k = UNARY if one else 0
                p = _predict(
                    model, k, kind, coarse, near, where, inputs, work, magnitudes, memory, tables
                )
                at = begin + x
                value = 0 if decoding else q[at]
                if mode == CHOOSE:
                    best = _choose(
                        abs(scaled[at]),
                        p,
                        price,
                        model,
                        kind,
                        coarse,
                        near,
                        work,
                        magnitudes,
                        memory,
                        tables,
                    )
                    value = -best if scaled[at] < 0 else best
                    q[at] = value
                    if model == LINEAR:  # trials have overwritten the prediction
                        _predict(
                            model,
                            k,
                            kind,
                            coarse,
                            near,
                            where,
                            inputs,
                            work,
                            magnitudes,
                            memory,
                            tables,
                        )
                if (one and value and not value & 1) or (two_quantisers and not one and value & 1):
                    return NO_TRELLIS, out
                magnitude = (abs(value) + one) // 2 if two_quantisers else abs(value)
                zero = code_bit(1 if magnitude == 0 else 0, p, stream)
                _learn(model, k, kind, coarse, p, zero, work, magnitudes, memory, tables)
                if zero:
                    state = AFTER[2 * state]
                    continue
                work.filled[f] = 1

                # The sign.
                negative = 1 if value < 0 else 0
                if model:
                    negative = code_linear_sign(
                        negative,
                        q,
                        band,
                        table,
                        kind,
                        t,
                        z,
                        y,
                        x,
                        signs,
                        stream,
                        memory,
                        tables,
                    )
                else:
                    negative = _code_sign(
                        negative,
                        q,
                        at,
                        t,
                        z,
                        y,
                        x,
                        kind,
                        (s0, s1, s2),
                        work,
                        stream,
                        memory,
                        tables,
                    )

                # The magnitude.
                k = 1
                while k < UNARY:
                    d = UNARY + k if one and k < SHARED else k
                    p = _predict(
                        model,
                        d,
                        kind,
                        coarse,
                        near,
                        where,
                        inputs,
                        work,
                        magnitudes,
                        memory,
                        tables,
                    )
                    more = code_bit(1 if magnitude > k else 0, p, stream)
                    _learn(model, d, kind, coarse, p, more, work, magnitudes, memory, tables)
                    if not more:
                        break
                    k += 1
                if k == UNARY:
                    k = _code_escape(magnitude, level, stream, memory, rate)
                    if k < 0:
                        return -1, out
                if decoding:
                    magnitude = k
                    k = min(2 * k - one, 0x7FFFFFFF) if two_quantisers else k
                    q[at] = -k if negative else k
                state = AFTER[2 * state + (magnitude & 1)]
                m[row + x] = min(magnitude, MAX_MAGNITUDE)

    if not decoding:
        finish(stream)
    return 0, out
