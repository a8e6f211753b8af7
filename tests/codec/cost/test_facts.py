"""Figures of a series that every measurement needs."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.cost.facts import facts_of
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries


def test_range_bulk_size_and_missing_values() -> None:
    values = np.linspace(0, 1, 4000, dtype=np.float32).reshape(1, 10, 20, 20)
    values[0, 0, 0, :3] = np.nan
    facts = facts_of(ArraySeries(values), silent)
    assert facts.missing == 3
    assert facts.raw_bytes == values.nbytes
    assert facts.width == pytest.approx(1, abs=0.01)
    assert facts.bulk is not None
    assert 0.97 < facts.bulk.high - facts.bulk.low < facts.width
    errors = facts.errors()
    errors.add(0, values[0], values[0] + np.float32(0.1))
    assert errors.psnr == pytest.approx(20, abs=0.1)


def test_a_constant_series_has_no_width() -> None:
    facts = facts_of(ArraySeries(np.ones((2, 3, 4, 5))), silent)
    assert (facts.width, facts.bulk) == (0.0, None)
