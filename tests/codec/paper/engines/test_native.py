"""The native engine trains what the naive one in float64 does, on every path of the machine."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.torch

from engine_checks import assert_near
from readable_paper import NaiveEngine

from fhash_codec.native.network import PATHS, machine_paths
from fhash_codec.paper.engines.native import NativeEngine, refusal
from fhash_codec.paper.network import Architecture
from fhash_formats.errors import InputError
from fhash_formats.support.threads import at_most

CPU = torch.device("cpu")
RATES = np.full(201, 0.01)
STEPS = 40
CASES = {
    "plain": ((4, 7, 16, 30), {"hidden_layers": 1}),
    "one key frame, linear readout": (
        (1, 17, 16, 16),
        {"embedding_size": 1, "hidden_layers": 0, "fold": 3},
    ),
    "thin axes, two hidden layers": (
        (3, 1, 33, 2),
        {"embedding_size": 3, "hidden_layers": 2, "width": 32},
    ),
    "a column": ((2, 5, 1, 1), {"hidden_layers": 1}),
    "one voxel": ((2, 1, 1, 1), {"hidden_layers": 1}),
    "a row of many groups": ((2, 1, 1, 700), {"hidden_layers": 1}),
    "a row of many groups, few of them full": ((2, 1, 3, 300), {"hidden_layers": 1, "low": 0.9}),
    "a few vertices far apart": ((3, 30, 40, 50), {"hidden_layers": 1, "low": 0.9999}),
    "no coarse levels": ((2, 9, 9, 20), {"hidden_layers": 1, "levels": 1}),
    "odd width, large embeddings": (
        (2, 6, 9, 40),
        {"embedding_size": 4, "hidden_layers": 1, "width": 37, "fold": 4},
    ),
    "64 neurons twice": ((2, 9, 12, 20), {"hidden_layers": 2, "width": 64, "low": 0.5}),
    "128 neurons twice": ((1, 9, 12, 20), {"hidden_layers": 2, "width": 128}),
    "steps between key frames": (
        (6, 7, 16, 30),
        {"hidden_layers": 1, "keys": (0, 3, 5), "fringe": True},
    ),
    "between key frames, few vertices": (
        (5, 30, 20, 50),
        {"hidden_layers": 2, "keys": (1, 4), "low": 0.9995, "fringe": True, "embedding_size": 3},
    ),
    "between key frames, one level": (
        (5, 9, 9, 20),
        {"hidden_layers": 1, "keys": (0, 2, 4), "levels": 1, "fringe": True},
    ),
}


@pytest.fixture(params=PATHS)
def path(request: pytest.FixtureRequest) -> str:
    """Each path of the kernels; those that the machine lacks are skipped."""
    name: str = request.param
    if name not in machine_paths():
        pytest.skip(f"this machine has no {name}")
    return name


@pytest.fixture(scope="session")
def model_of(noise_coreset):
    """A function of a case's name: its coreset and architecture."""

    def make(case, **changes):
        shape, settings = CASES[case] if isinstance(case, str) else case
        settings = {"embedding_size": 2, "width": 16} | settings | changes
        kind = {name: settings.pop(name) for name in ("low", "fringe", "keys") if name in settings}
        coreset = noise_coreset(shape, **kind)
        levels, keys = settings.pop("levels", None), len(coreset.key_frames)
        architecture = Architecture.for_box(coreset.box.shape, keys, **settings)
        return coreset, replace(architecture, levels=architecture.levels[:levels])

    return make


