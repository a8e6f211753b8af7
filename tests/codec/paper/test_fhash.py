"""The point model against a plain float64 evaluation, and its laws."""

from __future__ import annotations

from itertools import product

import pytest
import torch

from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.fhash import FHash
from fhash_codec.paper.levels import parameter_count
from fhash_codec.paper.tesseract import bucket_index, interpolate, locate

DOUBLE = torch.float64


def model_of(box=(5, 9, 17), key_frames=4, seed=0, **settings) -> FHash:
    architecture = Architecture.for_box(box, key_frames, width=16, **settings)
    random = torch.Generator().manual_seed(seed)
    size = architecture.embedding_size
    tables = [
        torch.randn(t * z * y * x, size, generator=random, dtype=DOUBLE)
        for t, z, y, x in architecture.levels
    ]
    layers = [
        (
            torch.randn(o, i, generator=random, dtype=DOUBLE) / i**0.5,
            torch.randn(o, generator=random, dtype=DOUBLE),
        )
        for o, i in architecture.layer_shapes
    ]
    return FHash(architecture, tables, layers)


def points_of(model: FHash, count: int, seed=1) -> torch.Tensor:
    sizes = torch.tensor(model.architecture.sizes, dtype=DOUBLE)
    return torch.rand(count, 4, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE) * (
        sizes - 1
    )


@pytest.mark.parametrize("resolution", [(1, 1, 1, 1), (2, 3, 5, 7), (1, 4, 1, 2)])
def test_bucket_index_is_a_bijection(resolution):
    corners = torch.tensor(list(product(*(range(n) for n in resolution))))
    assert bucket_index(corners, resolution).tolist() == list(range(len(corners)))


def test_bucket_index_is_the_papers_linearisation():
    t, z, y, x, (_, rz, ry, rx) = 3, 2, 4, 1, (5, 6, 7, 8)
    assert (
        int(bucket_index(torch.tensor([t, z, y, x]), (5, rz, ry, rx)))
        == t * rx * ry * rz + z * rx * ry + y * rx + x
    )


def test_vertices_of_the_finest_level_are_corners_exactly():
    sizes = (7, 11, 25, 125)
    every = torch.tensor(list(product(*(range(n) for n in (7, 11, 3, 3)))), dtype=DOUBLE)
    before, weight = locate(every, sizes, sizes)
    # A vertex is the corner before it with weight 0, or at the end of an axis the corner after it with weight 1.
    assert torch.equal(before + weight, every)
    assert set(weight.unique().tolist()) <= {0.0, 1.0}


def test_corners_align_at_every_level():
    sizes, resolution = (4, 9, 10, 33), (2, 5, 3, 17)
    ends = torch.tensor([[0, 0, 0, 0], [3, 8, 9, 32]], dtype=DOUBLE)
    before, weight = locate(ends, sizes, resolution)
    assert (before + weight).tolist() == [[0, 0, 0, 0], [1, 4, 2, 16]]


def test_interpolation_reproduces_a_multilinear_function():
    sizes = resolution = (3, 4, 5, 6)
    corners = torch.tensor(list(product(*(range(n) for n in resolution))), dtype=DOUBLE)

    def function(p):
        return ((1 + p[:, 0]) * (2 - p[:, 1]) * (0.5 + p[:, 2]) * (1 + 0.1 * p[:, 3])).unsqueeze(1)

    points = torch.rand(200, 4, dtype=DOUBLE) * (torch.tensor(sizes) - 1)
    torch.testing.assert_close(
        interpolate(function(corners), points, sizes, resolution), function(points)
    )


def test_an_axis_of_one_vertex_does_not_matter():
    table = torch.rand(6, 2, dtype=DOUBLE)
    points = torch.tensor([[0.0, 0.0, 0.3, 1.7], [5.0, -1.0, 0.3, 1.7]], dtype=DOUBLE)
    value, other = interpolate(table, points, (1, 1, 2, 3), (1, 1, 2, 3))
    torch.testing.assert_close(value, other)
    corners = table.reshape(2, 3, 2)[:, 1:]
    expected = (corners * torch.tensor([[0.7], [0.3]]).unsqueeze(-1)).sum(0)
    torch.testing.assert_close(value, 0.3 * expected[0] + 0.7 * expected[1])


def test_values_are_continuous_across_cells_and_key_frames():
    model = model_of()
    corners = torch.tensor(
        list(product(range(1, 3), range(1, 4), range(1, 8), range(1, 16))), dtype=DOUBLE
    )
    with torch.no_grad():
        for sign in (-1, 1):
            torch.testing.assert_close(
                model(corners + sign * 1e-9), model(corners), atol=1e-6, rtol=0
            )


@pytest.mark.parametrize(
    "settings", [{}, {"hidden_layers": 0, "embedding_size": 1}, {"hidden_layers": 3}]
)
def test_parameter_count(settings):
    model = model_of(**settings)
    counted = sum(p.numel() for p in model.parameters())
    assert counted == model.architecture.parameters
    assert counted > parameter_count(model.architecture.levels, model.architecture.embedding_size)


def test_float32_is_close_to_float64():
    model = model_of()
    points = points_of(model, 500)
    double = model(points).detach()
    single = model.float()(points.float()).detach().double()
    assert float((single - double).abs().max()) < 1e-4
