"""Engines on a pretended CUDA device: every operand is on it, and a step launches little.

Tensors of torch's worker threads are not seen; the engines start no threads of their own.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from pretended_cuda import Pretended, pretended_cuda

from fhash_codec.features.bricks import Coreset, build_coreset
from fhash_codec.features.features import Everything, Feature, Interval
from fhash_codec.features.scan import scan
from fhash_codec.paper.engines import make_engine
from fhash_codec.paper.network import Architecture
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries

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
    return build_coreset(series, scan(series, silent), range(4), [feature], 0, silent)


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
