"""Laws of the readable paper: buckets, interpolation, the model at points, and its training."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
import torch
from readable_paper import NaiveEngine, bucket_index, interpolate, locate

from fhash_codec.paper.network import Architecture

DOUBLE = torch.float64


@pytest.mark.parametrize("resolution", [(1, 1, 1, 1), (2, 3, 5, 7), (1, 4, 1, 2)])
def test_bucket_index_is_a_bijection(resolution) -> None:
    corners = torch.tensor(list(product(*(range(n) for n in resolution))))
    assert bucket_index(corners, resolution).tolist() == list(range(len(corners)))


def test_bucket_index_is_the_papers_linearisation() -> None:
    t, z, y, x, (_, rz, ry, rx) = 3, 2, 4, 1, (5, 6, 7, 8)
    assert (
        int(bucket_index(torch.tensor([t, z, y, x]), (5, rz, ry, rx)))
        == t * rx * ry * rz + z * rx * ry + y * rx + x
    )


def test_vertices_of_the_finest_level_are_corners_exactly() -> None:
    sizes = (7, 11, 25, 125)
    vertices = torch.tensor(list(product(*(range(n) for n in (7, 11, 3, 3)))), dtype=DOUBLE)
    before, after_weight = locate(vertices, sizes, sizes)
    # A vertex is the corner before it, or at the end of an axis the corner after it.
    assert torch.equal(before + after_weight, vertices)
    assert set(after_weight.unique().tolist()) <= {0.0, 1.0}


def test_corners_align_at_every_level() -> None:
    sizes, resolution = (4, 9, 10, 33), (2, 5, 3, 17)
    ends = torch.tensor([[0, 0, 0, 0], [3, 8, 9, 32]], dtype=DOUBLE)
    before, after_weight = locate(ends, sizes, resolution)
    assert (before + after_weight).tolist() == [[0, 0, 0, 0], [1, 4, 2, 16]]


def test_interpolation_reproduces_a_multilinear_function() -> None:
    sizes = resolution = (3, 4, 5, 6)
    corners = torch.tensor(list(product(*(range(n) for n in resolution))), dtype=DOUBLE)

    def function(p: torch.Tensor) -> torch.Tensor:
        return ((1 + p[:, 0]) * (2 - p[:, 1]) * (0.5 + p[:, 2]) * (1 + 0.1 * p[:, 3])).unsqueeze(1)

    random = torch.Generator().manual_seed(0)
    points = torch.rand(200, 4, dtype=DOUBLE, generator=random) * (torch.tensor(sizes) - 1)
    torch.testing.assert_close(
        interpolate(function(corners), points, sizes, resolution), function(points)
    )


def test_an_axis_of_one_vertex_does_not_matter() -> None:
    table = torch.rand(6, 2, dtype=DOUBLE, generator=torch.Generator().manual_seed(0))
    points = torch.tensor([[0.0, 0.0, 0.3, 1.7], [5.0, -1.0, 0.3, 1.7]], dtype=DOUBLE)
    value, other = interpolate(table, points, (1, 1, 2, 3), (1, 1, 2, 3))
    torch.testing.assert_close(value, other)
    (a, b), (c, d) = table.reshape(2, 3, 2)[:, 1:]
    torch.testing.assert_close(value, 0.7 * (0.3 * a + 0.7 * b) + 0.3 * (0.3 * c + 0.7 * d))


def test_errors_are_those_of_the_values_at_the_samples(noise_coreset) -> None:
    coreset = noise_coreset((3, 6, 10, 20))
    architecture = Architecture.for_box(coreset.box.shape, 3, width=8)
    engine = NaiveEngine(architecture, coreset, np.full(10, 0.01), seed=1)
    bricks = np.arange(len(coreset.bricks))
    for _ in range(3):
        values = engine.infer(bricks).numpy()
        expected = float(np.square(values - coreset.values).sum())
        assert float(engine.train(bricks)) == pytest.approx(expected, rel=1e-10)
    assert np.square(engine.infer(bricks).numpy() - coreset.values).sum() < expected
    assert engine.parameters().fine.shape == (2, len(coreset.values))
