"""Queries at scattered points of a network, as rays and as random points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.bench.train.clock import now
from fhash_codec.paper.model import sample_points
from fhash_codec.paper.network import Architecture, ArrayTable, Layer, Network

__all__ = ["bench_points"]

POINTS = 1 << 19
"""Points of a measurement."""
RAY_POINTS = 128
"""Points of a ray."""
TURNS = 2
"""Turns of which the best counts."""

Points = npt.NDArray[np.float64]


def bench_points(
    architecture: Architecture, layers: Sequence[Layer], threads: Sequence[int]
) -> list[dict[str, Any]]:
    """Measure `sample_points` at one time between two key frames, reading the tables included.

    The embeddings are random: the time does not depend on them. Each entry has `order` (`rays` or
    `random`), `gradient`, `threads`,
    `mpoints_s` and `mpoints_cpu_s`, 10^6 points a second that passed and of processors.

    Args:
        architecture: the sizes of the network.
        layers: its layers.
        threads: numbers of threads to measure with.
    """
    network = _network(architecture, layers)
    time = 0.37 * (network.key_frames - 1)
    results = []
    for order, places in (("rays", _rays(network)), ("random", _random(network))):
        for gradient in (False, True):
            for number in threads:
                spent = []
                for _ in range(TURNS):
                    begun = now()
                    # The two overloads of the function differ in a constant.
                    if gradient:
                        sample_points(network, time, *places, gradient=True, threads=number)
                    else:
                        sample_points(network, time, *places, threads=number)
                    spent.append(now() - begun)
                best = min(spent, key=lambda seconds: seconds.cpu)
                results.append(
                    {
                        "order": order,
                        "gradient": gradient,
                        "threads": number,
                        "mpoints_s": POINTS / best.on("wall") / 1e6,
                        "mpoints_cpu_s": POINTS / best.on("cpu") / 1e6,
                    }
                )
    return results


def _network(architecture: Architecture, layers: Sequence[Layer]) -> Network:
    random = np.random.default_rng(0)
    return Network(
        levels=architecture.levels,
        embedding_size=architecture.embedding_size,
        tables=[
            ArrayTable(random.random((*level, architecture.embedding_size), dtype=np.float32))
            for level in architecture.levels
        ],
        layers=tuple(layers),
        box_size=architecture.box_size,
        key_frames=architecture.key_frames,
    )


def _rays(network: Network) -> Points:
    """Points (3, n) along straight lines through the box, one line after the other."""
    random = np.random.default_rng(1)
    ends = random.random((2, POINTS // RAY_POINTS, 1, 3))
    along = np.linspace(0, 1, RAY_POINTS)[:, None]
    places = (1 - along) * ends[0] + along * ends[1]
    return np.ascontiguousarray(places.reshape(-1, 3).T) * _last(network)


def _random(network: Network) -> Points:
    """Points (3, n) anywhere in the box."""
    return np.random.default_rng(2).random((3, POINTS)) * _last(network)


def _last(network: Network) -> Points:
    return np.array(network.box_size, np.float64)[:, None] - 1
