"""Fitting a model: restarts at a lower rate, and checkpoints of another model."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.config import EncodeConfig
from fhash_codec.paper.fit import (
    MAX_DOUBLINGS,
    MIN_STEPS,
    Goal,
    Round,
    decide,
    extended,
    train_model,
)
from fhash_codec.paper.network import Architecture
from fhash_codec.paper.train import (
    LOWER,
    MAX_RESTARTS,
    TrainingProgress,
    checkpoint_path,
    save_checkpoint,
)
from fhash_formats.errors import FhashWarning, InputError, TrainingError

CONFIG = EncodeConfig(profile="paper", epochs=1, width=8, batch=20_000)


@pytest.fixture
def architecture(coreset) -> Architecture:
    return Architecture.for_box(coreset.box.shape, 3, width=8)


def test_a_training_that_diverges_at_every_rate_is_an_error(
    coreset, architecture, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr("fhash_codec.paper.train.DIVERGED", 0.0)
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


GOAL = Goal(psnr=45.5, promised=45.0, seconds=100.0)


def test_a_round_doubles_the_epochs_and_says_so() -> None:
    decision = decide(GOAL, 44.0, 20, MIN_STEPS, 10.0, [])
    assert decision.round == Round(epochs=20, psnr=44.0, seconds=10.0)
    assert "goes on for 20 epochs: the model has 44.00 dB over the coreset" in decision.message
    assert "45 dB are promised" in decision.message
    again = decide(GOAL, 44.8, 40, MIN_STEPS, 20.0, [decision.round])
    assert again.round == Round(epochs=40, psnr=44.8, seconds=20.0)


@pytest.mark.parametrize(("seconds", "epochs"), [(50.0, 40), (51.0, 38), (70.0, 17), (96.0, 1)])
def test_a_round_fits_into_the_time_that_is_left(seconds, epochs) -> None:
    before = [Round(epochs=20, psnr=40.0, seconds=0.0)]
    decision = decide(GOAL, 44.0, 40, MIN_STEPS, seconds, before)
    assert decision.round == Round(epochs=epochs, psnr=44.0, seconds=seconds)


@pytest.mark.parametrize(("gain", "goes_on"), [(2.01, True), (1.99, False), (-1.0, False)])
def test_a_training_that_hardly_learns_in_two_rounds_ends(gain, goes_on) -> None:
    psnr = 45.5 - MAX_DOUBLINGS
    first = Round(epochs=20, psnr=psnr - gain, seconds=1.0)
    # One round may bring nothing.
    assert decide(GOAL, psnr - gain, 40, MIN_STEPS, 2.0, [first]).round is not None
    last = Round(epochs=40, psnr=psnr, seconds=2.0)
    assert decide(GOAL, psnr, 80, MIN_STEPS - 1, 4.0, [first, last]).round is not None
    decision = decide(GOAL, psnr, 80, MIN_STEPS, 4.0, [first, last])
    assert (decision.round is not None) == goes_on
    if not goes_on:
        assert f"the last 2 rounds brought {gain:.2f} dB" in decision.message


def test_a_round_has_rates_of_its_own(setup, coreset) -> None:
    plan, _ = setup(coreset)
    longer = extended(plan, 3, "cosine")
    assert longer.epochs == plan.epochs + 3
    assert len(longer.rates) == longer.epochs * plan.batches + 1
    np.testing.assert_array_equal(longer.rates[: len(plan.rates)], plan.rates)
    further = longer.rates[len(plan.rates) :]
    assert (np.diff(further) < 0).all()
    assert further[0] < 0.5 * plan.rates[0]
    assert further[-1] == pytest.approx(0, abs=1e-12)
    assert (extended(plan, 3, "constant").rates[len(plan.rates) :] == 0.5 * plan.rates[0]).all()


def test_a_training_goes_on_to_its_goal(coreset, tmp_path) -> None:
    config = EncodeConfig(profile="paper", epochs=5, width=16)
    architecture = Architecture.for_box(coreset.box.shape, 3, width=16)
    first = train_model(coreset, architecture, config, tmp_path / "a.fhz")
    psnr = first.history[-1]["psnr"]
    assert psnr is not None
    goal = Goal(psnr=psnr + 2.0, promised=psnr + 1.5, seconds=1e6)
    with pytest.warns(FhashWarning, match="training goes on"):
        trained = train_model(coreset, architecture, config, tmp_path / "a.fhz", goal=goal)
    reached = trained.history[-1]["psnr"]
    assert reached is not None
    assert reached > goal.psnr - 0.01
    assert trained.epochs in (10, 20, 40, 80)
    # The first epochs are those of the training without a goal.
    assert trained.history[4]["psnr"] == pytest.approx(psnr, abs=0.01)
    assert [point["epoch"] for point in trained.history] == list(range(1, trained.epochs + 1))
