"""Speed of queries at points of a finished file, for `fhash bench ablate`."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from fhash_codec.volume import open as open_volume

__all__ = ["POINTS", "points_per_second"]

POINTS = 1 << 17
"""Points of a measurement."""
TURNS = 3
"""Measurements of which the best counts; the first one reads the tables from the file."""
BETWEEN = 0.37
"""Place between two steps, as a share of their distance."""


def points_per_second(path: Path) -> float:
    """Return how many points `Volume.sample` evaluates in a second of processors.

    The points lie beside vertices of the coreset that are drawn at random, in their order in the
    volume, at one time between two steps.

    Args:
        path: a file with a coreset.
    """
    random = np.random.default_rng(0)
    with open_volume(path) as volume:
        steps = volume.shape[0]
        step, vertices = next(
            (step, vertices)
            for step in (*range(steps // 2, steps), *range(steps // 2))
            if len(vertices := np.argwhere(volume.occupancy(step)))
        )
        drawn = vertices[np.sort(random.integers(len(vertices), size=POINTS))]
        last = np.array(volume.shape[1:]) - 1
        z, y, x = np.minimum(drawn + random.random(drawn.shape), last).T
        spent = []
        for _ in range(TURNS):
            begun = time.process_time()
            volume.sample(t=min(step + BETWEEN, steps - 1), z=z, y=y, x=x)
            spent.append(time.process_time() - begun)
    return POINTS / min(spent)
