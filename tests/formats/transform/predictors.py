"""Predictors for tests, with random weights."""

from __future__ import annotations

import numpy as np

from fhash_formats.transform.predict import Predictor, passes_of

Four = tuple[int, int, int, int]


def predictor_of(
    levels: Four = (2, 3, 3, 3),
    order: Four = (0, 1, 2, 3),
    reach: int = 1,
    seed: int = 0,
    step: float = 1.0,
    origin: float = 0.0,
) -> Predictor:
    """A predictor with random weights for the passes of these levels, order and reach."""
    count = sum(len(a_pass.taps) for a_pass in passes_of(levels, order, reach))
    weights = np.random.default_rng(seed).integers(-300, 301, count)
    return Predictor(
        step=step,
        origin=origin,
        levels=levels,
        order=order,
        reach=reach,
        weights=tuple(weights.tolist()),
    )
