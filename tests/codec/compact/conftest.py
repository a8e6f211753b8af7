"""A small series, and a container of it with vertices outside the coreset."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import pytest

import fhash_codec
from fhash_codec import EncodeConfig


class MakeField(Protocol):
    """A function that makes a series."""

    def __call__(
        self, shape: tuple[int, ...] = (5, 9, 12, 20), dtype: npt.DTypeLike = np.float32
    ) -> npt.NDArray[Any]: ...


def make_field(
    shape: tuple[int, ...] = (5, 9, 12, 20), dtype: npt.DTypeLike = np.float32
) -> npt.NDArray[Any]:
    """Return a smooth moving field with a little noise, values in about -150 .. 250."""
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij")
    noise = np.random.default_rng(0).normal(size=shape)
    return (100 * (np.sin(5 * x + 3 * t) * np.cos(4 * y) + z) + noise).astype(dtype)


@pytest.fixture(scope="session")
def field() -> MakeField:
    """The function `make_field`."""
    return make_field


@pytest.fixture(scope="session")
def feature(tmp_path_factory: pytest.TempPathFactory) -> tuple[npt.NDArray[Any], Path]:
    """A field, and its container of many tiles with vertices outside the coreset."""
    source = make_field()
    path = tmp_path_factory.mktemp("compact") / "a.fhz"
    config = EncodeConfig(effort=1, features=("interval:20:180",), tile="2x4x5x8", psnr=45.0)
    fhash_codec.encode(source, path, config)
    return source, path
