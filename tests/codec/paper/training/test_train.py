"""The training loop: its plan, its history, and the errors of a rate that is too high."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.engines import make_engine
from fhash_codec.paper.training.probe import Diverged
from fhash_codec.paper.training.train import (
    TrainingProgress,
    batch_ends,
    plan_training,
    train,
)
from fhash_formats.errors import TrainingError


def test_every_epoch_visits_every_brick_once_in_an_order_of_its_own(setup, coreset) -> None:
    plan, _ = setup(coreset)
    orders = [np.concatenate(plan.order(epoch)) for epoch in range(4)]
    for order in orders:
        assert sorted(order) == list(range(plan.bricks))
    assert not np.array_equal(orders[0], orders[1])
    np.testing.assert_array_equal(orders[2], np.concatenate(setup(coreset)[0].order(2)))


@pytest.mark.parametrize(
    ("batch", "batches"),
    [(0, 20), (2**21, 1), (1008, 26), (5000, 5), (1, 54)],
)
def test_batches_of_an_epoch(setup, coreset, batch, batches) -> None:
    assert len(coreset.bricks) == 54  # 3 key frames of 2 x 3 x 3 bricks of 6 x 7 x 12 vertices
    assert len(coreset.values) == 25_920  # fewer than 54 whole bricks: the last ones are cut
    plan, _ = setup(coreset, batch=batch)
    assert plan.batches == min(batches, plan.bricks)
    assert len(plan.rates) == 4 * plan.batches + 1


@pytest.mark.parametrize("batch", [500, 1700, 4000])
def test_a_batch_has_as_many_samples_as_asked_however_full_the_bricks(coreset, batch) -> None:
    counts = np.random.default_rng(0).integers(1, 505, 54)
    sparse = replace(coreset, offsets=np.cumsum([0, *counts]))
    plan = plan_training(
        sparse, epochs=1, learning_rate=0.01, schedule="cosine", batch=batch, seed=5
    )
    batches = plan.order(0)
    assert len(batches) == plan.batches == round(counts.sum() / batch)
    assert plan.batch_samples == -(-counts.sum() // plan.batches)
    assert sorted(np.concatenate(batches)) == list(range(54))
    for chosen in batches:
        assert abs(counts[chosen].sum() - counts.sum() / plan.batches) <= 504


@pytest.mark.parametrize(
    "counts", [[1] * 7, [100, 1, 1, 1, 1, 1, 1], [1, 1, 1, 1, 1, 1, 100], [0, 0, 3, 0, 0, 9, 0]]
)
def test_no_batch_is_empty(counts) -> None:
    for batches in range(1, 8):
        cuts = batch_ends(np.array(counts), batches)
        parts = np.split(np.arange(7), cuts)
        assert len(parts) == batches
        assert all(len(part) for part in parts)


@pytest.mark.parametrize(("batch", "epochs"), [(0, 50), (1, 20), (2**20, 1000)])
def test_epochs_that_suit_the_data(setup, coreset, batch, epochs) -> None:
    assert setup(coreset, epochs=0, batch=batch)[0].epochs == epochs


def test_rates_fall_to_zero_or_stay(setup, coreset) -> None:
    cosine, constant = setup(coreset)[0].rates, setup(coreset, schedule="constant")[0].rates
    assert cosine[0] == 0.01
    assert cosine[-1] == pytest.approx(0, abs=1e-12)
    assert (np.diff(cosine) < 0).all()
    assert (constant == 0.01).all()


def test_history_tells_seconds_epoch_and_psnr_that_rises(setup, coreset) -> None:
    plan, engine = setup(coreset, epochs=12)
    reached = TrainingProgress()
    seen = []
    assert train(engine, plan, coreset, reached, progress=lambda *step: seen.append(step))
    assert [point["epoch"] for point in reached.history] == list(range(1, 13))
    assert all(
        a["seconds"] < b["seconds"]
        for a, b in zip(reached.history, reached.history[1:], strict=False)
    )
    assert reached.history[-1]["psnr"] > reached.history[0]["psnr"] + 5
    assert reached.history[-1]["psnr"] > 30
    assert [done for _, done, _, _ in seen] == list(range(1, 12 * plan.batches + 1))


def test_checkpoints_come_by_the_clock_too(setup, coreset) -> None:
    plan, engine = setup(coreset, epochs=2)
    saved = []
    assert train(engine, plan, coreset, TrainingProgress(), save=saved.append, save_seconds=0.0)
    assert saved


def test_training_that_diverges_is_an_error(setup, coreset) -> None:
    plan, engine = setup(coreset)
    engine.flat.fill_(float("nan"))
    with pytest.raises(TrainingError, match="diverged"):
        train(engine, plan, coreset, TrainingProgress())


@pytest.mark.parametrize("hidden_layers", [0, 1, 2])
def test_an_error_of_more_than_twice_the_range_is_seen_at_its_batch(coreset, hidden_layers) -> None:
    plan = plan_training(coreset, epochs=4, learning_rate=1.0, schedule="constant", batch=0, seed=5)
    architecture = Architecture.for_box(coreset.box.shape, 3, width=64, hidden_layers=hidden_layers)
    engine = make_engine(
        "slab", architecture, coreset, plan.rates, seed=5, device=torch.device("cpu")
    )
    reached = TrainingProgress()
    with pytest.raises(Diverged, match="training diverged in epoch 1: the error reached"):
        train(engine, plan, coreset, reached)
    assert reached.epoch == 0
    assert engine.step < plan.batches


@pytest.mark.parametrize(("rate", "says"), [(0.02, "mean"), (0.01, "mean"), (0.02, "zero")])
def test_a_network_that_died_of_its_rate_is_no_result(setup, coreset, rate, says) -> None:
    plan, engine = setup(coreset, learning_rate=rate)
    engine.rates = np.zeros_like(plan.rates)  # it learns nothing
    engine.layers[-1].zero_()
    engine.layers[-1][0, -1] = float(coreset.values.mean()) if says == "mean" else 0.0
    if rate > 0.01 and says == "mean":
        with pytest.raises(Diverged, match="ended in a constant"):
            train(engine, plan, coreset, TrainingProgress())
    else:  # A lower rate than the usual one would not help, nor does it with a model still moving.
        assert train(engine, plan, coreset, TrainingProgress())


def test_a_budget_ends_the_training(setup, coreset) -> None:
    plan, engine = setup(coreset)
    reached = TrainingProgress()
    assert not train(engine, plan, coreset, reached, budget_seconds=0.0)
    assert (reached.epoch, reached.batch, engine.step) == (0, 1, 1)
