"""Choice of the head: it stays only where the file gets smaller by it."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.compact.goal import step_after_gain
from fhash_codec.compact.head import (
    EFFORTS,
    PERCEPTRON,
    Budget,
    Effort,
    Shape,
    _coarsened,
    _side_by_side,
    likely_heads,
)
from fhash_codec.compact.transform import usual_transform
from fhash_codec.progress import Parts
from fhash_formats.transform.encoding import OFFSETS
from fhash_formats.transform.tile_format import TileSettings


def fronts() -> npt.NDArray[np.float32]:
    """Return two plateaus with a travelling, slanted and curved border.

    A wavelet smears it, and a head sharpens it.
    """
    t, z, y, x = np.meshgrid(
        np.arange(5), np.arange(12), np.arange(40), np.arange(40), indexing="ij"
    )
    distance = x + 0.6 * y - 2 * t + 4 * np.sin(z / 5 + t / 4) - 26
    return (1 / (1 + np.exp(-2 * distance))).astype(np.float32)


def test_under_a_bound_a_head_makes_files_smaller_and_the_bound_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Prediction would be smaller still.
    monkeypatch.setattr("fhash_codec.compact.predictor.best_predictor", lambda *_, **__: None)
    budget = Budget(updates=200, samples=40_000)
    monkeypatch.setattr("fhash_codec.compact.head.TRIAL_BUDGET", budget)
    monkeypatch.setitem(EFFORTS, 5, Effort(candidates=4, budget=budget, perceptron=budget))
    source, sizes, calls = fronts(), {}, []

    def progress(stage: str, done: int, total: int, note: str) -> None:
        assert threading.current_thread() is threading.main_thread()
        assert 0 <= done <= total >= 1
        calls.append((stage, note.partition(",")[0]))

    for effort in (4, 5):
        config = EncodeConfig(effort=effort, max_error=0.01)
        calls.clear()
        figures = fhash_codec.encode(
            source, tmp_path / "a.fhz", config, force=True, progress=progress
        )
        with fhash_codec.open(tmp_path / "a.fhz") as volume:
            assert np.abs(volume[...].astype(np.float64) - source).max() <= 0.01
            assert (volume.info["model"]["head"] is not None) == (effort == 5)
        sizes[effort] = figures["bytes"]
    assert sizes[5] < 0.97 * sizes[4]
    # Every stage of the last encoding reported, the trials and the training too.
    for part in ("first guess", "tiles and transform", "fill values", "quantiser step", "head"):
        assert ("planning", part) in calls
    assert calls.count(("planning", "tiles and transform")) > 10
    assert calls.count(("training", "")) > 5
    stages = [stage for stage, _ in dict.fromkeys(calls)]
    assert list(dict.fromkeys(stages)) == [
        "scanning", "selecting", "planning", "training", "coding", "measuring", "writing",
    ]  # fmt: skip


def test_an_interruption_ends_the_trainings_of_other_threads() -> None:
    threads = []

    def train(shape: Shape, tell: Callable[[float], None]) -> None:
        threads.append(threading.current_thread())
        while True:
            tell(0.5)
            time.sleep(0.001)

    def interrupt(stage: str, done: int, total: int, note: str) -> None:
        if stage == "training" and done == 50:
            raise KeyboardInterrupt

    shapes = [Shape((4, 8), cross=True), Shape((12, 8), cross=False)]
    with pytest.raises(KeyboardInterrupt):
        _side_by_side(shapes, train, Parts("planning", 6, interrupt))
    assert len(threads) == 2
    assert not any(thread.is_alive() for thread in threads)


@pytest.mark.parametrize(("lost", "share"), [(2.2, 1), (4, 0.5), (24, 1 / 12), (0.8, 2), (0, 2)])
def test_tiles_are_coarsened_by_what_a_head_gains(lost: float, share: float) -> None:
    """Their loss in dB at the usual step decides, within a power of 2."""
    fine = TileSettings(
        transform=usual_transform((2, 4, 4, 4)),
        step=0.5,
        center=0.0,
        low=0.0,
        high=1.0,
        offsets=OFFSETS,
        double=False,
    )
    usual = replace(fine, step=step_after_gain(fine.step, 2.0))
    found = _coarsened(fine, usual, lost, 2.0)
    assert math.log(found.step / fine.step) == pytest.approx(
        share * math.log(usual.step / 0.5), 0.01
    )


def test_no_head_is_trained_that_the_other_one_is_sure_to_beat() -> None:
    def shapes(size: float, gain: float) -> list[Shape]:
        return likely_heads(size, gain, 4.5, effort=5)

    # Few weights pay where little is to be gained, many where much is.
    assert shapes(1_000, 0.5) == []
    assert shapes(120_000, 0.14) == [PERCEPTRON]
    assert [shape.cross for shape in shapes(1e6, 3.0)] == [True]
    assert [shape.cross for shape in shapes(60_000, 0.5)] == [True, False]


def test_weights_and_products_of_a_head() -> None:
    assert Shape((12, 8), cross=False).weights == 28 * 12 + 12 * 8 + 8
    assert Shape((12, 8), cross=False).products == 28 * 12 + 12 * 8 + 8
    assert Shape((8, 8), cross=True).weights == 28 * 8 + 9 * 8 * 8 + 8
    assert Shape((8, 8), cross=True).products == 9 * (28 * 8 + 8 * 8) + 8
