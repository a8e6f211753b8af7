"""Laws of the paper's model at points."""

from __future__ import annotations

from itertools import product

import torch

from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.fhash import FHash

DOUBLE = torch.float64


def random_model() -> FHash:
    architecture = Architecture.for_box((5, 9, 17), 4, width=16)
    random = torch.Generator().manual_seed(0)
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


def test_values_are_continuous_across_cells_and_key_frames() -> None:
    model = random_model()
    corners = torch.tensor(
        list(product(range(1, 3), range(1, 4), range(1, 8), range(1, 16))), dtype=DOUBLE
    )
    with torch.no_grad():
        for sign in (-1, 1):
            torch.testing.assert_close(
                model(corners + sign * 1e-9), model(corners), atol=1e-6, rtol=0
            )


def test_float32_is_close_to_float64() -> None:
    model = random_model()
    sizes = torch.tensor(model.architecture.sizes, dtype=DOUBLE)
    random = torch.Generator().manual_seed(1)
    points = torch.rand(500, 4, generator=random, dtype=DOUBLE) * (sizes - 1)
    double = model(points).detach()
    single = model.float()(points.float()).detach().double()
    assert float((single - double).abs().max()) < 1e-4
