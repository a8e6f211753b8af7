"""Even spacing of coordinates."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fhash_formats.writers.common.spacing import even_spacing


@pytest.mark.parametrize(
    ("values", "step"),
    [
        ([3.0], 1.0),
        ([0, 0.5, 1], 0.5),
        ([1, 0.5, 0], -0.5),
        (np.linspace(-7.3, 11.1, 1001), 18.4 / 1000),
        (np.linspace(50, 60, 101).astype("f4"), 0.1),  # as a file that keeps float32 would give it
        ([0, 1, 3], None),
        ([0, 1, 2.00001], None),
        ([0, 1, 1.0000001 * 2], 1.0000001),
        ([2, 2], None),
        ([0, 1, 0], None),
        ([0, np.nan, 2], None),
        ([0, np.inf], None),
        ([np.nan], None),
    ],
)
def test_even_spacing(values: Any, step: float | None) -> None:
    found = even_spacing(np.asarray(values, dtype=np.float64))
    assert found == (None if step is None else pytest.approx(step, rel=1e-6))
