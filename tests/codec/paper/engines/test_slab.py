"""Engine slab: it trains like the oracle in float64, also on a pretended CUDA device."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from engine_checks import assert_near
from pretended_cuda import Pretended, pretended_cuda
from readable_paper import NaiveEngine
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten

from fhash_codec.features.bricks import Coreset, build_coreset
from fhash_codec.features.features import Everything, Feature, FeatureChoice, Interval
from fhash_codec.features.scan import scan
from fhash_codec.paper.engines import make_engine
from fhash_codec.paper.engines.slab import (
    LIBRARIES,
    TIMES,
    UNEVEN,
    SlabEngine,
    StepGraphs,
    needed_bytes,
)
from fhash_codec.paper.network import Architecture
from fhash_codec.progress import silent
from fhash_formats.errors import FhashWarning
from fhash_formats.series import ArraySeries

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


def test_a_step_that_waits_is_not_captured_and_told_once() -> None:
    with pretended_cuda():
        steps = StepGraphs()

        def waiting() -> Any:
            number = torch.ones(1, device="cuda")
            return number * float(number)

        with pytest.warns(FhashWarning, match="no CUDA graph .*not permitted") as told:
            results = [float(steps.run("a", waiting)) for _ in range(5)]
    assert results == [1.0] * 5
    assert len(told) == 1


class Made(TorchDispatchMode):
    """Counts the bytes of all tensors that are made, also of those that are freed again."""

    def __init__(self) -> None:
        super().__init__()
        self.bytes = 0

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        known = {id(each.untyped_storage()) for each in tensors(args)}
        known |= {each.data_ptr() for each in tensors(args)}
        for each in tensors(result):
            self.bytes += each.nbytes if each.data_ptr() not in known else 0
        return result


def tensors(values: Any) -> list[torch.Tensor]:
    return [each for each in tree_flatten(values)[0] if isinstance(each, torch.Tensor)]


@pytest.mark.parametrize("low", [0.0, 0.7])
@pytest.mark.parametrize("settings", [{"hidden_layers": 1, "width": 64}, {"hidden_layers": 2}])
def test_a_training_needs_what_is_said(
    noise_coreset: Callable[..., Coreset], settings: dict[str, int], low: float
) -> None:
    coreset = noise_coreset((3, 30, 40, 50), low)
    architecture = Architecture.for_box(coreset.box.shape, 3, **{"width": 16, **settings})
    bricks = len(coreset.bricks)
    needed = needed_bytes(architecture, coreset, 8) - LIBRARIES
    engine = SlabEngine(architecture, coreset, np.full(3, 0.01), seed=0, device=torch.device("cpu"))
    every = tensors([*vars(engine).values(), *vars(engine.upsampling).values()])
    # Some are views of the same memory.
    storages = {each.data_ptr(): each for each in (t.untyped_storage() for t in every)}
    held = sum(each.nbytes() for each in storages.values())
    batch = np.arange(min(UNEVEN * -(-bricks // 8), bricks))
    with Made() as made:
        engine.train(batch)
    assert held < needed
    # Much of what a step makes is freed before its end.
    assert 0.5 * (held + made.bytes) < needed < held + 2 * TIMES * made.bytes


LAUNCHES = {1: 130, 2: 136}
"""Kernels that a step may launch, by hidden layers: 124 and 130, and for a feature two more."""
SHAPES = [
    pytest.param((3, 7, 10, 20), {}, 0.3, id="plain"),
    pytest.param(
        (1, 17, 16, 16),
        {"embedding_size": 1, "hidden_layers": 0, "fold": 3},
        0.3,
        id="one key frame, linear readout",
    ),
    pytest.param((2, 5, 1, 1), {}, 0.3, id="a column"),
    pytest.param((3, 30, 40, 50), {}, 0.9997, id="a few vertices far apart"),
    pytest.param(
        (3, 1, 33, 2), {"embedding_size": 3, "hidden_layers": 2}, 0.0, id="thin axes, all vertices"
    ),
]


@pytest.mark.parametrize(("shape", "settings", "low"), SHAPES)
def test_an_engine_trains_on_the_device_as_on_the_cpu(
    noise_coreset: Callable[..., Coreset],
    trained: Callable[..., Any],
    shape: tuple[int, ...],
    settings: dict[str, Any],
    low: float,
) -> None:
    coreset = noise_coreset(shape, low)
    here = trained(coreset, settings, "slab", "cpu")
    with pretended_cuda() as pretended:
        there = trained(coreset, settings, "slab", "cuda")
    assert pretended.counts["launches"] > 0
    assert there["error"] == pytest.approx(here["error"], rel=1e-3, abs=1e-6)
    # By count: near a kink of a ReLU float32 may take the other side.
    apart = np.abs(there["values"] - here["values"])
    assert np.mean(apart > 1e-4) < 0.02
    for part in ("fine", "coarse", "network"):
        assert there[part].shape == here[part].shape
        assert np.isfinite(there[part]).all()


def box_of_isabel(feature: Feature) -> Coreset:
    """The coreset of four key frames of a smooth series of isabel's shape."""
    t, z, y, x = np.meshgrid(
        *(np.linspace(0, 1, n, dtype=np.float32) for n in (4, 25, 125, 125)),
        indexing="ij",
        sparse=True,
    )
    series = ArraySeries(np.sin(5 * x + 3 * t) * np.cos(4 * y) + z)
    return build_coreset(series, scan(series, silent), FeatureChoice(range(4), [feature]), silent)


