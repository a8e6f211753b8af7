"""Signs by linear prediction without the native library: twin of native/coder_signs.hpp.

Neighbours are read from the integers themselves, in place of rows of logarithms.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fhash_formats.transform.entropy.linear_portable import (
    LINEAR_ARRAYS,
    LINEAR_LISTS,
    LinearTables,
    linear_learn,
    linear_logit,
    rates_of,
)
from fhash_formats.transform.entropy.mixing_portable import (
    LEARNING_RATE,
    Memory,
    Sequence,
    Stream,
    Tables,
    code_bit,
    learn,
    mix,
)
from fhash_formats.transform.entropy.prior import (
    BASE_WEIGHTS,
    CODERS,
    DECISIONS,
    KINDS,
    MORE_SIGN_SIZES,
    SIGN_INPUTS,
    SIGN_SET,
    SIGN_SIZES,
    SIZES,
)
from fhash_formats.transform.entropy.table import (
    BAND,
    COLUMNS,
    LOW,
    REFERENCE_COLUMNS,
    REFERENCE_COUNT,
    REFERENCES,
    SHIFT,
)

__all__ = [
    "SIGN_LIMIT",
    "SignWork",
    "code_linear_sign",
    "consistent",
    "find_places",
    "gather_signs",
    "log_at",
    "octaves",
    "sign",
    "sign_work",
]

ALL_SIGNS = len(SIGN_SIZES) + len(MORE_SIGN_SIZES)
"""Estimates that are mixed for a sign."""
STARTS = tuple(
    sum(SIZES) * DECISIONS + sum((*SIGN_SIZES, *MORE_SIGN_SIZES)[:i]) for i in range(ALL_SIGNS)
)
"""First slot of each estimate."""
SIGN_LINEAR = BASE_WEIGHTS + KINDS * SIGN_SET
"""First weight of the linear predictors of signs."""
SIGN_LIMIT = 255
"""Observations after which the slow rate of an estimate of a sign stays."""
LOGIT_BIN = 85
"""Width of the classes of the logit, in 1/256: a third."""
MAX_MAGNITUDE = 4095
"""Largest magnitude that inputs see."""
SIZE = COLUMNS
"""First of four columns that coder_portable.py adds to the table: lengths of the band."""


class SignWork(NamedTuple):
    """Sequences that signs need; those that are written to belong to one run.

    Attributes:
        tables: tabulated functions.
        rates, sums: by kind and input, of the linear predictors.
        uses: by kind.
        inputs: of the linear predictor.
        where, mixed: slots and inputs of the mixer.
        strides: of the integers along t, z, y, and 1 where they are those of two quantisers.
    """

    tables: LinearTables
    rates: Sequence
    sums: Sequence
    uses: Sequence
    inputs: Sequence
    where: Sequence
    mixed: Sequence
    strides: Sequence


def sign_work(
    coder: str, weights: Sequence, shape: Sequence, two: bool, *, compiled: bool
) -> SignWork:
    """The sequences of one run.

    Args:
        coder: one of CODERS; without linear predictors the sequences are short.
        weights: of the state.
        shape: of the integers (t, z, y, x).
        two: whether the integers are those of two quantisers.
        compiled: whether the sequences are arrays.
    """
    kinds = 0 if coder == CODERS[0] else KINDS
    sets = np.array(weights[SIGN_LINEAR : SIGN_LINEAR + kinds * 2 * SIGN_INPUTS], dtype=np.int64)
    squares = sets.reshape(kinds, 2, SIGN_INPUTS)[:, 1].ravel()
    strides = [shape[1] * shape[2] * shape[3], shape[2] * shape[3], shape[3], int(two)]
    sequences = [
        rates_of(squares, LINEAR_ARRAYS.sign_rate),
        np.zeros(kinds * SIGN_INPUTS, np.int64),
        np.zeros(kinds, np.int64),
        np.zeros(SIGN_INPUTS, np.int64),
        np.zeros(ALL_SIGNS, np.int64),
        np.zeros(2 * ALL_SIGNS, np.int64),
        np.array(strides, np.int64),
    ]
    if compiled:
        return SignWork(LINEAR_ARRAYS, *sequences)
    return SignWork(LINEAR_LISTS, *(sequence.tolist() for sequence in sequences))


def octaves(value: int, two: int, log: Sequence) -> int:
    """The logarithm of an integer's magnitude, with its sign; of its index with two quantisers."""
    magnitude = (abs(value) + 1) >> 1 if two else abs(value)
    size = log[min(magnitude, MAX_MAGNITUDE)]
    return -size if value < 0 else size


