"""The naive engine: its errors are those of its values, on the coreset alone."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.engines.naive import NaiveEngine


def test_errors_are_those_of_the_values_at_the_samples(noise_coreset) -> None:
    coreset = noise_coreset((3, 6, 10, 20))
    architecture = Architecture.for_box(coreset.box.shape, 3, width=8)
    engine = NaiveEngine(
        architecture,
        coreset,
        np.full(10, 0.01),
        seed=1,
        device=torch.device("cpu"),
        dtype=torch.float64,
    )
    bricks = np.arange(len(coreset.bricks))
    for _ in range(3):
        values = engine.infer(bricks).numpy()
        expected = float(np.square(values - coreset.values).sum())
        assert float(engine.train(bricks)) == pytest.approx(expected, rel=1e-10)
    assert np.square(engine.infer(bricks).numpy() - coreset.values).sum() < expected
    assert engine.parameters().fine.shape == (2, len(coreset.values))
