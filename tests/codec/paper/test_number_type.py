"""Embeddings as numbers of a type and back."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.paper.number_type import NumberType


def test_unsigned_numbers_span_the_range_and_zero() -> None:
    values = np.array([2.0, 5.0], np.float32)
    kind = NumberType.of(values, "uint8")
    assert (kind.offset, kind.scale) == (0.0, 5.0 / 255)
    assert kind.stored(values).tolist() == [102, 255]
    assert kind.attributes == {"offset": 0.0, "scale": 5.0 / 255}


@pytest.mark.parametrize("name", ["float16", "float32"])
def test_floats_are_stored_as_they_are(name: str) -> None:
    values = np.array([[0.25, -3.5]], np.float32)
    kind = NumberType.of(values, name)
    assert kind.stored(values).dtype == name
    np.testing.assert_array_equal(kind.stored(values), values)
    assert kind.attributes == {}
