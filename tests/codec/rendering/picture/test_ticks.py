"""Ticks: round values with texts that tell them apart."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.rendering.picture.ticks import ticks


@pytest.mark.parametrize(
    ("low", "high", "texts"),
    [
        (0.0, 10.0, ["0", "2", "4", "6", "8", "10"]),
        (-1.0, 1.0, ["-1.0", "-0.5", "0.0", "0.5", "1.0"]),
        (101325.001, 101325.0045, ["101325.001", "101325.002", "101325.003", "101325.004"]),
        (0.0, 1e9, ["0", "2.0e+08", "4.0e+08", "6.0e+08", "8.0e+08", "1.0e+09"]),
        (1e-9, 4e-9, ["1e-09", "2e-09", "3e-09", "4e-09"]),
        (3.0, 3.0, ["3"]),
        (0.0, 1.2, ["0.00", "0.25", "0.50", "0.75", "1.00"]),
    ],
)
def test_ticks_are_round_and_told_apart(low: float, high: float, texts: list[str]) -> None:
    assert [text for _, text in ticks(low, high, 5)] == texts


@pytest.mark.parametrize("scale", [1e-300, 1e-12, 1.0, 3e7, 1e300])
@pytest.mark.parametrize("count", [1, 2, 5, 12])
def test_ticks_lie_within_the_ends_at_any_scale(scale: float, count: int) -> None:
    for low, high in ((0.13, 0.97), (-5.0, 3.0), (99.99, 100.01)):
        marks = ticks(low * scale, high * scale, count)
        values, texts = [value for value, _ in marks], [text for _, text in marks]
        assert 1 <= len(marks) <= 2.6 * count + 2
        assert len(set(texts)) == len(texts)
        assert all(
            low * scale - 1e-9 * abs(scale) <= value <= high * scale + 1e-9 * scale
            for value in values
        )
        np.testing.assert_allclose(
            [float(text) for text in texts], values, rtol=1e-6, atol=1e-9 * scale
        )
