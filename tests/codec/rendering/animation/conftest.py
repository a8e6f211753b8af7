"""A small series of a ball that moves, for animations."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig, Volume
from fhash_formats.series import ArraySeries, Coordinate

SHAPE = (5, 8, 9, 10)


def ball() -> np.ndarray:
    """A ball of about 1 on 0 that moves along x, (t, z, y, x) float32."""
    t, z, y, x = np.meshgrid(*map(np.arange, SHAPE), indexing="ij", sparse=True)
    return np.exp(-((z - 3) ** 2 + (y - 4) ** 2 + (x - 2 - t) ** 2) / 5).astype(np.float32)


@pytest.fixture(scope="session")
def volume(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Volume]:
    """The ball as a compact file, with uneven times and a descending axis."""
    path = tmp_path_factory.mktemp("ball") / "ball.fhz"
    axes = {
        "t": [0.0, 1.0, 2.0, 4.0, 8.0],
        "z": 0.5 * np.arange(8),
        "y": np.arange(9.0),
        "x": 10 - np.arange(10.0),
    }
    coords = {
        axis: Coordinate(name=axis, values=np.asarray(values, dtype=float), attributes={})
        for axis, values in axes.items()
    }
    series = ArraySeries(ball(), name="density", units="", coords=coords)
    fhash_codec.encode(
        series, path, EncodeConfig(features=("interval:-1:9",), effort=1, max_error=0.002)
    )
    with fhash_codec.open(path) as opened:
        yield opened
