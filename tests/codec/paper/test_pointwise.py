"""Dense layers at scattered points: the value of a point never depends on the other points."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fhash_codec.paper.network import ArrayTable, DenseLayers, Network
from fhash_codec.paper.points import sample_points
from fhash_codec.paper.pointwise import BLOCK, PointwiseLayers

POINTS = BLOCK + 100
SIZE = (9, 10, 11)


def random_network(width: int, hidden: int, seed: int = 0) -> Network:
    """A network of three levels with two embeddings each, over three key frames."""
    random = np.random.default_rng(seed)
    levels = ((3, *SIZE), (2, 5, 5, 6), (1, 3, 3, 3))
    widths = [2 * len(levels), *[width] * hidden, 1]
    return Network(
        levels=levels,
        embedding_size=2,
        tables=[
            ArrayTable(random.normal(0, 0.3, (*level, 2)).astype(np.float32)) for level in levels
        ],
        layers=tuple(
            (
                random.normal(0, inputs**-0.5, (outputs, inputs)).astype(np.float32),
                random.normal(0, 0.1, outputs).astype(np.float32),
            )
            for inputs, outputs in itertools.pairwise(widths)
        ),
        box_size=SIZE,
        key_frames=3,
    )


@pytest.fixture
def uneven_products(monkeypatch: pytest.MonkeyPatch) -> None:
    """Matrix products whose rounding depends on the column, as that of some BLAS kernels does."""
    product = np.matmul

    def uneven(*given: Any, **more: Any) -> Any:
        result = product(*given, **more)
        result[..., ::3] = np.nextafter(result[..., ::3], np.float32(np.inf))
        return result

    monkeypatch.setattr(np, "matmul", uneven)


@pytest.mark.usefixtures("uneven_products", "evaluation")
@pytest.mark.parametrize(("width", "hidden"), [(1, 0), (16, 1), (33, 3)])
def test_a_point_has_the_same_bits_among_any_other_points(width: int, hidden: int) -> None:
    network, random = random_network(width, hidden), np.random.default_rng(1)
    points = np.concatenate(
        [[np.full(POINTS, 0.7)], random.uniform(0, 1, (3, POINTS)) * (np.array(SIZE)[:, None] - 1)]
    )
    values, slopes = sample_points(network, *points, gradient=True)
    for count in (1, 2, 3, 63, 64, 65, 200, BLOCK + 1, POINTS):
        chosen = random.permutation(POINTS)[:count]
        some_values, some_slopes = sample_points(network, *points[:, chosen], gradient=True)
        np.testing.assert_array_equal(some_values, values[chosen])
        np.testing.assert_array_equal(some_slopes, slopes[chosen])


@pytest.mark.parametrize(("width", "hidden"), [(1, 0), (16, 1), (33, 3)])
def test_values_and_slopes_are_those_of_matrix_products(width: int, hidden: int) -> None:
    random = np.random.default_rng(2)
    network = random_network(width, hidden)
    # All sums of these small whole numbers are exact, whatever their order.
    network = replace(
        network,
        layers=tuple(
            tuple(random.integers(-1, 2, part.shape).astype(np.float32) for part in layer)
            for layer in network.layers
        ),
    )
    products, pointwise = DenseLayers(network, 150), PointwiseLayers(network, 150)
    assert pointwise.inputs.shape == products.inputs.shape
    shape = (6, products.inputs.shape[1])
    products.inputs[:-1] = pointwise.inputs[:-1] = random.integers(-3, 4, shape)
    np.testing.assert_array_equal(pointwise.run(), products.run())
    changes = random.integers(-3, 4, (4, *shape)).astype(np.float32)
    np.testing.assert_array_equal(
        pointwise.slopes(changes), np.einsum("in,ain->an", products.gradient(), changes)
    )
