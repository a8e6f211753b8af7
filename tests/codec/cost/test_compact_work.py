"""Work of an encoding: its counts are those of the encoder."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from fhash_codec.compact.sample import Sample
from fhash_codec.compact.tiles import Coding, Outcome, Tile
from fhash_codec.compact.transform import choose_transform, count_trials
from fhash_codec.config import EncodeConfig
from fhash_codec.cost.compact_probe import look_at
from fhash_formats.series import ArraySeries
from fhash_formats.transform.tile_format import TileSettings


@pytest.mark.parametrize("shape", [(4, 8, 24, 24), (1, 1, 40, 40), (3, 1, 1, 30), (2, 150, 8, 8)])
def test_trials_of_a_transform_are_those_that_the_encoder_makes(
    shape: tuple[int, int, int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    series = ArraySeries(np.random.default_rng(0).normal(size=shape).astype(np.float32))
    trials, fitted = [], []
    run_all = Sample.run_all

    def counted(self: Sample, jobs: Sequence[tuple[TileSettings, Coding]]) -> list[Outcome]:
        trials.append(len(jobs))
        return run_all(self, jobs)

    with ThreadPoolExecutor(1) as workers:
        config = EncodeConfig(psnr=40.0, tile="whole")
        look = look_at(series, shape[0], config, workers)
        sample = Sample(look.task.blocks, 1 << 20, workers)
        monkeypatch.setattr(Sample, "run_all", counted)
        map_all = Sample.map_all
        monkeypatch.setattr(
            Sample, "map_all", lambda self, work: (fitted.append(work), map_all(self, work))[1]
        )
        choose_transform(sample, look.attempt.settings, look.attempt.coding)
    assert isinstance(sample.tiles[0], Tile)
    assert (sum(trials), len(fitted)) == count_trials(shape, in_memory=True)
