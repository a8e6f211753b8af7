"""Rates of the profile compact: what a look at a series and its tiles say."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.config import EncodeConfig
from fhash_codec.cost.probe import PaperProbe, look_at, probe_rates, updates_of
from fhash_formats.series import ArraySeries, StepsSeries
from fhash_formats.support.threads import thread_pool

SERIES = ArraySeries(np.random.default_rng(0).normal(size=(8, 8, 16, 16)).astype(np.float32))


def test_a_part_stands_for_the_whole_series() -> None:
    config = EncodeConfig(psnr=40.0, effort=1)
    with thread_pool() as workers:
        look = look_at(StepsSeries(SERIES, range(4)), 8, config, workers)
        assert look.share == 0.5
        assert look.shape == SERIES.shape
        assert look.task.blocks.shape == (4, 8, 16, 16)
        rates = probe_rates(look, config)
    assert abs(rates.outcome.psnr(look.task.goal.data_range) - 40) < 2
    assert min(rates.trial, rates.search, rates.final, rates.decode, rates.compare) > 0
    assert rates.fill == rates.predict == rates.fit == 0


def test_a_training_of_twice_the_updates_takes_twice_as_long() -> None:
    once, twice = (updates_of(updates, 0) for updates in (800, 1600))
    assert 800 < once < 1600
    assert 1.9 < twice / once < 2.1
    assert updates_of(800, 400_000) > once


PROBE = PaperProbe(
    stages={"scan": 1.0, "writing": 2.0},
    step=0.5,
    curve=0.25,
    samples=100_000,
    bricks=1000,
    bytes=1000,
)


@pytest.mark.parametrize(
    ("epochs", "points", "steps"), [(1, 1, 20), (30, 30, 600), (150, 75, 3000), (0, 50, 1000)]
)
def test_each_step_and_each_point_of_the_curve_is_counted(
    epochs: int, points: int, steps: int
) -> None:
    pytest.importorskip("torch")
    config = EncodeConfig(profile="paper", epochs=epochs)
    assert sum(PROBE.stage_seconds(config).values()) == 3 + 0.5 * steps + 0.25 * points


def test_a_batch_of_another_size_makes_other_steps() -> None:
    pytest.importorskip("torch")
    config = EncodeConfig(profile="paper", epochs=10, batch=10_000)
    assert sum(PROBE.stage_seconds(config).values()) == 3 + 0.5 * 100 + 0.25 * 10
