"""The code of a head's quantised weights: one big integer, by asymmetric numeral systems.

The frequencies are those of a fixed family. A weight w of a layer with spread s has the frequency
1 + floor(2**16 s**4 / (s**2 + w**2)**2), in integers: flat for a large s, narrow for a small one.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Sequence
from functools import lru_cache
from itertools import accumulate
from math import log2

import numpy as np
import numpy.typing as npt

__all__ = ["MAX_WEIGHT", "best_spread", "decode_weights", "encode_weights"]

MAX_WEIGHT = 31
"""Largest magnitude of a quantised weight (6 bits)."""
_SPREADS = range(1, 256)
"""Spreads that a layer may have."""
_ROUNDING = 1e-9
"""Relative error that a sum of bits has at most, in whatever order and by whatever logarithm."""


@lru_cache(maxsize=256)
def _model(spread: int) -> tuple[list[int], list[int]]:
    """The frequencies of the weights -MAX_WEIGHT to MAX_WEIGHT, and their running sums.

    The sums begin with 0 and end with the total.
    """
    square = spread * spread
    frequencies = [
        1 + (square * square << 16) // (square + weight * weight) ** 2
        for weight in range(-MAX_WEIGHT, MAX_WEIGHT + 1)
    ]
    return frequencies, [0, *accumulate(frequencies)]


@lru_cache(maxsize=1)
def _bits() -> npt.NDArray[np.float64]:
    """The bits of each weight -MAX_WEIGHT to MAX_WEIGHT by each of the spreads, nearly."""
    squares = np.array(_SPREADS, np.int64)[:, None] ** 2
    weights = np.arange(-MAX_WEIGHT, MAX_WEIGHT + 1)
    frequencies = 1 + (squares * squares << 16) // (squares + weights * weights) ** 2
    bits: npt.NDArray[np.float64] = np.log2(frequencies.sum(axis=1, keepdims=True) / frequencies)
    return bits


def best_spread(weights: Sequence[int]) -> int:
    """The spread in 1 to 255 whose frequencies code the weights in the fewest bits."""
    counts = sorted(Counter(weights).items())

    def bits(spread: int) -> float:
        frequencies, starts = _model(spread)
        return sum(
            count * log2(starts[-1] / frequencies[weight + MAX_WEIGHT]) for weight, count in counts
        )

    # Nearly equal sums are formed again in the order that is the same on every machine.
    places = [weight + MAX_WEIGHT for weight, _ in counts]
    sums = (_bits()[:, places] * [count for _, count in counts]).sum(axis=1)
    near = np.flatnonzero(sums <= sums.min() * (1 + _ROUNDING) + _ROUNDING)
    return min((_SPREADS[place] for place in near.tolist()), key=bits)


def encode_weights(state: int, weights: Sequence[int], spread: int) -> int:
    """The state with the weights pushed onto it; `decode_weights` pops them in order.

    state: the integer that holds everything coded so far.
    """
    frequencies, starts = _model(spread)
    for weight in reversed(weights):
        index = weight + MAX_WEIGHT
        quotient, rest = divmod(state, frequencies[index])
        state = quotient * starts[-1] + starts[index] + rest
    return state


def decode_weights(state: int, count: int, spread: int) -> tuple[int, list[int]]:
    """The state after its first `count` weights are popped, and the weights.

    Raises ValueError for spread 0.
    """
    if spread < 1:
        raise ValueError("a spread of 0")
    frequencies, starts = _model(spread)
    weights = []
    for _ in range(count):
        quotient, rest = divmod(state, starts[-1])
        index = bisect_right(starts, rest) - 1
        state = quotient * frequencies[index] + rest - starts[index]
        weights.append(index - MAX_WEIGHT)
    return state, weights
