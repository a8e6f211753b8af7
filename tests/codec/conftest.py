"""Small series and containers that several tests of the codec use."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

import fhash_codec
from fhash_codec import EncodeConfig

sys.path.insert(0, str(Path(__file__).parent))


def waves(
    shape: tuple[int, ...], dtype: npt.DTypeLike = np.float32, scale: float = 1.0
) -> npt.NDArray[np.generic]:
    """A smooth moving field (t, z, y, x) with values in about -1 .. 2, times a scale."""
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij")
    return (scale * (np.sin(5 * x + 3 * t) * np.cos(4 * y) + z)).astype(dtype)


@pytest.fixture(scope="session")
def field() -> Callable[..., npt.NDArray[np.generic]]:
    """A function of a shape and a number type: a smooth moving field, values -100 .. 200."""

    def make(
        shape: tuple[int, ...] = (4, 8, 10, 18), dtype: npt.DTypeLike = np.float32
    ) -> npt.NDArray[np.generic]:
        return waves(shape, dtype, scale=100.0)

    return make


@pytest.fixture(scope="session")
def encoded(tmp_path_factory: pytest.TempPathFactory) -> tuple[npt.NDArray[np.generic], Path]:
    """A field, and the path of its container.

    A feature leaves a part of the box out; three of the five steps are key frames.
    """
    values = waves((5, 9, 12, 20))
    path = tmp_path_factory.mktemp("encoded") / "waves.fhz"
    config = EncodeConfig(
        preset="published",
        tables="float16",
        features=("interval:0.5:2",),
        key_frames="0,2,4",
        epochs=40,
        width=16,
    )
    fhash_codec.encode(values, path, config)
    return values, path
