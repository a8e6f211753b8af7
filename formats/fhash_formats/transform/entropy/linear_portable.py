"""Linear predictors of binary decisions without the native library: twin of native/linear.hpp."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fhash_formats.transform.entropy.mixing_portable import ARRAYS, Sequence, log16

__all__ = [
    "LINEAR_ARRAYS",
    "LINEAR_LISTS",
    "LinearTables",
    "linear_learn",
    "linear_logit",
    "rates_of",
]

LINEAR_MAX = 2047
"""Largest logit, in 1/256."""
GRADIENT_MAX = 181
"""Largest gradient, in 1/128."""
PERIOD = 32
"""Uses of a predictor after which its mean squares and rates are made anew."""
RATE_CLASSES = 16 * 15 + 1
"""Classes of a mean square: 16 to an octave."""
SQUASH_ZERO = 2816
"""Entry of the table of probabilities for a logit of 0."""


class LinearTables(NamedTuple):
    """Tabulated functions, as in `LinearTables` of linear.hpp."""

    log: Sequence
    """Octaves of a magnitude plus 1, in 1/256."""
    sign_rate: Sequence
    """Rate of a weight of a sign by the class of its mean square."""
    rate: Sequence
    """The same, for zero flags and magnitudes."""


def _tables() -> dict[str, npt.NDArray[np.int64]]:
    """The tables; no value lies near a whole number before rounding (a test checks that)."""
    scale = 8388608 * np.exp(-np.arange(RATE_CLASSES) / 32 * 0.69314718055994531)
    tables = {
        "log": np.floor(256 * np.log2(1.0 + np.arange(4096)) + 0.5),
        "sign_rate": np.minimum(np.floor(0.006 * scale + 0.5), 32767),
        "rate": np.minimum(np.floor(0.002 * scale + 0.5), 32767),
    }
    return {name: values.astype(np.int64) for name, values in tables.items()}


LINEAR_ARRAYS = LinearTables(**_tables())
"""Tables of compiled runs."""
LINEAR_LISTS = LinearTables(*(values.tolist() for values in LINEAR_ARRAYS))
"""Tables of runs in plain Python."""


def rates_of(squares: npt.NDArray[np.int64], table: Sequence) -> npt.NDArray[np.int64]:
    """The rates of weights by the mean squares of their gradients."""
    shifts = np.maximum(np.floor(np.log2(np.maximum(squares, 1))).astype(np.int64) - 11, 0)
    classes = ARRAYS.log[np.maximum(squares, 1) >> shifts] + 16 * shifts
    rates: npt.NDArray[np.int64] = np.asarray(table)[np.minimum(classes, RATE_CLASSES - 1)]
    return rates


def linear_logit(n: int, first: int, inputs: Sequence, weights: Sequence) -> int:
    """The logit of a 1, in 1/256: the product of n inputs and the weights from `first` on."""
    dot = 0
    for i in range(n):
        dot += weights[first + i] * inputs[i]
    # The sum of the native form wraps at 32 bits.
    dot = ((dot + 0x80000000) & 0xFFFFFFFF) - 0x80000000
    return min(max(dot >> 14, -LINEAR_MAX), LINEAR_MAX)


def linear_learn(
    n: int,
    first: int,
    inputs: Sequence,
    logit: int,
    bit: int,
    weights: Sequence,
    at: int,
    rates: Sequence,
    sums: Sequence,
    uses: Sequence,
    number: int,
    squash: Sequence,
    log: Sequence,
    table: Sequence,
) -> None:
    """Learn from the bit that came after `linear_logit`.

    Args:
        n, first, inputs, weights: as for `linear_logit`; the mean squares follow the weights.
        logit: what that returned.
        bit: the bit that was coded.
        at: first entry of the predictor in `rates` and `sums`.
        rates: rates of all predictors.
        sums: sums of squares of gradients since the rates were made.
        uses: by predictor, how often it was used.
        number: number of the predictor.
        squash, log: of `Tables`.
        table: rates by class.
    """
    error = ((65535 if bit else 0) - squash[logit + SQUASH_ZERO]) >> 1
    for i in range(n):
        gradient = (error * inputs[i] + 32768) >> 16
        gradient = min(max(gradient, -GRADIENT_MAX), GRADIENT_MAX)
        weight = weights[first + i] + ((gradient * rates[at + i] + 256) >> 9)
        weights[first + i] = min(max(weight, -32767), 32767)
        sums[at + i] += (gradient * gradient) >> 4
    uses[number] += 1
    if uses[number] % PERIOD:
        return
    for i in range(n):
        square = weights[first + n + i]
        square += ((sums[at + i] >> 1) - square + 8) >> 4
        weights[first + n + i] = square
        sums[at + i] = 0
        rates[at + i] = table[min(log16(max(square, 1), log), RATE_CLASSES - 1)]
