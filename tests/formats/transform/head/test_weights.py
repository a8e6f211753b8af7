"""The code of a head's weights: there and back, and the choice of the spread."""

from __future__ import annotations

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


def test_a_spread_of_0_is_refused() -> None:
    with pytest.raises(ValueError, match="spread"):
        decode_weights(1, 1, 0)
