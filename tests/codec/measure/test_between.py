"""Figures at key frames and between them, against plain numpy."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fhash_codec.measure.between import neighbours_of
from fhash_codec.measure.metrics import measure_quality

RNG = np.random.default_rng(0)
SOURCE = RNG.random((7, 4, 5, 6)).astype(np.float32)
KEY_FRAMES = (1, 3, 4)
MASKS = RNG.random((7, 4, 5, 6)) < 0.6


def key_index(step: float) -> float:
    return float(np.interp(step, KEY_FRAMES, np.arange(3)))


def decoded(step: int) -> np.ndarray:
    index = key_index(step)
    around = MASKS[KEY_FRAMES[math.floor(index)]] | MASKS[KEY_FRAMES[math.ceil(index)]]
    frame = SOURCE[step] + np.float32(0.01) * (step + 1)
    return np.where(around, frame, np.float32(np.nan))


def neighbours(source=SOURCE, read=None):
    read = read or source.__getitem__
    return neighbours_of(KEY_FRAMES, key_index, read, lambda step: MASKS[int(step)])


def psnr(errors) -> float:
    return -10 * math.log10(np.mean(np.concatenate(errors) ** 2))


def test_figures_are_those_of_the_steps_and_of_the_interpolated_source() -> None:
    quality = measure_quality(
        SOURCE.__getitem__, decoded, 7, 1.0, 0.0, neighbours=neighbours()
    ).between
    own, linear, fringe, fringe_linear = [], [], [], []
    mean = (SOURCE[1].astype(float) + SOURCE[3]) / 2
    for step, frame in ((0, SOURCE[1]), (2, mean), (5, SOURCE[4]), (6, SOURCE[4])):
        values = decoded(step)
        there = np.isfinite(values)
        own.append((values - SOURCE[step])[there])
        linear.append((frame - SOURCE[step])[there])
        if step == 2:
            only_one = MASKS[1] ^ MASKS[3]
            fringe.append((values - SOURCE[step])[only_one])
            fringe_linear.append((frame - SOURCE[step])[only_one])
    assert quality.psnr == pytest.approx(psnr(own), abs=1e-4)
    assert quality.psnr_linear == pytest.approx(psnr(linear), abs=1e-4)
    assert quality.psnr_fringe == pytest.approx(psnr(fringe), abs=1e-4)
    assert quality.psnr_fringe_linear == pytest.approx(psnr(fringe_linear), abs=1e-4)
    assert quality.fringe_fraction == len(fringe[0]) / sum(map(len, own))
    keys = [(decoded(step) - SOURCE[step])[MASKS[step]] for step in KEY_FRAMES]
    assert quality.psnr_key_frames == pytest.approx(psnr(keys), abs=1e-4)


def test_vertices_that_a_key_frame_lacks_have_no_interpolated_source() -> None:
    gaps = SOURCE.copy()
    gaps[1, 0], gaps[3, 1] = np.nan, np.inf
    found = neighbours(gaps)(2)
    assert np.isfinite(found.interpolated()[2:]).all()
    quality = measure_quality(
        SOURCE.__getitem__, decoded, 7, 1.0, 0.0, neighbours=neighbours(gaps)
    ).between
    assert quality.psnr_linear is not None


def test_two_key_frames_are_read_once_for_all_steps_between_them() -> None:
    read = []

    def frame(step: int) -> np.ndarray:
        read.append(step)
        return SOURCE[step]

    near = neighbours(read=frame)
    for step in range(7):
        assert (near(step) is None) == (step in KEY_FRAMES)
    assert read == [1, 3, 4]


def test_without_steps_between_key_frames_there_are_no_figures() -> None:
    assert measure_quality(SOURCE.__getitem__, decoded, 7, 1.0, 0.0).between is None


def test_huge_values_are_interpolated_without_overflow() -> None:
    huge = np.full((7, 1, 1, 1), np.finfo(np.float64).max)
    near = neighbours_of(KEY_FRAMES, key_index, huge.__getitem__, lambda step: huge[0] > 0)
    assert np.isfinite(near(2).interpolated()).all()