def log_at(
    q: Sequence, band: Sequence, t: int, z: int, y: int, x: int, strides: Sequence, log: Sequence
) -> int:
    """The signed logarithm at a place in a band, 0 outside of it."""
    if t < 0 or z < 0 or y < 0 or x < 0:
        return 0
    if t >= band[SIZE] or z >= band[SIZE + 1] or y >= band[SIZE + 2] or x >= band[SIZE + 3]:
        return 0
    at = (band[LOW] + t) * strides[0] + (band[LOW + 1] + z) * strides[1]
    return octaves(q[at + (band[LOW + 2] + y) * strides[2] + band[LOW + 3] + x], strides[3], log)


def consistent(a: int, b: int, c: int) -> int:
    """The least of three magnitudes, with the product of their signs."""
    least = min(min(abs(a), abs(b)), abs(c))
    return -least if ((a < 0) != (b < 0)) != (c < 0) else least


def gather_signs(
    q: Sequence,
    band: Sequence,
    table: Sequence,
    t: int,
    z: int,
    y: int,
    x: int,
    to: Sequence,
    strides: Sequence,
    log: Sequence,
) -> None:
    """Write the inputs of a sign to `to`."""
    for i in range(4):
        to[i] = log_at(q, band, t, z, y, x - 4 + i, strides, log)
        to[4 + i] = log_at(q, band, t, z, y - 1, x - 2 + i, strides, log)
        for row in range(3):
            at = y + row - 1
            to[8 + 4 * row + i] = log_at(q, band, t, z - 1, at, x - 1 + i, strides, log)
            to[20 + 4 * row + i] = log_at(q, band, t - 1, z, at, x - 1 + i, strides, log)
    to[32] = log_at(q, band, t, z, y - 1, x + 2, strides, log)
    to[33] = log_at(q, band, t, z, y - 2, x, strides, log)
    to[34] = log_at(q, band, t, z - 2, y, x, strides, log)
    to[35] = log_at(q, band, t - 1, z - 1, y, x, strides, log)
    to[36] = log_at(q, band, t - 1, z + 1, y, x, strides, log)
    to[37] = log_at(q, band, t - 2, z, y, x, strides, log)
    for i in range(38, SIGN_INPUTS):
        to[i] = 0
    for k in range(REFERENCE_COUNT):
        reference = REFERENCES + k * REFERENCE_COLUMNS
        number = band[reference + BAND]
        if number < 0:
            continue
        other = table[number]
        v = min(t >> band[reference + SHIFT], other[SIZE] - 1)
        w = min(z >> band[reference + SHIFT + 1], other[SIZE + 1] - 1)
        j = min(y >> band[reference + SHIFT + 2], other[SIZE + 2] - 1)
        i = min(x >> band[reference + SHIFT + 3], other[SIZE + 3] - 1)
        at = 40 + 8 * k
        for n in range(4):
            to[at + n] = log_at(q, other, v, w, j, i - 1 + n, strides, log)
        to[at + 4] = log_at(q, other, v, w, j - 1, i, strides, log)
        to[at + 5] = log_at(q, other, v, w, j + 1, i, strides, log)
        to[at + 6] = log_at(q, other, v, w - 1, j, i, strides, log)
        to[at + 7] = log_at(q, other, v, w + 1, j, i, strides, log)
        centre = to[at + 1]
        if k == 0:
            to[38] = centre if x & 1 else -centre
            to[39] = centre if y & 1 else -centre
        if band[reference + SHIFT + 3]:
            continue
        product = 72 + 6 * k
        to[product] = consistent(to[3], to[at], centre)
        to[product + 1] = consistent(to[6], to[at + 4], centre)
        to[product + 2] = consistent(to[13], to[at + 6], centre)
        before = log_at(q, other, v - 1, w, j, i, strides, log)
        to[product + 3] = consistent(to[25], before, centre)
        before = log_at(q, other, v, w, j - 1, i - 1, strides, log)
        to[product + 4] = consistent(to[5], before, centre)
        before = log_at(q, other, v, w, j - 1, i + 1, strides, log)
        to[product + 5] = consistent(to[7], before, centre)


