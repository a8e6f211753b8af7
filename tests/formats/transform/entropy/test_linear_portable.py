"""Linear predictors: the tables, and that a predictor learns what decides a bit."""

from __future__ import annotations

import numpy as np

from fhash_formats.transform.entropy.linear_portable import (
    LINEAR_ARRAYS,
    LINEAR_LISTS,
    RATE_CLASSES,
    linear_learn,
    linear_logit,
    rates_of,
)
from fhash_formats.transform.entropy.mixing_portable import ARRAYS, LISTS, log16


def test_no_entry_of_the_tables_lies_near_a_rounding_boundary() -> None:
    scale = 8388608 * np.exp(-np.arange(RATE_CLASSES) / 32 * 0.69314718055994531)
    exact = {
        "log": 256 * np.log2(1.0 + np.arange(4096)),
        "sign_rate": 0.006 * scale,
        "rate": 0.002 * scale,
    }
    for name, values in exact.items():
        below = values < 32767
        fraction = (values[below] + 0.5) % 1
        away = np.minimum(fraction, 1 - fraction)
        assert away.min() > 1e-9, name
        assert np.array_equal(
            getattr(LINEAR_ARRAYS, name)[below], np.floor(values[below] + 0.5).astype(np.int64)
        )


def test_rates_are_those_of_the_class() -> None:
    squares = np.array([0, 1, 2, 3, 4095, 4096, 5000, 8191, 8192, 20000, 32752], dtype=np.int64)
    classes = [min(log16(max(int(v), 1), ARRAYS.log), RATE_CLASSES - 1) for v in squares]
    assert np.array_equal(rates_of(squares, LINEAR_ARRAYS.rate), LINEAR_ARRAYS.rate[classes])


def test_a_predictor_finds_the_input_that_decides() -> None:
    n, random = 4, np.random.default_rng(0)
    weights = [0] * n + [16] * n
    rates = rates_of(np.array(weights[n:]), LINEAR_ARRAYS.sign_rate).tolist()
    sums, uses, right = [0] * n, [0], 0
    for turn in range(600):
        inputs = (256 * random.integers(-2, 3, n)).tolist()
        bit = int(inputs[2] > 0) if inputs[2] else int(random.integers(2))
        logit = linear_logit(n, 0, inputs, weights)
        right += turn >= 300 and inputs[2] != 0 and (logit > 0) != bit
        linear_learn(
            n,
            0,
            inputs,
            logit,
            bit,
            weights,
            0,
            rates,
            sums,
            uses,
            0,
            LISTS.squash,
            LISTS.log,
            LINEAR_LISTS.sign_rate,
        )
    assert right == 0
    assert weights[2] > 4 * max(abs(weights[i]) for i in (0, 1, 3))


def test_sums_wrap_at_32_bits() -> None:
    assert linear_logit(1, 0, [1 << 15], [1 << 16]) < 0
