"""Figures between key frames, of encodings whose errors are known."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from fhash_codec.bench.paper.evaluation import between_key_frames, evaluate
from fhash_codec.coreset.features import Interval
from fhash_codec.measure.value_range import ValueRange
from fhash_formats.series import ArraySeries

KEYS = (0, 4, 8)


def front(bend: float) -> Any:
    """Data of a front that moves along x; at time t + bend sin(pi t) between key frames."""
    t = np.arange(9.0)
    place = t + bend * np.sin(np.pi * t / 4)
    z, y, x = np.indices((3, 4, 24))
    values = np.clip(1 - np.abs(x - 6 - place[:, None, None, None]) / 5, 0, 1)
    values = (0.99 * values + 0.001 * (y + z)).astype(np.float32)
    feature = Interval(0.4, 2.0)
    frames = [values[key] for key in KEYS]
    return SimpleNamespace(
        series=ArraySeries(values),
        scanned=SimpleNamespace(value_range=ValueRange(0.0, 1.0)),
        features=(feature,),
        key_frames=KEYS,
        frames=frames,
        masks=[feature.select(frame, 0) for frame in frames],
    )


def linear(data: Any, error: float = 0.0) -> Any:
    """A sampler that interpolates the true key frames, off by an error."""

    def sample(time: float, places: np.ndarray) -> np.ndarray:
        before = int(time)
        after = min(before + 1, len(data.frames) - 1)
        frame = (1 - time + before) * data.frames[before] + (time - before) * data.frames[after]
        return np.asarray(frame[tuple(places.T)] + error, dtype=np.float64)

    return sample


def test_an_encoding_of_values_is_the_linear_interpolation() -> None:
    data = front(0.0)
    found = between_key_frames(linear(data), data)
    assert found["steps"] == 9
    assert found["psnr_key_frames"] is None
    assert found["psnr_between"] == pytest.approx(found["linear_psnr"], abs=1e-6)
    assert found["fringe_psnr"] == pytest.approx(found["fringe_linear_psnr"], abs=1e-6)
    assert found["fringe_psnr"] < 30
    assert 0 < found["fringe_share"] < 1
    assert found["worst_psnr"] <= found["psnr_between"] < found["psnr"]
    assert found["worst_step"] not in KEYS


def test_errors_at_key_frames_are_told_apart() -> None:
    data = front(0.0)
    found = between_key_frames(linear(data, 0.01), data)
    assert found["psnr_key_frames"] == pytest.approx(40, abs=0.01)


def test_a_feature_that_leaves_the_coreset_is_missed() -> None:
    steady = between_key_frames(linear(front(0.0)), front(0.0))
    bent = between_key_frames(linear(front(6.0)), front(6.0))
    assert steady["missed_share"] < 0.01 < bent["missed_share"]


def test_few_steps_are_looked_at_key_frames_among_them() -> None:
    data, told = front(0.0), []
    found = between_key_frames(linear(data), data, steps=3, progress=lambda *w: told.append(w))
    assert found["steps"] == 3 == len(told)
    assert found["psnr_between"] is None


class Steady:
    """An encoding of one value."""

    settled = False

    def settle(self) -> None:
        self.settled = True

    def sample(self, key: float, places: torch.Tensor) -> torch.Tensor:
        return torch.full((len(places),), 0.5)


def test_what_is_not_asked_for_is_not_measured() -> None:
    data, encoding = front(0.0), Steady()
    found = evaluate(encoding, data, latency=False)
    assert encoding.settled
    assert found["latency"] is None
    assert found["between"] is not None
    assert found["between"]["psnr"] < 20
    found = evaluate(encoding, data, between=False, size=4)
    assert found["between"] is None
    assert found["latency"] is not None
    assert found["latency"]["size"] == 4