@pytest.fixture(scope="session")
def oracle_of(model_of):
    """A function of a case's name: the batches, the errors and the numbers of the oracle."""
    known = {}

    def make(case):
        if case not in known:
            coreset, architecture = model_of(case)
            oracle = NaiveEngine(architecture, coreset, RATES, seed=7)
            first = oracle.infer(np.arange(len(coreset.bricks)))
            random, bricks = np.random.default_rng(1), len(coreset.bricks)
            batches = [random.permutation(bricks)[: max(1, bricks // 3)] for _ in range(STEPS)]
            errors = [float(oracle.train(batch)) for batch in batches]
            known[case] = first, batches, errors, oracle.parameters()
        return known[case]

    return make


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("path", PATHS, indirect=True)
def test_it_trains_like_a_dense_adam_in_float64(model_of, oracle_of, path, case) -> None:
    """Though it visits few bricks a step."""
    coreset, architecture = model_of(case)
    first, batches, errors, expected = oracle_of(case)
    engine = NativeEngine(architecture, coreset, RATES, seed=7, path=path)
    values = engine.infer(np.arange(len(coreset.bricks)))
    assert values.shape == coreset.values.shape
    np.testing.assert_allclose(values, first, atol=3e-7)
    ours = [float(engine.train(batch)) for batch in batches]
    np.testing.assert_allclose(ours, errors, rtol=1e-3, atol=1e-6)
    assert_near(engine.parameters(), expected)


def test_gradients_equal_those_of_autograd_in_float64(model_of, path) -> None:
    """After one step Adam's mean is a tenth of the gradient."""
    coreset, architecture = model_of("64 neurons twice")
    bricks = np.arange(len(coreset.bricks))
    engine = NativeEngine(architecture, coreset, RATES, seed=7, path=path)
    oracle = NaiveEngine(architecture, coreset, RATES, seed=7)
    engine.train(bricks)
    oracle.train(bricks)
    tables = torch.cat([table.grad.flatten() for table in list(oracle.model.tables)[1:]])
    parts = [tables[engine._used]]
    for weight, bias in zip(oracle.model.weights, oracle.model.biases, strict=True):
        parts.append(torch.column_stack([weight.grad, bias.grad]))
    expected = torch.cat([part.flatten() for part in parts]).numpy()
    apart = np.abs(engine.state()["flat_mean"] * 10 - expected) / np.abs(expected).max()
    assert np.median(apart) < 1e-7
    assert (apart > 1e-5).mean() < 0.001


@pytest.mark.parametrize("count", [1, 2, 3])
def test_the_same_seed_path_and_threads_give_the_same_bits(model_of, path, count) -> None:
    coreset, architecture = model_of(((3, 9, 20, 35), {"hidden_layers": 2, "low": 0.6}))
    bricks = len(coreset.bricks)
    states = []
    for _ in range(2):
        engine = NativeEngine(architecture, coreset, RATES, seed=3, path=path)
        random = np.random.default_rng(5)
        with at_most(count):
            errors = [float(engine.train(random.permutation(bricks)[:5])) for _ in range(8)]
        states.append(engine.state() | {"errors": np.array(errors)})
    for name, array in states[0].items():
        np.testing.assert_array_equal(array, states[1][name], err_msg=name)


@pytest.mark.parametrize("case", ["plain", "a few vertices far apart", "no coarse levels"])
def test_it_goes_on_from_the_state_of_an_engine_without_blocks(model_of, case) -> None:
    """The state of the fused engine has none."""
    coreset, architecture = model_of(case)
    random, bricks = np.random.default_rng(1), len(coreset.bricks)
    batches = [random.permutation(bricks)[: max(1, bricks // 3)] for _ in range(30)]
    straight = NativeEngine(architecture, coreset, RATES, seed=7)
    interrupted = NativeEngine(architecture, coreset, RATES, seed=7)
    for step, batch in enumerate(batches):
        if step == 10:
            state = {name: array.copy() for name, array in interrupted.state().items()}
            interrupted = NativeEngine(architecture, coreset, RATES, seed=1)
            interrupted.restore({n: a for n, a in state.items() if n not in ("blocks", "behind")})
        error = float(straight.train(batch))
        assert float(interrupted.train(batch)) == pytest.approx(error, rel=1e-3, abs=1e-6)
    assert_near(interrupted.parameters(), straight.parameters())


def test_a_state_of_another_model_is_refused(model_of) -> None:
    coreset, architecture = model_of("plain")
    engine = NativeEngine(architecture, coreset, RATES, seed=7)
    other = NativeEngine(replace(architecture, width=8), coreset, RATES, seed=7)
    with pytest.raises(ValueError, match="flat"):
        engine.restore(other.state())
    with pytest.raises(KeyError):
        engine.restore({"step": np.array(3)})


def test_what_it_does_not_take_is_named(model_of) -> None:
    coreset, architecture = model_of("plain")

    def refused(match, **changes):
        with pytest.raises(InputError, match=match):
            NativeEngine(replace(architecture, **changes), coreset, RATES, seed=7)

    refused("2 hidden layers at most, not 3", hidden_layers=3)
    refused("128 neurons at most, not 129", width=129)
    assert refusal(replace(architecture, width=1024, hidden_layers=0)) is None
    with pytest.raises(InputError, match="path is 'quick'"):
        NativeEngine(architecture, coreset, RATES, seed=7, path="quick")


def test_training_holds_only_what_the_bricks_reach_of_the_coarse_tables(model_of) -> None:
    coreset, architecture = model_of("a few vertices far apart")
    engine = NativeEngine(architecture, coreset, RATES, seed=7)
    assert 0 < engine.coarse < 0.6 * architecture.coarse_numbers
    assert engine.parameters().coarse.size == architecture.coarse_numbers
