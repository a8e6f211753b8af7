"""Leaping: rays stop at the first sample in a brick that matters, as found sample by sample."""

from __future__ import annotations

import numpy as np

from fhash_codec.rendering.stream.leaping import Leaping
from fhash_codec.rendering.task.arrays import NUMPY, Arrays


def chessboard_distance(matters: np.ndarray) -> np.ndarray:
    """The distance of each brick (z, y, x) to the nearest that matters, diagonals as one."""
    there = np.argwhere(matters)
    every = np.argwhere(np.ones_like(matters))
    apart = np.abs(every[:, None] - there[None]).max(axis=2).min(axis=1)
    return apart.reshape(matters.shape)


def leaping(distance: np.ndarray, arrays: Arrays) -> Leaping:
    return Leaping(
        arrays=arrays,
        distance=arrays.array(distance, "int64"),
        last=arrays.array(np.array(distance.shape[::-1]) - 1.0),
        first=arrays.array(np.zeros(3)),
        side=4.0,
    )


def test_rays_stop_at_the_first_sample_that_matters(tensors: Arrays) -> None:
    random = np.random.default_rng(4)
    matters = random.random((5, 6, 7)) < 0.03
    matters[2, 3, 3] = True
    distance = chessboard_distance(matters)
    origin = random.uniform(0, 1, (200, 3)) * [28, 24, 20]
    pace = random.normal(size=(200, 3)) * 0.4
    pace[::7, 1] = 0.0
    end = np.full(200, 60)
    by_hand = []
    for start, step in zip(origin, pace, strict=True):
        places = start + np.arange(60)[:, None] * step
        x, y, z = np.clip(np.floor(places / 4).astype(int), 0, [6, 5, 4]).T
        stops = np.flatnonzero(matters[z, y, x])
        by_hand.append(int(stops[0]) if len(stops) else 60)
    for arrays in (NUMPY, tensors):
        leaps = leaping(distance, arrays)
        sample, count = leaps.leap(
            arrays.array(origin),
            arrays.array(pace),
            arrays.array(np.zeros(200), "int64"),
            arrays.array(end, "int64"),
        )
        assert arrays.host(sample).tolist() == by_hand
        # A leap passes over more than a sample on average.
        assert 0 < count < sum(by_hand)


def test_places_matter_with_their_brick() -> None:
    matters = np.zeros((1, 1, 3), dtype=bool)
    matters[0, 0, 1] = True
    places = np.array([[3.9, 1.0, 1.0], [4.0, 1.0, 1.0], [7.9, 9.0, 9.0], [8.0, 0.0, 0.0]])
    seen = leaping(chessboard_distance(matters), NUMPY).matters(places)
    assert seen.tolist() == [False, True, True, False]
