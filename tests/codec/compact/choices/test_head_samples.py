"""Samples of the training of heads: both ways to gather the inputs, and what the head computes."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec import native
from fhash_codec.compact.choices.head_samples import (
    BATCH_VOXELS,
    Batches,
    ErrorRange,
    Pair,
    batches,
    draw,
)
from fhash_formats.transform.head.inputs import CROSS

needs_library = pytest.mark.skipif(
    native.library() is None, reason="the native library was not built here"
)


def gathered(looked_at: int, low: float, high: float, sigma: float) -> Batches:
    """Return batches of the voxels of tiles with extreme values, thin ones among them."""
    random = np.random.default_rng(3)
    pairs = []
    for shape in ((3, 5, 7, 11), (1, 1, 9, 30), (2, 1, 1, 1)):
        original = random.normal(size=shape).astype(np.float32)
        decoded = original + random.normal(size=shape).astype(np.float32) ** 5
        decoded.ravel()[::17] = np.float32(3e38)
        decoded.ravel()[::19] = np.nan
        decoded.ravel()[::23] = -np.inf
        pairs.append(Pair(decoded, original, None))
    ends = np.float32(low), np.float32(high)
    value_range = ErrorRange(low=ends[0], high=ends[1], sigma=np.float32(sigma))
    random = np.random.default_rng(4)
    drawn = draw(pairs, BATCH_VOXELS, random, *ends)
    return batches(pairs, drawn, CROSS[:looked_at], random, value_range)


@needs_library
@pytest.mark.parametrize("looked_at", [1, 9])
@pytest.mark.parametrize(
    ("low", "high", "sigma"),
    [(-2.0, 2.0, 0.3), (0.0, 0.0, 1.0), (-3e38, 3e38, 2.0**-100), (-1.0, 2.0, 2.0**100)],
)
def test_both_ways_gather_the_same_inputs(
    looked_at: int, low: float, high: float, sigma: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = []
    for switch in ("1", "0"):
        monkeypatch.setenv("FHASH_NATIVE", switch)
        with np.errstate(over="ignore", invalid="ignore"):
            results.append(gathered(looked_at, low, high, sigma))
    np.testing.assert_array_equal(results[0].inputs, results[1].inputs)
    np.testing.assert_array_equal(results[0].targets, results[1].targets)
