"""The code of a head's weights: there and back, and the choice of the spread."""

from __future__ import annotations

from collections import Counter
from math import log2

import numpy as np
import pytest

from fhash_formats.transform.head.weights import (
    MAX_WEIGHT,
    best_spread,
    decode_weights,
    encode_weights,
)


def weights_of(spread: float, count: int = 300) -> list[int]:
    drawn = np.random.default_rng(4).normal(0, spread, count)
    return [int(weight) for weight in np.clip(np.rint(drawn), -MAX_WEIGHT, MAX_WEIGHT)]


@pytest.mark.parametrize("spread", [1, 8, 255])
def test_weights_pop_in_order_and_leave_the_state_before_them(spread: int) -> None:
    weights, before = weights_of(6.0), 12345
    state = encode_weights(before, weights, spread)
    assert decode_weights(state, 100, spread)[1] == weights[:100]
    assert decode_weights(state, len(weights), spread) == (before, weights)


@pytest.mark.parametrize("spread", [2.0, 6.0, 14.0])
def test_the_best_spread_takes_the_fewest_bits(spread: float) -> None:
    weights = weights_of(spread)
    best = best_spread(weights)
    bits = [encode_weights(1, weights, trial).bit_length() for trial in range(1, 256)]
    assert bits[best - 1] <= min(bits) + 1
    assert bits[best - 1] < 6 * len(weights)


@pytest.mark.parametrize("spread", [0.0, 0.4, 1.0, 3.0, 9.0, 31.0, 100.0])
@pytest.mark.parametrize("count", [0, 1, 7, 336])
def test_the_best_spread_is_the_first_of_the_fewest_bits(spread: float, count: int) -> None:
    weights = weights_of(spread, count)

    def frequency(spread: int, weight: int) -> int:
        return 1 + (spread**4 << 16) // (spread**2 + weight**2) ** 2

    def bits(spread: int) -> float:
        total = sum(frequency(spread, weight) for weight in range(-MAX_WEIGHT, MAX_WEIGHT + 1))
        counts = sorted(Counter(weights).items())
        return sum(count * log2(total / frequency(spread, weight)) for weight, count in counts)

    assert best_spread(weights) == min(range(1, 256), key=bits)


def test_a_spread_of_0_is_refused() -> None:
    with pytest.raises(ValueError, match="spread"):
        decode_weights(1, 1, 0)
