"""The gather engine: gradients beside differences, memory beside none."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch

from fhash_codec.bench.paper.data import Data
from fhash_codec.bench.paper.encodings import gather
from fhash_codec.bench.paper.encodings.build import levels_of
from fhash_codec.bench.paper.encodings.corners import Level
from fhash_codec.bench.paper.encodings.gather import GatherModel, WeightedSum
from fhash_codec.bench.paper.protocols import arrangement

NAMES = ("dense", "dense-multi", "hash", "fhash")
RATES = np.full(100, 0.01)


def levels(name: str, data: Data) -> Sequence[Level]:
    return levels_of(name, data, data.coreset, arrangement("equal", name, data))


def model_of(name: str, data: Data, dtype: torch.dtype = torch.float64) -> GatherModel:
    return GatherModel(
        levels(name, data), data.coreset, RATES, seed=3, device=torch.device("cpu"), dtype=dtype
    )


@pytest.mark.parametrize("name", NAMES)
def test_gradient_equals_differences(name: str, data: Data) -> None:
    model = model_of(name, data)
    random = np.random.default_rng(0)
    with torch.no_grad():  # embeddings near 0 hide errors of the network's gradient
        model.table += torch.from_numpy(random.normal(size=model.table.shape))
    samples = np.arange(0, len(data.coreset.values), 5)
    target = torch.from_numpy(data.coreset.values[samples])

    def loss() -> float:
        values = torch.from_numpy(model.infer(samples).astype(np.float64))
        return float((values - target).square().mean())

    assert loss() > 0.01
    points = model.places[samples].double()

    def exact() -> float:
        return float((model.sample(points) - target).square().mean())

    np.testing.assert_allclose(exact(), loss(), rtol=1e-6)
    gradients = model.gradients(samples)
    for number, gradient in zip(model.numbers, gradients, strict=True):
        flat, slopes = number.detach().view(-1), gradient.reshape(-1)
        steepest = slopes.abs().argsort(descending=True)[:20]
        for place in [*steepest.tolist(), *random.integers(0, len(flat), 5).tolist()]:
            before, step = float(flat[place]), 1e-8  # a longer one may cross a kink of ReLU
            flat[place] = before + step
            high = exact()
            flat[place] = before - step
            low = exact()
            flat[place] = before
            assert float(slopes[place]) == pytest.approx((high - low) / (2 * step), abs=2e-7)


def test_weighted_sum_passes_gradcheck() -> None:
    table = torch.randn(7, 2, dtype=torch.float64, requires_grad=True)
    buckets = torch.randint(0, 7, (5, 4))
    weights = torch.rand(5, 4, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda rows: WeightedSum.apply(rows, buckets, weights), table)


@pytest.mark.parametrize("name", NAMES)
def test_training_lowers_the_error(name: str, data: Data) -> None:
    model = model_of(name, data, torch.float32)
    every = np.arange(len(data.coreset.bricks))
    samples = np.arange(len(data.coreset.values))
    before = np.square(model.infer(samples) - data.coreset.values).mean()
    for _ in range(60):
        model.train(every)
    after = np.square(model.infer(samples) - data.coreset.values).mean()
    assert after < before / 50
    assert 0 < model.moved() <= model.embeddings


@pytest.mark.parametrize("name", ["hash", "fhash"])
def test_kept_corners_and_fresh_ones_train_alike(
    name: str, data: Data, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = model_of(name, data)
    monkeypatch.setattr(gather, "KEPT_BYTES", 0)
    monkeypatch.setattr(gather, "WHOLE", -1.0)  # all buckets are held
    fresh = model_of(name, data)
    assert fresh.rank is None
    assert fresh.tables == kept.tables
    with torch.no_grad():  # initial numbers depend on how many are held
        for number, other in zip(fresh.numbers[1:], kept.numbers[1:], strict=True):
            number.copy_(other)
        table = torch.zeros_like(fresh.table)
        table[kept.rank >= 0 if kept.rank is not None else slice(None)] = kept.table
        fresh.table.copy_(table)
    every = np.arange(len(data.coreset.bricks))
    for _ in range(3):
        kept.train(every)
        fresh.train(every)
    assert kept.moved() == fresh.moved()
    for array, other in zip(kept.arrays(), fresh.arrays(), strict=True):
        np.testing.assert_allclose(array, other, atol=1e-9)


def test_values_at_vertices_are_those_of_samples(data: Data) -> None:
    model = model_of("hash", data, torch.float32)
    model.train(np.arange(len(data.coreset.bricks)))
    samples = np.arange(len(data.coreset.values))
    np.testing.assert_allclose(
        model.sample(model.places.double()).numpy(), model.infer(samples), atol=1e-6
    )
