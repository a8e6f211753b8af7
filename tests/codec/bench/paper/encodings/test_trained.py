"""Encodings of all key frames: frames, places, times between key frames."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fhash_codec.bench.paper.data import Data
from fhash_codec.bench.paper.encodings.build import build
from fhash_codec.bench.paper.encodings.trained import TrainedEncoding
from fhash_codec.bench.paper.protocols import arrangement


def trained(name: str, protocol: str, data: Data, epochs: int = 2) -> TrainedEncoding:
    arranged = arrangement(protocol, name, data)
    encoding = build(
        name,
        data,
        arranged,
        steps=arranged.steps[0],
        epochs=epochs,
        seed=1,
        device=torch.device("cpu"),
    )
    for epoch in range(epochs):
        encoding.train_epoch(epoch)
    encoding.settle()
    return encoding


def near_masks(data: Data, key: int) -> np.ndarray:
    """Vertices (z, y, x) in the coreset of a key frame or of a neighbour."""
    return np.logical_or.reduce(data.masks[max(key - 1, 0) : key + 2])


@pytest.mark.parametrize(
    ("name", "protocol"),
    [
        ("dense", "published"),
        ("hash", "equal"),
        ("fhash", "published"),
        ("fhash", "released"),
        ("fhash", "best"),
    ],
)
def test_a_frame_holds_the_samples_and_the_background(name: str, protocol: str, data: Data) -> None:
    encoding = trained(name, protocol, data)
    for key, mask in enumerate(data.masks):
        frame = encoding.frame(key)
        trained_on = {"published": mask, "released": mask}.get(protocol, near_masks(data, key))
        if protocol == "published" and name != "fhash":
            trained_on = np.ones_like(mask)
        places = np.argwhere(trained_on)
        at = encoding.sample(key, torch.from_numpy(places)).numpy()
        np.testing.assert_allclose(frame[tuple(places.T)], at, atol=1e-5)
        if protocol != "released":
            assert (frame[~trained_on] == np.float32(data.background)).all()


def test_places_outside_the_box_are_the_background(data: Data) -> None:
    encoding = trained("fhash", "equal", data)
    outside = torch.tensor([[-1.0, 0, 0], [0, 0, 50.0]])
    assert (encoding.sample(0, outside) == np.float32(data.background)).all()


def test_between_key_frames_others_interpolate_values(data: Data) -> None:
    places = torch.tensor([[3.0, 4.0, 5.0], [3.5, 4.0, 4.0]])
    for name in ("dense", "fhash"):
        encoding = trained(name, "equal", data, epochs=4)
        before, after = (encoding.sample(key, places) for key in (0, 1))
        between = encoding.sample(0.5, places)
        linear = torch.allclose(between, (before + after) / 2, atol=1e-6)
        assert linear == (name == "dense")


def test_parameters_count_every_key_frame(data: Data) -> None:
    encoding = trained("dense", "published", data, epochs=1)
    assert encoding.tables == 7 * 9 * 12 * 2 * 3
    # 2 inputs, 2 hidden layers of 64, 1 output, a network for each key frame.
    assert encoding.mlp == 3 * (2 * 64 + 64 + 64 * 64 + 64 + 64 + 1)
    assert sum(array.size for array in encoding.arrays()) == encoding.tables + encoding.mlp
    assert encoding.buckets_used() == 1.0
    assert encoding.samples_an_epoch == 3 * 7 * 9 * 12
