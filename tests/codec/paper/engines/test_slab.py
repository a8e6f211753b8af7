"""The slab engine trains and evaluates what the naive one in float64 does."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from engine_checks import assert_gradient_of_autograd, assert_near
from readable_paper import NaiveEngine

from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.engines.slab import SlabEngine

CPU = torch.device("cpu")
CASES = [
    pytest.param((4, 7, 16, 30), {"embedding_size": 2, "hidden_layers": 1}, id="plain"),
    pytest.param(
        (1, 17, 16, 16),
        {"embedding_size": 1, "hidden_layers": 0, "fold": 3},
        id="one key frame, linear readout",
    ),
    pytest.param(
        (3, 1, 33, 2), {"embedding_size": 3, "hidden_layers": 2}, id="thin axes, two hidden layers"
    ),
    pytest.param((2, 5, 1, 1), {"embedding_size": 2, "hidden_layers": 1}, id="a column"),
    pytest.param((2, 1, 1, 1), {"embedding_size": 2, "hidden_layers": 1}, id="one voxel"),
    pytest.param(
        (3, 30, 40, 50),
        {"embedding_size": 2, "hidden_layers": 1, "low": 0.9999},
        id="a few vertices far apart",
    ),
]


@pytest.fixture
def engines_of(noise_coreset):
    """A function of a shape and settings: coreset, slab engine, and the oracle in float64."""

    def make(shape, settings):
        coreset = noise_coreset(shape, settings.get("low", 0.3))
        settings = {name: value for name, value in settings.items() if name != "low"}
        architecture = Architecture.for_box(coreset.box.shape, shape[0], width=16, **settings)
        rates = np.full(201, 0.01)
        slab = SlabEngine(architecture, coreset, rates, seed=7, device=CPU)
        oracle = NaiveEngine(architecture, coreset, rates, seed=7)
        return coreset, slab, oracle

    return make


@pytest.mark.parametrize(("shape", "settings"), CASES)
def test_slab_equals_the_oracle_before_training(engines_of, shape, settings) -> None:
    coreset, slab, oracle = engines_of(shape, settings)
    bricks = np.arange(len(coreset.bricks))
    values = slab.infer(bricks).numpy()
    assert values.shape == coreset.values.shape
    np.testing.assert_allclose(values, oracle.infer(bricks).numpy(), atol=2e-7)


@pytest.mark.parametrize(("shape", "settings"), CASES)
def test_slab_trains_like_a_dense_adam_though_it_visits_few_bricks_a_step(
    engines_of, shape, settings
) -> None:
    coreset, slab, oracle = engines_of(shape, settings)
    bricks, random = len(coreset.bricks), np.random.default_rng(1)
    for _ in range(40):
        chosen = random.permutation(bricks)[: max(1, bricks // 3)]
        error = float(slab.train(chosen))
        assert error == pytest.approx(float(oracle.train(chosen)), rel=1e-3, abs=1e-6)
    assert_near(slab.parameters(), oracle.parameters())


def test_gradients_equal_those_of_autograd_in_float64(engines_of) -> None:
    coreset, slab, oracle = engines_of((4, 9, 12, 20), {"embedding_size": 2, "hidden_layers": 2})
    bricks = np.arange(len(coreset.bricks))
    slab.train(bricks)
    oracle.train(bricks)
    assert_gradient_of_autograd(slab.gradient, slab.upsampling.used, oracle)


def test_training_holds_the_finest_embeddings_of_samples_alone(engines_of) -> None:
    coreset, slab, _ = engines_of((3, 9, 20, 35), {"embedding_size": 2, "hidden_layers": 1})
    start = slab.parameters().fine.clone()
    slab.train(np.arange(len(coreset.bricks)))
    for numbers in (slab.fine, slab.fine_mean, slab.fine_square, slab.parameters().fine):
        assert numbers.shape == (2, len(coreset.values))
        assert (numbers != 0).all()
    assert (slab.parameters().fine != start).all()


def test_training_holds_only_what_the_bricks_reach_of_the_coarse_tables(engines_of) -> None:
    _, slab, oracle = engines_of((3, 30, 40, 50), {"low": 0.9999})
    coarse = sum(len(table) * 2 for table in list(oracle.model.tables)[1:])
    assert 0 < len(slab.upsampling.used) < 0.6 * coarse
    assert slab.parameters().coarse.numel() == coarse


def test_samples_alone_give_the_same_gradients_as_all_vertices_of_sparse_bricks(
    engines_of, monkeypatch
) -> None:
    shape, settings = (3, 9, 20, 35), {"embedding_size": 2, "hidden_layers": 2, "low": 0.8}
    gradients, errors, moments = [], [], []
    for full in (1.0, -1.0):
        monkeypatch.setattr("fhash_codec.paper.engines.slab.FULL", full)
        coreset, slab, _ = engines_of(shape, settings)
        errors.append(float(slab.train(np.arange(len(coreset.bricks)))))
        gradients.append(slab.gradient.clone())
        moments.append(slab.fine_mean.clone())
        # What stands for vertices that are no samples never moves.
        assert not slab._numbers[..., -1].any()
    assert errors[0] == pytest.approx(errors[1], rel=1e-6)
    apart = (gradients[0] - gradients[1]).abs() / gradients[1].abs().max()
    assert float(apart.max()) < 1e-5
    apart = (moments[0] - moments[1]).abs() / moments[1].abs().max()
    assert float(apart.max()) < 1e-5


@pytest.mark.parametrize("full", [1.0, 0.0])
def test_only_samples_of_sparse_bricks_are_evaluated(engines_of, monkeypatch, full) -> None:
    """Both ways give the values at the samples; FULL decides how many columns the MLP takes."""
    monkeypatch.setattr("fhash_codec.paper.engines.slab.FULL", full)
    settings = {"embedding_size": 2, "hidden_layers": 2, "low": 0.8}
    coreset, slab, oracle = engines_of((3, 9, 20, 35), settings)
    columns, value = [], slab._value
    monkeypatch.setattr(
        slab, "_value", lambda inputs: (columns.append(inputs.shape[1]), value(inputs))[1]
    )
    chosen = np.arange(len(coreset.bricks))[::-2].copy()
    np.testing.assert_allclose(slab.infer(chosen).numpy(), oracle.infer(chosen).numpy(), atol=2e-7)
    samples = int(np.diff(coreset.offsets)[chosen].sum())
    assert columns == [samples if full else len(chosen) * slab.vertices]