@pytest.mark.parametrize("feature", [Everything(), Interval(1.1, 1.5)], ids=["all", "a feature"])
def test_a_step_launches_little_waits_for_nothing_and_copies_once(feature: Feature) -> None:
    coreset = box_of_isabel(feature)
    batches = np.array_split(np.random.default_rng(0).permutation(len(coreset.bricks)), 8)
    for hidden_layers, launches in LAUNCHES.items():
        architecture = Architecture.for_box(
            coreset.box.shape, 4, width=64, embedding_size=2, fold=2, hidden_layers=hidden_layers
        )
        assert len(architecture.levels) == 7
        with pretended_cuda() as pretended:
            engine = make_engine(
                "slab",
                architecture,
                coreset,
                np.full(9, 0.01),
                seed=1,
                device=torch.device("cuda"),
            )
            for batch in batches[:2]:
                pretended.forget()
                engine.train(batch[:64])
            assert 0 < pretended.counts["launches"] <= launches
            assert_one_message(pretended)
            pretended.forget()
            engine.infer(batches[2][:64])
            assert 0 < pretended.counts["launches"] <= 72
            assert_one_message(pretended)


def assert_one_message(pretended: Pretended) -> None:
    """One copy to the device from pinned memory, and no wait."""
    assert not pretended.waits
    assert (pretended.counts["copies"], pretended.counts["pageable"]) == (1, 0)


def steps(coreset: Coreset, batches: list[Any]) -> dict[str, Any]:
    """The state after training on batches at a rate that changes, and the errors."""
    architecture = Architecture.for_box(coreset.box.shape, len(coreset.key_frames), width=16)
    rates = np.linspace(0.02, 0.001, len(batches) + 1)
    engine = make_engine("slab", architecture, coreset, rates, seed=3, device=torch.device("cuda"))
    errors = [engine.train(batch) for batch in batches]
    return {**engine.state(), "errors": np.array([float(error) for error in errors])}


@pytest.mark.parametrize("low", [0.0, 0.8])
def test_captured_steps_are_the_steps_kernel_by_kernel(
    noise_coreset: Callable[..., Coreset], monkeypatch: pytest.MonkeyPatch, low: float
) -> None:
    coreset, random = noise_coreset((3, 9, 20, 35), low), np.random.default_rng(2)
    bricks = len(coreset.bricks)
    # The same few batches again and again: a graph of sparse bricks is for one number of samples.
    few = [random.permutation(bricks)[:count] for count in (5, 5, 4, 5)]
    batches = [few[number] for number in random.integers(0, 4, 16)]
    with pretended_cuda():
        captured = steps(coreset, batches)
        monkeypatch.setattr("fhash_codec.paper.engines.slab.MAX_GRAPHS", 0)
        plain = steps(coreset, batches)
    for name, array in plain.items():
        np.testing.assert_array_equal(captured[name], array, err_msg=name)