def sign(v: int) -> int:
    """0 for a negative number, 1 for 0, 2 for a positive number."""
    return 2 if v > 0 else 0 if v < 0 else 1


def find_places(
    inputs: Sequence, logit: int, kind: int, t: int, y: int, x: int, where: Sequence
) -> None:
    """Write the slots of the estimates of a sign to `where`."""
    left, left2, up, up2 = sign(inputs[3]), sign(inputs[2]), sign(inputs[6]), sign(inputs[33])
    up_left, up_right, below = sign(inputs[5]), sign(inputs[7]), sign(inputs[13])
    before, before2 = sign(inputs[25]), sign(inputs[37])
    parent, parent_t = sign(inputs[41]), sign(inputs[49])
    parent_z, sibling = sign(inputs[57]), sign(inputs[65])
    parents = (parent * 3 + parent_t) * 3 + parent_z
    bins = min(max((logit + 12 * LOGIT_BIN + LOGIT_BIN // 2) // LOGIT_BIN, 0), 24)
    where[0] = STARTS[0] + kind * 27 + (left * 3 + up) * 3 + before
    where[1] = STARTS[1] + kind * 81 + ((left * 3 + left2) * 3 + up) * 3 + up2
    where[2] = STARTS[2] + kind * 27 + (before * 3 + below) * 3 + left
    where[3] = STARTS[3] + kind * 108 + parents * 4 + (x & 1) * 2 + (y & 1)
    where[4] = STARTS[4] + kind * 27 + (sibling * 3 + left) * 3 + up
    where[5] = STARTS[5] + kind * 81 + ((up_left * 3 + up_right) * 3 + left) * 3 + up
    where[6] = STARTS[6] + kind * 54 + ((before * 3 + before2) * 3 + parent_t) * 2 + (t & 1)
    where[7] = STARTS[7] + kind * 25 + bins


def code_linear_sign(
    bit: int,
    q: Sequence,
    band: Sequence,
    table: Sequence,
    kind: int,
    t: int,
    z: int,
    y: int,
    x: int,
    work: SignWork,
    stream: Stream,
    memory: Memory,
    tables: Tables,
) -> int:
    """Code the sign at (t, z, y, x) of a band; 1 for a negative one."""
    inputs, where, weights = work.inputs, work.where, memory.weights
    gather_signs(q, band, table, t, z, y, x, inputs, work.strides, work.tables.log)
    first = SIGN_LINEAR + kind * 2 * SIGN_INPUTS
    logit = linear_logit(SIGN_INPUTS, first, inputs, weights)
    find_places(inputs, logit, kind, t, y, x, where)
    mixing = BASE_WEIGHTS + kind * SIGN_SET
    trust = mixing + 2 * ALL_SIGNS
    more = (weights[trust] * logit) >> 2
    p = mix(ALL_SIGNS, where, work.mixed, mixing, -1, memory, tables, more)
    bit = code_bit(bit, p, stream)
    error = (((65535 if bit else 0) - p) * LEARNING_RATE) >> 4
    step = (error * logit + 32768) >> 16
    weights[trust] = min(max(weights[trust] + step, -32767), 32767)
    learn(
        ALL_SIGNS,
        where,
        work.mixed,
        mixing,
        -1,
        p,
        bit,
        SIGN_LIMIT,
        LEARNING_RATE,
        memory,
        tables.rate,
    )
    linear_learn(
        SIGN_INPUTS,
        first,
        inputs,
        logit,
        bit,
        weights,
        kind * SIGN_INPUTS,
        work.rates,
        work.sums,
        work.uses,
        kind,
        tables.squash,
        tables.log,
        work.tables.sign_rate,
    )
    return bit
