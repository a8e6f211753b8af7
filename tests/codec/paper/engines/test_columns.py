"""Columns of a batch: the places of samples, in the order of the bricks asked for."""

from __future__ import annotations

import numpy as np
import torch

from fhash_codec.paper.engines.columns import columns_of


def test_columns_find_the_samples_of_their_bricks(noise_coreset, in_coreset) -> None:
    coreset = noise_coreset((2, 9, 10, 20), 0.7)
    chosen = np.array([3, 0, 5])
    mask, samples = in_coreset(coreset)[chosen], len(coreset.values)
    bits, offsets = torch.from_numpy(mask.astype(np.uint8)), torch.from_numpy(coreset.offsets)
    places = coreset.places(chosen)
    alone = columns_of(bits, offsets[chosen], samples, len(places))
    np.testing.assert_array_equal(alone.ranks, places)
    np.testing.assert_array_equal(alone.vertices, np.flatnonzero(mask))
    assert (alone.bricks, alone.in_coreset) == (3, None)
    every = columns_of(bits, offsets[chosen], samples, None)
    np.testing.assert_array_equal(every.ranks[mask.reshape(-1)], places)
    assert (every.ranks[~mask.reshape(-1)] == samples).all()
    np.testing.assert_array_equal(every.in_coreset, mask.reshape(-1))
    assert (every.bricks, every.vertices) == (3, None)
