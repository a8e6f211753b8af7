"""Every engine trains and evaluates the same model; the naive one in float64 is the oracle."""

from __future__ import annotations

from math import prod

import numpy as np
import pytest
import torch

from fhash_codec.coreset.bricks import Coreset, build_coreset
from fhash_codec.coreset.features import Interval
from fhash_codec.coreset.scan import scan
from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.engines import make_engine
from fhash_codec.paper.engines.initial import initial_parameters
from fhash_codec.paper.engines.naive import NaiveEngine
from fhash_codec.paper.engines.slab import SlabEngine
from fhash_codec.progress import silent
from fhash_codec.training.adam import BETA1, BETA2, EPSILON, catch_up
from fhash_codec.training.devices import choose_device
from fhash_formats.errors import InputError
from fhash_formats.series import ArraySeries

CPU = torch.device("cpu")
CASES = [
    pytest.param((5, 9, 20, 35), {"embedding_size": 2, "hidden_layers": 1}, id="plain"),
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


def coreset_of(shape: tuple[int, int, int, int], low: float = 0.3) -> Coreset:
    """Noise in which the values from `low` to 1 are the feature."""
    series = ArraySeries(np.random.default_rng(3).random(shape, dtype=np.float32))
    scanned = scan(series, silent)
    return build_coreset(series, scanned, range(shape[0]), [Interval(low, 1.0)], 0, silent)


def engines_of(shape, settings, *, steps=200, rate=0.01):
    coreset = coreset_of(shape, settings.get("low", 0.3))
    settings = {name: value for name, value in settings.items() if name != "low"}
    architecture = Architecture.for_box(coreset.box.shape, shape[0], width=16, **settings)
    rates = np.full(steps + 1, rate)
    slab = SlabEngine(architecture, coreset, rates, seed=7, device=CPU)
    oracle = NaiveEngine(architecture, coreset, rates, seed=7, device=CPU, dtype=torch.float64)
    return coreset, slab, oracle


def inside(coreset: Coreset) -> np.ndarray:
    return np.unpackbits(coreset.mask_bits, axis=1, count=prod(coreset.brick_shape)).astype(bool)


@pytest.mark.parametrize(("shape", "settings"), CASES)
def test_slab_equals_the_oracle_before_training(shape, settings):
    coreset, slab, oracle = engines_of(shape, settings)
    every = np.arange(len(coreset.bricks))
    mask = inside(coreset)
    np.testing.assert_allclose(
        slab.infer(every).numpy()[mask], oracle.infer(every).numpy()[mask], atol=2e-7
    )
    assert slab.squared_error(every) == pytest.approx(oracle.squared_error(every), rel=1e-5)


@pytest.mark.parametrize(("shape", "settings"), CASES)
def test_slab_trains_like_a_dense_adam_though_it_visits_few_bricks_a_step(shape, settings):
    coreset, slab, oracle = engines_of(shape, settings)
    bricks, random = len(coreset.bricks), np.random.default_rng(1)
    for _ in range(40):
        chosen = random.permutation(bricks)[: max(1, bricks // 3)]
        error = float(slab.train(chosen))
        assert error == pytest.approx(float(oracle.train(chosen)), rel=1e-3, abs=1e-6)
    ours, theirs = slab.parameters(), oracle.parameters()
    # Median and count, not maximum: near a ReLU's kink float32 may take the other side, in torch's own Adam as well.
    for a, b in (
        (ours.fine, theirs.fine),
        (ours.coarse, theirs.coarse),
        (ours.network, theirs.network),
    ):
        if not a.numel():
            continue
        # What no sample moved is 0 in ours and still at its start in the oracle's.
        apart = (a - b)[a != 0].abs()
        # A thousandth of one Adam step, after 40 of them.
        assert float(apart.median()) < 1e-3 * 0.01
        assert float((apart > 1e-3).double().mean()) < 0.01


def test_gradients_equal_those_of_autograd_in_float64():
    coreset, slab, oracle = engines_of((4, 9, 12, 20), {"embedding_size": 2, "hidden_layers": 2})
    every = np.arange(len(coreset.bricks))
    slab.train(every)
    oracle.train(every)
    tables = torch.cat([table.grad.flatten() for table in list(oracle.model.tables)[1:]])
    parts = [tables[slab.upsampling.used]]
    for weight, bias in zip(oracle.model.weights, oracle.model.biases, strict=True):
        parts.append(torch.column_stack([weight.grad, bias.grad]))
    expected = torch.cat([part.flatten() for part in parts]).float()
    apart = (slab.gradient - expected).abs() / expected.abs().max()
    assert float(apart.median()) < 1e-7
    assert float((apart > 1e-5).double().mean()) < 0.001


@pytest.mark.parametrize("engine", ["slab", "naive"])
def test_restoring_a_state_goes_on_bit_for_bit(engine):
    coreset = coreset_of((3, 9, 10, 20))
    architecture = Architecture.for_box(coreset.box.shape, 3, width=8)
    rates = np.linspace(0.01, 0.001, 21)
    batches = np.random.default_rng(0).integers(0, len(coreset.bricks), (20, 1))

    def run(first, last, state=None):
        engine_ = make_engine(engine, architecture, coreset, rates, seed=1, device=CPU)
        if state:
            engine_.restore(state)
        for batch in batches[first:last]:
            engine_.train(batch)
        return engine_

    whole, half = run(0, 20), run(0, 9)
    state = {name: np.array(array) for name, array in half.state().items()}
    resumed = run(9, 20, state)
    for name, array in whole.state().items():
        np.testing.assert_array_equal(array, resumed.state()[name], err_msg=name)


def test_catching_up_equals_stepping_without_gradient():
    rates = 0.01 * (0.5 + 0.5 * np.cos(np.linspace(0, np.pi, 400)))
    visited = np.array([0, 1, 5, 100, 250, 299])
    for scale in (1e-2, 1e-6, 1e-9):
        m, v, p = 0.3 * scale, scale**2, 0.0
        factor, epsilon, mean_decay, square_decay = (
            column.astype(float) for column in catch_up(visited, 299, rates)
        )
        for number, first in enumerate(visited):
            mean, square, moved = m, v, p
            for step in range(first + 1, 300) if first else ():
                mean, square = BETA1 * mean, BETA2 * square
                moved -= (
                    rates[step]
                    * mean
                    / (1 - BETA1**step)
                    / ((square / (1 - BETA2**step)) ** 0.5 + EPSILON)
                )
            ours = -factor[number] * m / (v**0.5 + epsilon[number])
            # The one approximation shows only where sqrt(v) is near eps within Adam's first steps, while its correction still moves.
            assert ours == pytest.approx(
                moved, rel=0.05 if scale < 1e-8 and first < 100 else 2e-3, abs=1e-12
            )
            assert mean_decay[number] == pytest.approx(mean / m, rel=1e-5, abs=1e-37)
            assert square_decay[number] == pytest.approx(square / v, rel=1e-5)


def test_embeddings_that_no_sample_moved_are_stored_as_zero():
    coreset, slab, _ = engines_of((3, 9, 20, 35), {"embedding_size": 2, "hidden_layers": 1})
    slab.train(np.arange(len(coreset.bricks)))
    fine = slab.parameters().fine.numpy()
    mask = inside(coreset)
    outside = np.moveaxis(fine, 1, -1)[~mask]
    # A negative zero would cost bytes.
    assert not outside.any()
    assert not np.signbit(outside).any()
    assert (np.moveaxis(fine, 1, -1)[mask] != 0).all()


def test_the_start_depends_on_the_seed_alone():
    coreset = coreset_of((2, 5, 6, 7))
    architecture = Architecture.for_box(coreset.box.shape, 2)
    one, same, other = (initial_parameters(architecture, coreset, seed) for seed in (4, 4, 5))
    assert torch.equal(one.fine, same.fine)
    assert torch.equal(one.coarse, same.coarse)
    assert torch.equal(one.network, same.network)
    assert not torch.equal(one.network, other.network)
    assert (
        one.coarse.numel() + one.network.numel() + prod(architecture.levels[0]) * 2
        == architecture.parameters
    )


def test_unknown_engines_and_devices_are_refused():
    coreset = coreset_of((1, 2, 2, 2))
    with pytest.raises(InputError, match="unknown engine 'quick'"):
        make_engine(
            "quick", Architecture.for_box((2, 2, 2), 1), coreset, np.zeros(1), seed=0, device=CPU
        )
    if not torch.cuda.is_available():
        with pytest.raises(InputError, match="no CUDA device"):
            choose_device("cuda")
    assert choose_device("cpu") == CPU


def test_training_holds_only_what_the_bricks_reach_of_the_coarse_tables():
    _, slab, oracle = engines_of((3, 30, 40, 50), {"low": 0.9999})
    coarse = sum(len(table) * 2 for table in list(oracle.model.tables)[1:])
    assert 0 < len(slab.upsampling.used) < 0.6 * coarse
    assert slab.parameters().coarse.numel() == coarse
