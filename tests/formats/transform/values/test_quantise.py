"""The quantiser: its dead zone, and its reconstruction points."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fhash_formats.transform.values.quantise import dequantise, quantise


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_magnitudes_are_rounded_down_after_the_rounding_is_added(dtype: Any) -> None:
    coefficients = np.array([0.0, 0.25, -0.375, 0.5, -1.0, 3e12], dtype)
    integers, scaled = quantise(coefficients, 0.5, rounding=0.375)
    assert integers.tolist() == [0, 0, -1, 1, -2, 10**9]
    assert scaled.tolist() == [0.0, 0.5, -0.75, 1.0, -2.0, float(np.float32(6e12))]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_six_offsets_tell_odd_from_even(dtype: Any) -> None:
    integers = np.array([0, 1, -2, 3, -4, 5, 6, -7, 1000], np.int32)
    values = dequantise(integers, 1.0, (64, 32, 16, 8, -64, -32), dtype)
    assert values.tolist() == [0.0, 1.5, -2.25, 3.125, -4.0625, 4.5, 5.75, -6.5, 999.75]
