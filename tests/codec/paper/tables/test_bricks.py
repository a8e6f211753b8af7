"""Regions of the box out of bricks equal those of dense frames."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.coreset.occupancy import unpack
from fhash_codec.paper.storage import finest_frame


@pytest.mark.parametrize("key", range(5))
def test_regions_are_those_of_the_frame(random_model, key) -> None:
    bricks, coreset = random_model.bricks, random_model.selection.coreset
    size = random_model.selection.architecture.box_size
    box = tuple((0, n) for n in size)
    mask, values = bricks.mask(key, box), bricks.samples(key, box)
    occupied = unpack(coreset.occupancy[key], size)
    assert not (occupied & ~mask).any()
    assert (mask & ~occupied).any()  # the fringe
    assert 0 < mask.mean() < 1
    to_unit = random_model.selection.scanned.value_range.to_unit
    frame = random_model.field[(key, *(slice(low, high) for low, high in coreset.box))]
    np.testing.assert_array_equal(values[mask], to_unit(frame[mask]))
    for region in (((1, 4), (0, 3), (7, 11)), ((3, 4), (5, 6), (2, 3))):
        inner = tuple(slice(*span) for span in region)
        np.testing.assert_array_equal(bricks.mask(key, region), mask[inner])
        np.testing.assert_array_equal(bricks.samples(key, region), values[inner])
        np.testing.assert_array_equal(
            bricks.embeddings(random_model.fine, key, region),
            finest_frame(coreset, random_model.fine, key)[inner],
        )
