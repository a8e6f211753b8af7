"""Trainings on a pretended CUDA device, from the command's settings to the file."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pretended_cuda import pretended_cuda

import fhash_codec
from fhash_codec.config import EncodeConfig
from fhash_codec.features.bricks import Coreset
from fhash_codec.paper.engines.slab import SlabEngine
from fhash_codec.paper.fit import train_model
from fhash_codec.paper.network import Architecture
from fhash_codec.paper.train import TrainingProgress, checkpoint_path, save_checkpoint
from fhash_formats.errors import FhashWarning, InputError

CONFIG = EncodeConfig(
    profile="paper", epochs=2, width=8, batch=20_000, device="cuda", engine="slab"
)


@pytest.fixture
def architecture(coreset: Coreset) -> Architecture:
    return Architecture.for_box(coreset.box.shape, 3, width=8)


@pytest.fixture
def saved(coreset: Coreset, architecture: Architecture, tmp_path: Path) -> Path:
    """The output of an interrupted training, whose checkpoint is after the first epoch."""
    output, states = tmp_path / "a.fhz", []
    engine_state = SlabEngine.state
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fhash_codec.paper.fit.KEEP_SECONDS", 0.0)
        patch.setattr(
            SlabEngine, "state", lambda self: states.append(engine_state(self)) or states[-1]
        )
        train_model(coreset, architecture, replace(CONFIG, epochs=1, device="cpu"), output)
    for leftover in tmp_path.iterdir():
        leftover.unlink()
    path = checkpoint_path(output, coreset, CONFIG)
    save_checkpoint(path, states[-1], TrainingProgress(epoch=1))
    return output


@pytest.mark.parametrize("tables", ["float16", "transform"])
def test_a_series_is_encoded_on_the_device(tmp_path: Path, tables: str) -> None:
    values = np.add.outer(np.sin(np.linspace(0, 3, 3)), np.random.default_rng(0).random((6, 7, 9)))
    config = replace(CONFIG, epochs=3, batch=0, tables=tables)
    with pretended_cuda() as pretended, warnings.catch_warnings():
        warnings.simplefilter("ignore", FhashWarning)  # of the quality of three epochs
        figures = fhash_codec.encode(values.astype(np.float32), tmp_path / "a.fhz", config)
    assert pretended.counts["launches"] > 100
    assert figures["device"] == "cuda"
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert np.isfinite(volume[:]).any()


def test_a_training_that_diverges_begins_again_on_the_device(
    coreset: Coreset,
    architecture: Architecture,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    limits = iter([0.0, *[1e9] * 100])
    check = fhash_codec.paper.train._Loop.check_errors
    monkeypatch.setattr(
        "fhash_codec.paper.train._Loop.check_errors",
        lambda self: (
            monkeypatch.setattr("fhash_codec.paper.train.DIVERGED", next(limits)),
            check(self),
        ),
    )
    config = replace(CONFIG, epochs=1)
    with pretended_cuda(), pytest.warns(FhashWarning, match="begins again"):
        trained = train_model(coreset, architecture, config, tmp_path / "a.fhz")
    assert (trained.device, trained.restarts) == ("cuda", 1)


@pytest.mark.parametrize("device", ["cuda", "cpu", "auto"])
def test_a_checkpoint_goes_on_on_another_device(
    coreset: Coreset, architecture: Architecture, saved: Path, device: str
) -> None:
    with pretended_cuda():
        trained = train_model(coreset, architecture, replace(CONFIG, device=device), saved)
    assert trained.device == ("cuda" if device == "cuda" else "cpu")
    # The history of the first epoch was not saved: only the second one was trained here.
    assert [point["epoch"] for point in trained.history] == [2]


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (torch.OutOfMemoryError("CUDA out of memory."), "memory of the device cuda ran out"),
        (RuntimeError("CUDA error: device-side assert triggered"), "CUDA error: device-side"),
    ],
)
def test_a_device_that_fails_is_no_fault_of_the_checkpoint(
    coreset: Coreset,
    architecture: Architecture,
    saved: Path,
    monkeypatch: pytest.MonkeyPatch,
    error: Exception,
    said: str,
) -> None:
    def fail(*_: Any) -> None:
        raise error

    monkeypatch.setattr(torch.Tensor, "copy_", fail)
    with pretended_cuda(), pytest.raises((InputError, RuntimeError), match=said) as told:
        train_model(coreset, architecture, CONFIG, saved)
    assert "delete" not in str(told.value)


def test_a_device_without_the_memory_is_refused_before_the_training(
    coreset: Coreset, architecture: Architecture, tmp_path: Path
) -> None:
    with pretended_cuda() as pretended:
        pretended.free = 10 << 20
        with pytest.raises(InputError, match=r"0\.0 GiB are free; use --device cpu"):
            train_model(coreset, architecture, CONFIG, tmp_path / "a.fhz")


@pytest.mark.parametrize(
    ("settings", "asked"),
    [({}, False), ({"deterministic": True}, True), ({"timings": False}, True)],
)
def test_the_same_bits_are_asked_for_while_it_trains(
    coreset: Coreset,
    architecture: Architecture,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    settings: dict[str, bool],
    asked: bool,
) -> None:
    found, step = set(), SlabEngine._step
    monkeypatch.setattr(
        SlabEngine,
        "_step",
        lambda *given: (found.add(torch.are_deterministic_algorithms_enabled()), step(*given))[1],
    )
    with pretended_cuda():
        train_model(coreset, architecture, replace(CONFIG, **settings), tmp_path / "a.fhz")
    assert found == {asked}
    assert not torch.are_deterministic_algorithms_enabled()
