"""Small series and containers that several tests of the codec look at."""

from __future__ import annotations

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig


def waves(shape=(5, 9, 12, 20), dtype=np.float32) -> np.ndarray:
    """A smooth moving field with values in about -1 .. 2."""
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij")
    return (np.sin(5 * x + 3 * t) * np.cos(4 * y) + z).astype(dtype)


@pytest.fixture(scope="session")
def encoded(tmp_path_factory):
    """A field with a feature that leaves a part of the box out, three of five steps as key frames, and its container's path."""
    field = waves()
    path = tmp_path_factory.mktemp("encoded") / "waves.fhz"
    config = EncodeConfig(
        profile="paper", features=("interval:0.5:2",), key_frames="0,2,4", epochs=40, width=16
    )
    fhash_codec.encode(field, path, config)
    return field, path
