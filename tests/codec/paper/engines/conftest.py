"""Small coresets of noise for the engines."""

from __future__ import annotations

from collections.abc import Callable
from math import prod

import numpy as np
import numpy.typing as npt
import pytest

from fhash_codec.coreset.bricks import Coreset, build_coreset
from fhash_codec.coreset.features import Interval
from fhash_codec.coreset.scan import scan
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries


def _noise_coreset(
    shape: tuple[int, int, int, int], low: float = 0.3, fringe: bool = False
) -> Coreset:
    series = ArraySeries(np.random.default_rng(3).random(shape, dtype=np.float32))
    scanned = scan(series, silent)
    return build_coreset(
        series, scanned, range(shape[0]), [Interval(low, 1.0)], 0, silent, fringe=fringe
    )


def _in_coreset(coreset: Coreset) -> npt.NDArray[np.bool_]:
    return np.unpackbits(coreset.mask_bits, axis=1, count=prod(coreset.brick_shape)).astype(bool)


@pytest.fixture(scope="session")
def noise_coreset() -> Callable[..., Coreset]:
    """A function of (shape, low, fringe): noise; values from `low` to 1 are the feature."""
    return _noise_coreset


@pytest.fixture(scope="session")
def in_coreset() -> Callable[[Coreset], npt.NDArray[np.bool_]]:
    """A function of a coreset: which vertices (bricks, vertices) of its bricks are samples."""
    return _in_coreset
