"""Queries at points: each order, with and without gradient, for each number of threads."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from fhash_codec.bench.train import points
from fhash_codec.bench.train.points import bench_points
from fhash_codec.paper.network import Architecture


@pytest.mark.usefixtures("quick")
def test_every_order_is_measured() -> None:
    architecture = Architecture.for_box((5, 6, 7), 3, width=4, hidden_layers=1)
    layers = [
        (np.ones((n, m), np.float32), np.zeros(n, np.float32)) for n, m in architecture.layer_shapes
    ]
    entries = bench_points(architecture, layers, (1, 2))
    assert [(e["order"], e["gradient"], e["threads"]) for e in entries] == list(
        product(("rays", "random"), (False, True), (1, 2))
    )
    assert all(min(e["mpoints_s"], e["mpoints_cpu_s"]) > 0 for e in entries)


def test_rays_are_straight_and_inside() -> None:
    architecture = Architecture.for_box((5, 6, 7), 1, width=4, hidden_layers=0)
    layers = [
        (np.ones((n, m), np.float32), np.zeros(n, np.float32)) for n, m in architecture.layer_shapes
    ]
    network = points._network(architecture, layers)
    rays = points._rays(network).reshape(3, -1, points.RAY_POINTS)
    np.testing.assert_allclose(np.diff(rays, n=2, axis=2), 0, atol=1e-12)
    for places in (points._rays(network), points._random(network)):
        assert places.shape == (3, points.POINTS)
        assert (places >= 0).all()
        assert (places <= np.array(network.box_size)[:, None] - 1).all()
