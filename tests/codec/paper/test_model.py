"""The paper profile's model as `Volume` reads it."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.coreset.boxes import Box
from fhash_codec.paper.model import PaperModel
from fhash_formats.container import Container
from fhash_formats.errors import InputError


@pytest.fixture
def model(encoded):
    """The model of the shared container, and the size of its box."""
    with Container.open(encoded[1]) as container:
        model = PaperModel(container)
        yield model, model.network.box_size


def test_points_on_vertices_have_the_values_of_a_region(model) -> None:
    paper, size = model
    box = Box.of_shape(size)
    frame = paper.read(1.5, box, np.ones(size, bool))
    places = [axis.astype(float) for axis in np.nonzero(np.ones(size, bool))]
    keys = np.full(len(places[0]), 1.5)
    values, slopes = paper.sample_with_gradient(keys, places)
    np.testing.assert_array_equal(values, paper.sample(keys, places))
    assert slopes.shape == (len(values), 4)
    # float32 twice, along two ways of interpolation
    np.testing.assert_allclose(values, frame.ravel(), atol=1e-5 * np.ptp(frame))


def test_occupancy_between_key_frames_is_that_of_both(model) -> None:
    paper, size = model
    box = Box.of_shape(size)
    both = paper.occupied(0, 1, box)
    np.testing.assert_array_equal(both, paper.occupied(0, 0, box) | paper.occupied(1, 1, box))
    np.testing.assert_array_equal(
        paper.occupied(0, 1, Box((1, 2), (0, 3), (2, 4))), both[1:2, :3, 2:4]
    )


def test_there_are_no_levels_of_detail(model) -> None:
    with pytest.raises(InputError, match="no levels of detail; decode it whole"):
        model[0].read_lod(0, 1, Box.of_shape((1, 1, 1)))
