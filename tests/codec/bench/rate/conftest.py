"""A noisy wave, and everything that is measured of it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from fhash_codec.bench.rate.rate import bench_rate
from fhash_codec.bench.rate.results import RateBench


def wave(shape: tuple[int, ...] = (4, 6, 20, 24)) -> np.ndarray:
    """A moving wave with a little noise, values in about -1 .. 2."""
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij")
    noise = np.random.default_rng(0).normal(size=shape)
    return (np.sin(5 * x + 3 * t) * np.cos(4 * y) + z + 0.01 * noise).astype(np.float32)


@pytest.fixture(scope="session")
def field() -> Callable[..., np.ndarray]:
    """A function of a shape (t, z, y, x): the noisy wave."""
    return wave


@pytest.fixture(scope="session")
def result() -> RateBench:
    """Every peer and the profile paper, measured at two targets and one bound."""
    config = {"epochs": 2, "width": 4, "seed": 1}
    return bench_rate(wave(), config, targets=(35.0, 50.0), bounds=(0.02,), profiles=("paper",))
