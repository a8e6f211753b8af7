"""Engines by name, and the state that lets any of them continue."""

from __future__ import annotations

from itertools import product
from math import prod

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.torch

from pretended_cuda import CUDA, pretended_cuda
from readable_paper import NaiveEngine, bucket_index, interpolate

from fhash_codec.native.network import machine_paths
from fhash_codec.paper.engines import describe_engine, make_engine
from fhash_codec.paper.engines.parameters import (
    BETA1,
    BETA2,
    EPSILON,
    SPREAD,
    catch_up,
    initial_parameters,
)
from fhash_codec.paper.network import Architecture
from fhash_codec.rendering.torch_arrays import true_positions
from fhash_formats.errors import InputError

CPU = torch.device("cpu")


def test_a_cpu_has_the_native_engine(noise_coreset) -> None:
    coreset = noise_coreset((1, 2, 2, 2))

    def chosen(hidden_layers):
        architecture = Architecture.for_box((2, 2, 2), 1, hidden_layers=hidden_layers)
        return make_engine(architecture, coreset, np.zeros(1), seed=0, device="cpu")

    assert describe_engine(chosen(2), 3) == {
        "engine": "native",
        "threads": 3,
        "path": machine_paths()[0],
    }
    with pytest.raises(InputError, match="2 hidden layers at most, not 3"):
        chosen(3)


def test_the_start_depends_on_the_seed_alone(noise_coreset) -> None:
    coreset = noise_coreset((2, 5, 6, 7))
    architecture = Architecture.for_box(coreset.box.shape, 2)
    one, same, other = (initial_parameters(architecture, coreset, seed) for seed in (4, 4, 5))
    assert np.array_equal(one.fine, same.fine)
    assert np.array_equal(one.coarse, same.coarse)
    assert np.array_equal(one.network, same.network)
    assert not np.array_equal(one.network, other.network)
    assert (
        one.coarse.size + one.network.size + prod(architecture.levels[0]) * 2
        == architecture.parameters
    )


@pytest.mark.parametrize("hidden_layers", [1, 2, 3])
def test_layers_of_one_number_start_near_the_identity(noise_coreset, hidden_layers) -> None:
    coreset = noise_coreset((2, 5, 6, 7))
    architecture = Architecture.for_box(
        coreset.box.shape, 2, embedding_size=1, hidden_layers=hidden_layers, width=16
    )
    _, layers = initial_parameters(architecture, coreset, 4).dense(architecture)
    finest = np.linspace(-0.5, 1, 7, dtype=np.float32)
    numbers = np.concatenate([finest[None], np.zeros((architecture.inputs - 1, 7), np.float32)])
    for number, (weight, bias) in enumerate(layers, start=1):
        numbers = weight @ numbers + bias[:, None]
        if number < len(layers):
            numbers = np.maximum(numbers, 0)
    np.testing.assert_allclose(numbers[0], finest, atol=0.2)
    assert np.abs(numbers[0] - finest).max() > 1e-4  # the other neurons count, too


def test_embeddings_of_samples_start_where_those_of_whole_bricks_did(
    noise_coreset, in_coreset, monkeypatch
) -> None:
    coreset = noise_coreset((2, 9, 10, 20), 0.7)
    architecture = Architecture.for_box(coreset.box.shape, 2)
    shape = (len(coreset.bricks), 2, prod(coreset.brick_shape))
    random = torch.Generator().manual_seed(3)
    whole = torch.empty(shape).uniform_(-SPREAD, SPREAD, generator=random)
    expected = whole.transpose(0, 1)[:, torch.from_numpy(in_coreset(coreset))]
    for bricks in (1, 3, 1024):
        monkeypatch.setattr("fhash_codec.paper.engines.parameters.BRICKS_AT_A_TIME", bricks)
        assert np.array_equal(initial_parameters(architecture, coreset, 3).fine, expected.numpy())


def test_catching_up_equals_stepping_without_gradient() -> None:
    rates = 0.01 * (0.5 + 0.5 * np.cos(np.linspace(0, np.pi, 400)))
    visited = np.array([0, 1, 5, 100, 250, 299])
    for scale in (1e-2, 1e-6, 1e-9):
        m, v = 0.3 * scale, scale**2
        effect = catch_up(visited, 299, rates)
        for number, first in enumerate(visited):
            mean, square, moved = m, v, 0.0
            for step in range(first + 1, 300) if first else ():
                mean, square = BETA1 * mean, BETA2 * square
                moved -= (
                    rates[step]
                    * mean
                    / (1 - BETA1**step)
                    / ((square / (1 - BETA2**step)) ** 0.5 + EPSILON)
                )
            ours = -float(effect.factor[number]) * m / (v**0.5 + float(effect.epsilon[number]))
            # The one approximation shows only where sqrt(v) is near eps within Adam's first steps,
            # while its correction still moves.
            assert ours == pytest.approx(
                moved, rel=0.05 if scale < 1e-8 and first < 100 else 2e-3, abs=1e-12
            )
            assert effect.mean_decay[number] == pytest.approx(mean / m, rel=1e-5, abs=1e-37)
            assert effect.square_decay[number] == pytest.approx(square / v, rel=1e-5)


MASKS = [[], [0], [1], [0, 1, 1, 0, 0, 1], [1, 1, 1], [0, 0, 0]]


@pytest.mark.parametrize("mask", MASKS)
@pytest.mark.parametrize("dtype", [torch.bool, torch.uint8])
def test_positions_are_those_of_nonzero_without_a_wait(mask: list[int], dtype: torch.dtype) -> None:
    expected = np.nonzero(mask)[0]
    here = true_positions(torch.tensor(mask, dtype=dtype), len(expected))
    with pretended_cuda() as pretended:
        on_device = torch.tensor(mask, dtype=dtype, device="cuda")
        there = true_positions(on_device, len(expected))
        assert pretended.counts["waits"] == 0
        assert there.device == CUDA
        there = there.cpu()
    for found in (here, there):
        assert found.dtype == torch.int64
        np.testing.assert_array_equal(found.numpy(), expected)


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


def test_errors_are_those_of_the_values_at_the_samples(noise_coreset) -> None:
    coreset = noise_coreset((3, 6, 10, 20))
    architecture = Architecture.for_box(coreset.box.shape, 3, width=8)
    engine = NaiveEngine(architecture, coreset, np.full(10, 0.01), seed=1)
    bricks = np.arange(len(coreset.bricks))
    for _ in range(3):
        values = engine.infer(bricks)
        expected = float(np.square(values - coreset.values).sum())
        assert float(engine.train(bricks)) == pytest.approx(expected, rel=1e-10)
    assert np.square(engine.infer(bricks) - coreset.values).sum() < expected
    assert engine.parameters().fine.shape == (2, len(coreset.values))
