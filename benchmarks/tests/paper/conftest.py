"""A small series with a feature, for training in milliseconds."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_bench.paper.data import Data, gather_data
from fhash_formats.series import ArraySeries


def blob(steps: int = 5) -> ArraySeries:
    """A smooth blob that moves along x, float32 (t, z, y, x)."""
    t, z, y, x = np.meshgrid(*map(np.arange, (steps, 7, 9, 12)), indexing="ij")
    return ArraySeries(
        np.exp(-((z - 3) ** 2 + (y - 4) ** 2 + (x - 3 - t) ** 2) / 8).astype(np.float32)
    )


@pytest.fixture(scope="session")
def series() -> ArraySeries:
    return blob()


@pytest.fixture(scope="session")
def data(series: ArraySeries) -> Data:
    """Three key frames of the blob; the coreset is about a third of their vertices."""
    return gather_data("blob", series, "interval:0.2:2", "0,2,4")
