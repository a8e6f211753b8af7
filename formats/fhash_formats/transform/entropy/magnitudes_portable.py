"""Zero flags and magnitudes by linear prediction without the native library.

This is the twin of native/coder_linear.hpp. Neighbours are read from the integers themselves.
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
    SLOW_LIMIT,
    STRETCH_MAX,
    Memory,
    Sequence,
    Tables,
    learn_slots,
    stretched,
)
from fhash_formats.transform.entropy.prior import (
    BASE_WEIGHTS,
    CODERS,
    DECISIONS,
    INPUTS,
    KINDS,
    SET_CLASSES,
    SET_NUMBERS,
    SETS,
    SIGN_INPUTS,
    SIGN_SET,
    SIZES,
)
from fhash_formats.transform.entropy.signs_portable import log_at
from fhash_formats.transform.entropy.table import (
    BAND,
    COLUMNS,
    REFERENCE_COLUMNS,
    REFERENCE_COUNT,
    REFERENCES,
    SHIFT,
)

__all__ = [
    "COARSE",
    "MagnitudeWork",
    "gather_magnitudes",
    "learn_magnitude",
    "magnitude_work",
    "predict_magnitude",
]

LINEAR = BASE_WEIGHTS + KINDS * SIGN_SET + KINDS * 2 * SIGN_INPUTS
"""First number of the linear predictors."""
MIXING = LINEAR + DECISIONS * KINDS * 2 * INPUTS
"""First number of the sets of mixing weights."""
SHARES = MIXING + DECISIONS * sum(SET_CLASSES) * SET_NUMBERS
"""First share of the four sets in their sum."""
FIRST_SETS = tuple(DECISIONS * sum(SET_CLASSES[:m]) for m in range(SETS))
"""Number of the first set of each of the four."""
CONTEXTS = len(SIZES)
"""Estimates that are mixed."""
MIX_INPUTS = SET_NUMBERS - 1
"""Inputs of a set: two per estimate, the logit, a constant, and zeros."""
CONSTANT = 77
"""The constant input, in 1/256."""
MAX_USES = 8191
"""Uses of a set that are counted."""
MAX_SHARE = 131071
"""Largest share of a set in the sum, 1 is 65536."""
SIZE = COLUMNS
"""First of four columns that coder_portable.py adds to the table: lengths of the band."""

KIND = 0
"""Entry of `MagnitudeWork.vertex`: kind of the band."""
COARSE = 1
"""Entry: half octaves of the expected magnitude."""
NEAR = 2
"""Entry: sum of the magnitudes near it in its layer."""
BOTH = 3
"""Entry: class of the sum over the step before and the layer below."""
PARENT = 4
"""Entry: class of the sum around the parent."""
EXPECTED = 5
"""Entry: the expected magnitude in 16ths of an octave, 0 for none."""
ONE = 6
"""Entry: class of the quantiser."""
LOGIT = 0
"""Entry of `MagnitudeWork.guess`: the logit of the linear predictor."""
GUESSED = 1
"""Entry: the probability."""
LOGITS = 2
"""First of four entries: the logits of the sets."""
SET_AT = 6
"""First of four entries: where the numbers of the sets begin."""


class MagnitudeWork(NamedTuple):
    """Sequences that magnitudes need; those that are written to belong to one run.

    Attributes:
        tables: tabulated functions.
        rates, sums: by decision, kind and input, of the linear predictors.
        uses: by decision and kind.
        inputs: of the linear predictor.
        vertex: what is known of the vertex, see KIND and so on.
        guess: the last prediction, see LOGIT and so on.
        mixed: inputs of the mixer.
        strides: as in `SignWork`.
    """

    tables: LinearTables
    rates: Sequence
    sums: Sequence
    uses: Sequence
    inputs: Sequence
    vertex: Sequence
    guess: Sequence
    mixed: Sequence
    strides: Sequence


def magnitude_work(
    coder: str, weights: Sequence, strides: Sequence, *, compiled: bool
) -> MagnitudeWork:
    """The sequences of one run; arguments as for `sign_work`."""
    sets = DECISIONS * KINDS if coder == CODERS[2] else 0
    numbers = np.array(weights[LINEAR : LINEAR + sets * 2 * INPUTS], dtype=np.int64)
    sequences = [
        rates_of(numbers.reshape(sets, 2, INPUTS)[:, 1].ravel(), LINEAR_ARRAYS.rate),
        np.zeros(sets * INPUTS, np.int64),
        np.zeros(sets, np.int64),
        np.zeros(INPUTS, np.int64),
        np.zeros(ONE + 1, np.int64),
        np.zeros(SET_AT + SETS, np.int64),
        np.zeros(MIX_INPUTS, np.int64),
    ]
    if compiled:
        return MagnitudeWork(LINEAR_ARRAYS, *sequences, strides)
    return MagnitudeWork(LINEAR_LISTS, *(each.tolist() for each in sequences), strides)


def gather_magnitudes(
    q: Sequence,
    band: Sequence,
    table: Sequence,
    t: int,
    z: int,
    y: int,
    x: int,
    work: MagnitudeWork,
) -> None:
    """Write the inputs at (t, z, y, x) of a band; `work.vertex` is set."""
    to, strides, log, vertex = work.inputs, work.strides, work.tables.log, work.vertex
    for i in range(4):
        to[i] = abs(log_at(q, band, t, z, y, x - 4 + i, strides, log))
        to[4 + i] = abs(log_at(q, band, t, z, y - 1, x - 2 + i, strides, log))
        for row in range(3):
            at = y + row - 1
            to[8 + 4 * row + i] = abs(log_at(q, band, t, z - 1, at, x - 1 + i, strides, log))
            to[20 + 4 * row + i] = abs(log_at(q, band, t - 1, z, at, x - 1 + i, strides, log))
    for k in range(REFERENCE_COUNT):
        reference = REFERENCES + k * REFERENCE_COLUMNS
        number = band[reference + BAND]
        if number < 0:
            for n in range(4):
                to[32 + 4 * k + n] = 0
            to[48 + 2 * k] = to[49 + 2 * k] = 0
            continue
        other = table[number]
        v = min(t >> band[reference + SHIFT], other[SIZE] - 1)
        w = min(z >> band[reference + SHIFT + 1], other[SIZE + 1] - 1)
        j = min(y >> band[reference + SHIFT + 2], other[SIZE + 2] - 1)
        i = min(x >> band[reference + SHIFT + 3], other[SIZE + 3] - 1)
        for n in range(4):
            to[32 + 4 * k + n] = abs(log_at(q, other, v, w, j, i - 1 + n, strides, log))
        to[48 + 2 * k] = abs(log_at(q, other, v, w, j - 1, i, strides, log))
        to[49 + 2 * k] = abs(log_at(q, other, v, w, j + 1, i, strides, log))
    to[56] = abs(log_at(q, band, t, z, y - 2, x, strides, log))
    to[57] = abs(log_at(q, band, t, z - 2, y, x, strides, log))
    to[58] = abs(log_at(q, band, t - 2, z, y, x, strides, log))
    to[59] = 8 * vertex[EXPECTED]
    to[60] = 512
    to[61] = 256 * vertex[ONE]
    to[62] = log[min(vertex[NEAR], 4095)]
    to[63] = log[min(x, 4095)] // 4


def predict_magnitude(
    k: int, where: Sequence, near: int, work: MagnitudeWork, memory: Memory, tables: Tables
) -> int:
    """Probability of a 1 in decision k.

    Args:
        k: the decision, with the classes of the quantisers.
        where: slots of the estimates.
        near: class, 0 to 6, of what is near.
        work, memory, tables: of the run.
    """
    weights, vertex, guess, mixed = memory.weights, work.vertex, work.guess, work.mixed
    stretched(CONTEXTS, where, mixed, memory, tables)
    number = k * KINDS + vertex[KIND]
    logit = linear_logit(INPUTS, LINEAR + number * 2 * INPUTS, work.inputs, weights)
    mixed[2 * CONTEXTS], mixed[2 * CONTEXTS + 1] = logit, CONSTANT
    bins = min(max((logit + 2048) >> 6, 0), 63)
    guess[LOGIT] = logit
    guess[SET_AT] = FIRST_SETS[0] + number
    guess[SET_AT + 1] = FIRST_SETS[1] + k * 64 + vertex[COARSE]
    guess[SET_AT + 2] = FIRST_SETS[2] + k * 343 + (near * 7 + vertex[BOTH]) * 7 + vertex[PARENT]
    guess[SET_AT + 3] = FIRST_SETS[3] + k * 512 + bins * 8 + near
    total = 0
    for m in range(SETS):
        first = MIXING + guess[SET_AT + m] * SET_NUMBERS
        guess[SET_AT + m] = first
        dot = 0
        for i in range(2 * CONTEXTS + 2):
            dot += weights[first + i] * mixed[i]
        dot = ((dot + 0x80000000) & 0xFFFFFFFF) - 0x80000000
        guess[LOGITS + m] = min(max(dot >> 14, -STRETCH_MAX), STRETCH_MAX)
        total += weights[SHARES + number * SETS + m] * guess[LOGITS + m]
    total = min(max(total >> 16, -STRETCH_MAX), STRETCH_MAX)
    guess[GUESSED] = tables.squash[total + STRETCH_MAX]
    return int(guess[GUESSED])


def learn_magnitude(
    k: int, bit: int, where: Sequence, work: MagnitudeWork, memory: Memory, tables: Tables
) -> None:
    """Learn from the bit that came after `predict_magnitude`."""
    weights, guess, mixed = memory.weights, work.guess, work.mixed
    target = 65535 if bit else 0
    error = target - guess[GUESSED]
    number = k * KINDS + work.vertex[KIND]
    for m in range(SETS):
        at, logit = SHARES + number * SETS + m, guess[LOGITS + m]
        share = weights[at] + ((error * logit + (1 << 18)) >> 19)
        weights[at] = min(max(share, -MAX_SHARE), MAX_SHARE)
        first = guess[SET_AT + m]
        uses = weights[first + MIX_INPUTS]
        own = target - tables.squash[logit + STRETCH_MAX]
        step = (own * (48 + 384 // (1 + (uses >> 5)))) >> 8
        for i in range(2 * CONTEXTS + 2):
            weight = weights[first + i] + ((step * mixed[i] + 32768) >> 16)
            weights[first + i] = min(max(weight, -32767), 32767)
        if uses < MAX_USES:
            weights[first + MIX_INPUTS] = uses + 1
    learn_slots(CONTEXTS, where, bit, SLOW_LIMIT, memory, tables.rate)
    linear_learn(
        INPUTS,
        LINEAR + number * 2 * INPUTS,
        work.inputs,
        guess[LOGIT],
        bit,
        weights,
        number * INPUTS,
        work.rates,
        work.sums,
        work.uses,
        number,
        tables.squash,
        tables.log,
        work.tables.rate,
    )
