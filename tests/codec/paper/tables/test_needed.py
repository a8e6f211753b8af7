"""The vertices of a level that samples need, from the occupancy alone."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from fhash_codec.coreset import occupancy
from fhash_codec.paper.architecture import level_resolutions
from fhash_codec.paper.tables.needed import Needed, corners, needed_by, spread
from fhash_codec.paper.tables.trained_tables import trained_tables


@pytest.mark.parametrize(("length", "resolution"), [(1, 1), (5, 3), (5, 5), (9, 2), (20, 7)])
def test_corners_are_those_of_the_interpolation(length, resolution) -> None:
    position = np.arange(length) * (resolution - 1) / max(length - 1, 1)
    first, last = corners(length, resolution)
    np.testing.assert_array_equal(first, np.floor(position + 1e-12))
    np.testing.assert_array_equal(last, np.ceil(position - 1e-12))
    weighs = np.zeros((length, resolution), bool)
    weighs[np.arange(length), first] = weighs[np.arange(length), last] = True
    for seed in range(5):
        mask = np.random.default_rng(seed).random((2, length)) < 0.3
        np.testing.assert_array_equal(
            spread(mask, 1, resolution), (weighs.T[None] & mask[:, None]).any(axis=2)
        )


@pytest.mark.parametrize("fringe", [False, True])
@pytest.mark.parametrize(
    ("box", "keys", "fold"), [((5, 6, 7), 5, 2), ((1, 9, 4), 1, 2), ((4, 3, 11), 7, 3)]
)
def test_needed_are_the_corners_around_samples(box, keys, fold, fringe) -> None:
    """The law in words: every corner with a weight, of every sample, and nothing else."""
    random = np.random.default_rng(0)
    masks = random.random((keys, *box)) < 0.04
    levels = level_resolutions(box, keys, fold)
    packed = [occupancy.pack(mask) for mask in masks]
    needed = Needed(levels, packed.__getitem__, fringe=fringe)
    samples = masks.copy()
    if fringe:
        samples[1:] |= masks[:-1]
        samples[:-1] |= masks[1:]
    for number, level in enumerate(levels):
        expected = np.zeros(level, np.bool_)
        sizes = (keys, *box)
        for sample in np.argwhere(samples):
            around = [
                {p * (r - 1) // max(n - 1, 1), -(-p * (r - 1) // max(n - 1, 1))}
                for p, r, n in zip(sample.tolist(), level, sizes, strict=True)
            ]
            for corner in product(*around):
                expected[corner] = True
        found = np.stack([needed.mask(number, node) for node in range(level[0])])
        np.testing.assert_array_equal(found, expected)
        assert needed.counts(number) == expected.sum(axis=(1, 2, 3)).tolist()


def test_the_coreset_of_a_selection_needs_what_its_bricks_hold(random_model) -> None:
    coreset, architecture = random_model.selection.coreset, random_model.selection.architecture
    assert coreset.fringe is not None
    needed = needed_by(architecture, coreset)
    table = trained_tables(
        architecture, coreset, random_model.bricks, random_model.fine, random_model.tables
    )[0]
    region = tuple(slice(0, n) for n in table.shape[:4])
    nodes = range(architecture.key_frames)
    np.testing.assert_array_equal(
        np.stack([needed.mask(0, node) for node in nodes]), table.needed(region)
    )
    assert sum(needed.counts(0)) == len(coreset.values)
