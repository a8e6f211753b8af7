"""The slab engine trains what the naive one in float64 does; its columns, graphs and memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from engine_checks import assert_gradient_of_autograd, assert_near
from pretended_cuda import CUDA, pretended_cuda
from readable_paper import NaiveEngine
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten

from fhash_codec.features.bricks import Coreset
from fhash_codec.paper.engines import slab
from fhash_codec.paper.engines.parameters import CatchUp
from fhash_codec.paper.engines.slab import (
    LIBRARIES,
    SCALARS,
    TIMES,
    UNEVEN,
    WARM_UPS,
    Sender,
    Sent,
    SlabEngine,
    StepGraphs,
    columns_of,
    needed_bytes,
)
from fhash_codec.paper.network import Architecture
from fhash_formats.errors import FhashWarning

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


def test_columns_find_the_samples_of_their_bricks(noise_coreset, in_coreset) -> None:
    coreset = noise_coreset((2, 9, 10, 20), 0.7)
    chosen = np.array([3, 0, 5])
    mask, samples = in_coreset(coreset)[chosen], len(coreset.values)
    bits, offsets = torch.from_numpy(mask.astype(np.uint8)), torch.from_numpy(coreset.offsets)
    places = coreset.places(chosen)
    alone = columns_of(bits, offsets[chosen], samples, len(places))
    np.testing.assert_array_equal(alone.ranks, places)
    np.testing.assert_array_equal(alone.vertices, np.flatnonzero(mask))
    assert (alone.bricks, alone.in_coreset) == (3, None)
    every = columns_of(bits, offsets[chosen], samples, None)
    np.testing.assert_array_equal(every.ranks[mask.reshape(-1)], places)
    assert (every.ranks[~mask.reshape(-1)] == samples).all()
    np.testing.assert_array_equal(every.in_coreset, mask.reshape(-1))
    assert (every.bricks, every.vertices) == (3, None)


def test_each_shape_is_captured_after_its_first_steps_and_results_stay() -> None:
    with pretended_cuda():
        steps, calls = StepGraphs(), []
        total = torch.zeros(2, device="cuda")
        amount = torch.ones(2, device="cuda")

        def step(shape: int) -> torch.Tensor:
            calls.append(shape)
            return total.add_(amount * shape) * 1

        results = []
        for turn in range(6):
            amount.fill_(float(turn))
            results += [steps.run(shape, lambda shape=shape: step(shape)) for shape in (1, 10)]
        # 0, 11 * 1, 11 * 2 ... in all; a result is not overwritten by later steps.
        assert [float(result[0]) for result in results[1::2]] == [0, 11, 33, 66, 110, 165]
        assert calls == [1, 10] * (WARM_UPS + 1)


def test_there_are_no_more_graphs_than_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slab, "MAX_GRAPHS", 1)
    with pretended_cuda():
        steps, calls = StepGraphs(), []

        def step(shape: int) -> torch.Tensor:
            calls.append(shape)
            return torch.zeros(1, device="cuda")

        for _ in range(5):
            for shape in (1, 2):
                steps.run(shape, lambda shape=shape: step(shape))
    assert (calls.count(1), calls.count(2)) == (WARM_UPS + 1, 5)


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


def sent(sender: Sender, count: int) -> tuple[Sent, list[np.ndarray]]:
    """Numbers that are sent, and the same as arrays of numpy."""
    random = np.random.default_rng(count)
    chosen = random.permutation(2**40)[:count] if count < 0 else random.integers(0, 2**40, count)
    columns = [random.random(count, dtype=np.float32) for _ in CatchUp._fields]
    scalars = [float(np.float32(number)) for number in random.random(SCALARS)]
    expected = [chosen, *columns, *map(np.float32, scalars)]
    return sender.send(chosen, CatchUp(*columns), tuple(scalars)), expected  # type: ignore[arg-type]


def received(numbers: Sent) -> list[np.ndarray]:
    columns = numbers.caught_up.cpu().numpy()
    assert columns.shape == (4, len(numbers.ids))
    scalars = (numbers.correction, numbers.pace, numbers.scale)
    return [
        numbers.ids.cpu().numpy(),
        *columns,
        *(scalar.cpu().numpy() for scalar in scalars),
    ]


@pytest.mark.parametrize("count", [1, 3, 64])
def test_numbers_arrive_as_they_were(count: int) -> None:
    numbers, expected = sent(Sender(torch.device("cpu")), count)
    for got, wanted in zip(received(numbers), expected, strict=True):
        np.testing.assert_array_equal(got, wanted)


def test_on_a_device_they_come_to_the_same_place_for_each_size() -> None:
    with pretended_cuda() as pretended:
        sender = Sender(torch.device("cuda"))
        first, _ = sent(sender, 5)
        other, expected_of_other = sent(sender, 7)
        pretended.forget()
        again, expected = sent(sender, 5)
        assert dict(pretended.counts) == {"launches": 1, "copies": 1, "pageable": 0}
        assert first.ids.device == again.pace.device == CUDA
        assert first.ids.data_ptr() == again.ids.data_ptr() != other.ids.data_ptr()
        for numbers, wanted in ((again, expected), (other, expected_of_other)):
            for got, right in zip(received(numbers), wanted, strict=True):
                np.testing.assert_array_equal(got, right)


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


def test_more_of_anything_needs_more(noise_coreset: Callable[..., Coreset]) -> None:
    def needed(shape: tuple[int, ...], batches: int = 8, **settings: int) -> int:
        coreset = noise_coreset(shape, 0.0)
        architecture = Architecture.for_box(coreset.box.shape, shape[0], **settings)
        return needed_bytes(architecture, coreset, batches)

    usual = needed((2, 20, 30, 40))
    assert usual > LIBRARIES
    assert needed((4, 20, 30, 40)) > usual
    assert needed((2, 20, 30, 40), width=128) > usual
    assert needed((2, 20, 30, 40), embedding_size=4) > usual
    assert needed((2, 20, 30, 40), batches=2) > usual
