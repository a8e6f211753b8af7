"""Rates of the profile compact: what a look at a series and its tiles say."""

from __future__ import annotations

import numpy as np

from fhash_codec.config import EncodeConfig
from fhash_codec.cost.compact_probe import look_at, probe_rates
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
