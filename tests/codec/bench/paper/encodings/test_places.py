"""Places of samples, and coresets of one key frame."""

from __future__ import annotations

import numpy as np

from fhash_codec.bench.paper.data import Data
from fhash_codec.bench.paper.encodings.places import of_key_frame, sample_places


def test_values_stand_at_their_places(data: Data) -> None:
    places = sample_places(data.coreset)
    at = places[:, 1:] + np.array(data.coreset.box.first)
    found = [data.frames[key][tuple(place)] for key, place in zip(places[:, 0], at, strict=True)]
    np.testing.assert_array_equal(found, data.coreset.values)


def test_key_frames_split_the_samples(data: Data) -> None:
    places = sample_places(data.coreset)
    for key in range(3):
        alone = of_key_frame(data.coreset, key)
        np.testing.assert_array_equal(alone.values, data.coreset.values[places[:, 0] == key])
        expected = places[places[:, 0] == key] * [0, 1, 1, 1]
        np.testing.assert_array_equal(sample_places(alone), expected)
        assert alone.key_frames == (data.key_frames[key],)
        assert alone.box == data.coreset.box
