"""Layouts: the parts of a series, and where a region lies in them."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.bench.rate.layouts import LAYOUTS, joined, parts_of, spans_of
from fhash_codec.boxes import Box

VALUES = np.arange(3 * 4 * 5 * 6).reshape(3, 4, 5, 6)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_parts_come_back_and_regions_are_found(layout: str) -> None:
    parts = parts_of(VALUES, layout)
    np.testing.assert_array_equal(joined(parts, layout, VALUES.shape), VALUES)
    assert sum(part.size for part in parts) == VALUES.size
    box = Box.of(((1, 3), (0, 2), (2, 6)))
    found = [
        parts[number][tuple(slice(*span) for span in spans)].ravel()
        for number, spans in spans_of(layout, VALUES.shape, 2, box)
    ]
    np.testing.assert_array_equal(np.concatenate(found), VALUES[2, 1:3, 0:2, 2:6].ravel())
