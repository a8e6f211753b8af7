"""Samples of the training of heads: the inputs are those that the head computes."""

from __future__ import annotations

import numpy as np
import pytest
from reference.head import Head, clip, inputs_of, moved

from fhash_codec.compact.choices.head_samples import (
    BATCH_VOXELS,
    ErrorRange,
    Pair,
    batches,
    draw,
)
from fhash_formats.transform.head.inputs import CROSS


def tiles() -> list[Pair]:
    """Tiles with extreme values, thin ones among them."""
    random = np.random.default_rng(3)
    pairs = []
    for shape in ((3, 5, 7, 11), (1, 1, 9, 30), (2, 1, 1, 1)):
        original = random.normal(size=shape).astype(np.float32)
        decoded = original + random.normal(size=shape).astype(np.float32) ** 5
        decoded.ravel()[::17] = np.float32(3e38)
        decoded.ravel()[::19] = np.nan
        decoded.ravel()[::23] = -np.inf
        pairs.append(Pair(decoded, original, None))
    return pairs


@pytest.mark.parametrize("looked_at", [1, 9])
@pytest.mark.parametrize(
    ("low", "high", "sigma"),
    [(-2.0, 2.0, 0.3), (0.0, 0.0, 1.0), (-3e38, 3e38, 2.0**-100), (-1.0, 2.0, 2.0**100)],
)
def test_inputs_are_those_that_the_head_computes(
    looked_at: int, low: float, high: float, sigma: float
) -> None:
    pairs, random = tiles(), np.random.default_rng(4)
    ends = np.float32(low), np.float32(high)
    value_range = ErrorRange(low=ends[0], high=ends[1], sigma=np.float32(sigma))
    drawn = draw(pairs, BATCH_VOXELS, random, *ends)
    offsets = CROSS[:looked_at]
    with np.errstate(over="ignore", invalid="ignore"):
        found = batches(pairs, drawn, offsets, np.random.default_rng(5), value_range)
        expected = []
        for pair, voxels in zip(pairs, drawn, strict=True):
            head = Head([], False, np.float32(sigma), *ends)
            values = clip(pair.decoded, *ends)
            planes = inputs_of(values, head)
            at = np.array([[moved(plane, offset) for offset in offsets] for plane in planes])
            expected.append(at[:, :, *voxels.places])
    count = found.inputs.size // (len(planes) * looked_at)
    inputs = found.inputs.transpose(2, 3, 0, 1, 4).reshape(len(planes), looked_at, count)
    order = np.random.default_rng(5).permutation(sum(e.shape[2] for e in expected))
    shuffled = np.empty_like(inputs)
    shuffled[:, :, order] = np.concatenate(expected, axis=2)
    np.testing.assert_array_equal(inputs, shuffled)
