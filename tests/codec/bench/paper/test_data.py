"""Data of a cell: key frames, masks and samples belong together."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.bench.paper.data import FEATURES, KINDS, Data, feature_text, simulated
from fhash_codec.bench.paper.encodings.places import sample_places
from fhash_codec.features.features import parse_feature
from fhash_formats.errors import InputError


def test_masks_hold_the_samples(data: Data) -> None:
    every = np.concatenate([f[m] for f, m in zip(data.frames, data.masks, strict=True)])
    np.testing.assert_array_equal(np.sort(every), np.sort(data.unfringed.values))
    assert data.coreset.fringe is not None
    of_key_frames = data.coreset.values[~data.coreset.fringe]
    np.testing.assert_array_equal(np.sort(every), np.sort(of_key_frames))
    assert data.coreset.fringe.any()
    assert 0.1 < data.coreset.fraction < 0.8


def test_boxes_hold_the_bounding_box_of_each_key_frame(data: Data) -> None:
    places = sample_places(data.boxes)
    for key, mask in enumerate(data.masks):
        at = np.argwhere(mask)
        expected = np.prod(at.max(axis=0) - at.min(axis=0) + 1)
        assert (places[:, 0] == key).sum() == expected > mask.sum()
    assert data.boxes.box == data.coreset.box
    assert data.boxes.brick_shape == (1, 1, 1)


def test_everything_is_the_domain(data: Data) -> None:
    assert data.everything.box.shape == data.frame_shape
    assert len(data.everything.values) == sum(frame.size for frame in data.frames)
    assert data.raw_bytes == 5 * 7 * 9 * 12 * 4


@pytest.mark.parametrize("name", FEATURES)
def test_scenes_at_a_quarter_of_the_papers_shape(name: str) -> None:
    shapes = {"flame": (34, 14, 43, 50), "bubble": (61, 64, 32, 32), "shell": (34, 54, 54, 54)}
    assert simulated(name, "quarter").shape == shapes[name]
    for kind in KINDS:
        parse_feature(feature_text(name, kind))


def test_other_features_are_taken_as_they_are() -> None:
    assert feature_text("flame", "interval:0:1") == "interval:0:1"
    assert feature_text("mine.h5", "segmentation") == "segmentation"


def test_an_unknown_scale_is_refused() -> None:
    with pytest.raises(InputError, match="quarter"):
        simulated("flame", "tenth")
