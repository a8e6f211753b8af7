"""Marched units: float32 data as they are, and data with a large offset around 0."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from fhash_codec.measure.value_range import ValueRange
from fhash_codec.rendering.task.units import LARGE_OFFSET, Units
from fhash_codec.volume import Volume
from fhash_formats.errors import InputError


def volume(low: float, high: float, dtype: str) -> Volume:
    fields = SimpleNamespace(value_range=ValueRange(low, high), float_dtype=np.dtype(dtype))
    return cast(Volume, fields)


def test_float32_data_are_marched_as_they_are() -> None:
    assert Units.of(volume(-1.0, 3.0, "float32")) == Units()
    edge = LARGE_OFFSET
    assert Units.of(volume(edge - 2, edge, "float32")) == Units()
    assert Units.of(volume(edge, edge + 2, "float32")) != Units()


@pytest.mark.parametrize(
    ("low", "high"),
    [(0.0, 1.0), (1e6, 1e6 + 1), (-1e-300, 1e-300), (-1e300, 1e300), (5.0, 5.0)],
)
def test_converted_values_have_a_size_near_one(low: float, high: float) -> None:
    units = Units.of(volume(low, high, "float64"))
    assert math.frexp(units.factor)[0] == 0.5, "a power of two"
    ends = units.to([low, high])
    assert np.isfinite(ends).all()
    assert np.abs(ends).max() <= 1


def test_integers_that_are_one_float_cannot_be_drawn() -> None:
    top = 2**64 - 1
    with pytest.raises(InputError, match=f"cannot tell values from {top - 998} to {top} apart"):
        Units.of(volume(top - 998, top, "float64"))
    assert Units.of(volume(2**60, 2**60 + 998, "float64")).factor == 2.0**-10
    assert Units.of(volume(top, top, "float64")).factor > 0
