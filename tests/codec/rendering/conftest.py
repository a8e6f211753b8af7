"""A small series as a compact file, as one of a feature, and as a network's, for pictures."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig, FhashWarning, Renderer, Volume, native

SHAPE = (3, 20, 24, 28)


def blobs() -> np.ndarray:
    """Two blobs that move apart, (t, z, y, x) float32, about 0 .. 10."""
    t, z, y, x = np.meshgrid(*map(np.arange, SHAPE), indexing="ij", sparse=True)
    first = 9 * np.exp(-((z - 9) ** 2 + (y - 10) ** 2 + (x - 9 + 2 * t) ** 2) / 14)
    second = 7 * np.exp(-((z - 12) ** 2 + (y - 14) ** 2 + (x - 19 - 2 * t) ** 2) / 10)
    return (first + second + 0.05 * np.sin(x / 3)).astype(np.float32)


@pytest.fixture(params=["native", "portable"])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Each way to compute: by the native library, and without it."""
    if request.param == "portable":
        monkeypatch.setenv("FHASH_NATIVE", "0")
    elif native.library() is None:
        pytest.skip("no native library")
    return str(request.param)


@pytest.fixture(scope="session")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Paths by kind: compact, feature, paper."""
    folder = tmp_path_factory.mktemp("pictures")
    configs = {
        "compact": EncodeConfig(effort=1),
        "feature": EncodeConfig(effort=1, features=("interval:3:99",), dilation=0),
        "paper": EncodeConfig(profile="paper", features=("interval:3:99",), epochs=15, width=16),
    }
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", FhashWarning
        )  # coding without the native core is slow, and here so little that it is not
        for name, config in configs.items():
            fhash_codec.encode(blobs(), folder / f"{name}.fhz", config)
    return {name: folder / f"{name}.fhz" for name in configs}


@pytest.fixture
def volume(files: dict[str, Path]) -> Iterator[Volume]:
    with fhash_codec.open(files["compact"]) as found:
        yield found


@pytest.fixture
def renderer(volume: Volume) -> Renderer:
    return Renderer(volume)
