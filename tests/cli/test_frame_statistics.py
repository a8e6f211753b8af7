"""Figures of decoded frames."""

from __future__ import annotations

import numpy as np

from fhash_cli.frame_statistics import Statistics


def test_statistics_of_huge_values_do_not_overflow() -> None:
    statistics = Statistics()
    for _ in range(3):
        statistics.add(np.array([[5e307, 1.5e308, np.nan]]), 2)
    assert statistics.result() == {
        "min": 5e307,
        "max": 1.5e308,
        "mean": 1e308,
        "inside_fraction": 2 / 3,
    }
