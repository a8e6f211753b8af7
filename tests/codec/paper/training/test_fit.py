"""Fitting a model: restarts at a lower rate, and checkpoints of another model."""

from __future__ import annotations

from math import prod

import numpy as np
import pytest
import torch

from fhash_codec.config import EncodeConfig
from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.engines import make_engine
from fhash_codec.paper.training.checkpoint import checkpoint_path, save_checkpoint
from fhash_codec.paper.training.fit import train_model
from fhash_codec.paper.training.train import LOWER, MAX_RESTARTS, TrainingProgress
from fhash_formats.errors import FhashWarning, InputError, TrainingError

CONFIG = EncodeConfig(profile="paper", epochs=1, width=8, batch=20_000)


@pytest.fixture
def architecture(coreset) -> Architecture:
    return Architecture.for_box(coreset.box.shape, 3, width=8)


def test_a_model_is_numbers_of_every_level_and_layer(coreset, architecture, tmp_path) -> None:
    trained = train_model(coreset, architecture, CONFIG, tmp_path / "a.fhz")
    assert trained.fine.shape == (2, len(coreset.values))
    assert [table.shape for table in trained.tables] == [
        (prod(level), 2) for level in architecture.levels[1:]
    ]
    assert [weight.shape for weight, _ in trained.layers] == architecture.layer_shapes
    assert [point["epoch"] for point in trained.history] == [1]
    assert (trained.epochs, trained.restarts, trained.device) == (1, 0, "cpu")
    assert trained.learning_rate == CONFIG.learning_rate
    assert not list(tmp_path.iterdir())


def test_a_training_that_diverges_at_every_rate_is_an_error(
    coreset, architecture, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr("fhash_codec.paper.training.train.DIVERGED", 0.0)
    lowest = CONFIG.learning_rate * LOWER**MAX_RESTARTS
    with (
        pytest.warns(FhashWarning, match="begins again at a learning rate of") as told,
        pytest.raises(TrainingError, match=f"even at a learning rate of {lowest:.3g}"),
    ):
        train_model(coreset, architecture, CONFIG, tmp_path / "a.fhz")
    assert len(told) == MAX_RESTARTS


def test_a_checkpoint_of_another_model_is_refused(coreset, architecture, tmp_path) -> None:
    path = checkpoint_path(tmp_path / "a.fhz", coreset, CONFIG)
    save_checkpoint(path, {"step": np.array(3)}, TrainingProgress(epoch=0, batch=1))
    with pytest.raises(InputError, match="does not fit; delete it to train from the start"):
        train_model(coreset, architecture, CONFIG, tmp_path / "a.fhz")


def test_a_checkpoint_of_whole_bricks_is_refused(coreset, architecture, tmp_path) -> None:
    """The finest embeddings were once stored for all vertices of the bricks."""
    device = torch.device("cpu")
    engine = make_engine("auto", architecture, coreset, np.zeros(2), seed=0, device=device)
    whole = np.zeros((len(coreset.bricks), 2, prod(coreset.brick_shape)), np.float32)
    state = engine.state() | dict.fromkeys(("fine", "fine_mean", "fine_square"), whole)
    path = checkpoint_path(tmp_path / "a.fhz", coreset, CONFIG)
    save_checkpoint(path, state, TrainingProgress(epoch=0, batch=1))
    with pytest.raises(InputError, match="does not fit; delete it to train from the start"):
        train_model(coreset, architecture, CONFIG, tmp_path / "a.fhz")
