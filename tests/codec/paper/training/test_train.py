"""The training loop: its plan, its history, and that stopping and going on changes nothing."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fhash_codec.config import EncodeConfig
from fhash_codec.coreset.bricks import build_coreset
from fhash_codec.coreset.features import Everything
from fhash_codec.coreset.scan import scan
from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.engines import make_engine
from fhash_codec.paper.training.checkpoint import checkpoint_path, load_checkpoint, save_checkpoint
from fhash_codec.paper.training.train import Diverged, TrainingProgress, plan_training, train
from fhash_codec.progress import silent
from fhash_formats.errors import InputError, TrainingError
from fhash_formats.series import ArraySeries
from fhash_formats.support.interrupts import StopRequest


def smooth(shape=(3, 12, 20, 36)) -> np.ndarray:
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij")
    return (np.sin(5 * x + 3 * t) * np.cos(4 * y) + z).astype(np.float32)


@pytest.fixture(scope="module")
def coreset():
    series = ArraySeries(smooth())
    return build_coreset(series, scan(series, silent), range(3), [Everything()], 0, silent)


def setup(coreset, epochs=4, **settings):
    plan = plan_training(
        coreset,
        **{"epochs": epochs, "learning_rate": 0.01, "schedule": "cosine", "batch": 0, "seed": 5}
        | settings,
    )
    architecture = Architecture.for_box(coreset.box.shape, 3, width=16)
    return plan, make_engine(
        "slab", architecture, coreset, plan.rates, seed=5, device=torch.device("cpu")
    )


def test_every_epoch_visits_every_brick_once_in_an_order_of_its_own(coreset):
    plan, _ = setup(coreset)
    orders = [np.concatenate(plan.order(epoch)) for epoch in range(4)]
    for order in orders:
        assert sorted(order) == list(range(plan.bricks))
    assert not np.array_equal(orders[0], orders[1])
    np.testing.assert_array_equal(orders[2], np.concatenate(setup(coreset)[0].order(2)))


@pytest.mark.parametrize(
    ("batch", "batches"),
    [(0, 20), (2**21, 1), (1008, 27), (5000, 5), (1, 54)],
)
def test_batches_of_an_epoch(coreset, batch, batches):
    assert len(coreset.bricks) == 54  # 3 key frames of 2 x 3 x 3 bricks of 6 x 7 x 12 vertices
    plan, _ = setup(coreset, batch=batch)
    assert plan.batches == min(batches, plan.bricks)
    assert len(plan.rates) == 4 * plan.batches + 1


@pytest.mark.parametrize(("batch", "epochs"), [(0, 50), (1, 20), (2**20, 1000)])
def test_epochs_that_suit_the_data(coreset, batch, epochs):
    assert setup(coreset, epochs=0, batch=batch)[0].epochs == epochs


def test_rates_fall_to_zero_or_stay(coreset):
    cosine, constant = setup(coreset)[0].rates, setup(coreset, schedule="constant")[0].rates
    assert cosine[0] == 0.01
    assert cosine[-1] == pytest.approx(0, abs=1e-12)
    assert (np.diff(cosine) < 0).all()
    assert (constant == 0.01).all()


def test_history_tells_seconds_epoch_and_psnr_that_rises(coreset):
    plan, engine = setup(coreset, epochs=12)
    course = TrainingProgress()
    seen = []
    assert train(engine, plan, coreset, course, progress=lambda *step: seen.append(step))
    assert [point["epoch"] for point in course.history] == list(range(1, 13))
    assert all(
        a["seconds"] < b["seconds"]
        for a, b in zip(course.history, course.history[1:], strict=False)
    )
    assert course.history[-1]["psnr"] > course.history[0]["psnr"] + 5
    assert course.history[-1]["psnr"] > 30
    assert [done for _, done, _, _ in seen] == list(range(1, 12 * plan.batches + 1))


@pytest.mark.parametrize("moment", [1, 7, 20, 33])
def test_going_on_from_a_checkpoint_ends_at_the_same_bits(coreset, tmp_path, moment):
    plan, whole = setup(coreset)
    train(whole, plan, coreset, TrainingProgress())

    _, engine = setup(coreset)
    stop, course, path = StopRequest(), TrainingProgress(), tmp_path / "run.checkpoint"

    def ask(stage, done, total, note):
        stop.asked = done >= moment

    assert not train(
        engine,
        plan,
        coreset,
        course,
        stop=stop,
        save=lambda c: save_checkpoint(path, engine.state(), c),
        progress=ask,
    )
    state, later = load_checkpoint(path)
    _, resumed = setup(coreset)
    resumed.restore(state)
    assert train(resumed, plan, coreset, later)
    for name, array in whole.state().items():
        np.testing.assert_array_equal(array, resumed.state()[name], err_msg=name)
    assert len(later.history) == 4


def test_checkpoints_come_by_the_clock_too(coreset):
    plan, engine = setup(coreset, epochs=2)
    saved = []
    assert train(engine, plan, coreset, TrainingProgress(), save=saved.append, save_seconds=0.0)
    assert saved


def test_a_checkpoint_belongs_to_its_coreset_and_settings(coreset, tmp_path):
    output = tmp_path / "run.fhz"
    one = checkpoint_path(output, coreset, EncodeConfig(profile="paper"))
    assert one.parent == tmp_path
    assert one == checkpoint_path(
        output, coreset, EncodeConfig(profile="paper", psnr=50.0, tables="float32", timings=False)
    )
    assert one != checkpoint_path(output, coreset, EncodeConfig(profile="paper", epochs=3))
    series = ArraySeries(smooth() + 0.5 * smooth() ** 2)
    other = build_coreset(series, scan(series, silent), range(3), [Everything()], 0, silent)
    assert one != checkpoint_path(output, other, EncodeConfig(profile="paper"))


def test_a_damaged_checkpoint_is_named_not_ignored(tmp_path):
    path = tmp_path / "run.checkpoint"
    assert load_checkpoint(path) is None
    for damaged in (b"PK\x03\x04 and then nothing", b""):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=r"run\.checkpoint cannot be read"):
            load_checkpoint(path)


def test_training_that_diverges_is_an_error(coreset):
    plan, engine = setup(coreset)
    engine.flat.fill_(float("nan"))
    with pytest.raises(TrainingError, match="diverged"):
        train(engine, plan, coreset, TrainingProgress())


@pytest.mark.parametrize("hidden_layers", [0, 1, 2])
def test_an_error_of_more_than_twice_the_range_is_seen_at_its_batch(coreset, hidden_layers):
    plan = plan_training(coreset, epochs=4, learning_rate=1.0, schedule="constant", batch=0, seed=5)
    architecture = Architecture.for_box(coreset.box.shape, 3, width=64, hidden_layers=hidden_layers)
    engine = make_engine(
        "slab", architecture, coreset, plan.rates, seed=5, device=torch.device("cpu")
    )
    course = TrainingProgress()
    with pytest.raises(Diverged, match="training diverged in epoch 1: the error reached"):
        train(engine, plan, coreset, course)
    assert course.epoch == 0
    assert engine.step < plan.batches


@pytest.mark.parametrize(("rate", "says"), [(0.02, "mean"), (0.01, "mean"), (0.02, "zero")])
def test_a_network_that_died_of_its_rate_is_no_result(coreset, rate, says):
    plan, engine = setup(coreset, learning_rate=rate)
    engine.rates = np.zeros_like(plan.rates)  # it learns nothing
    engine.layers[-1].zero_()
    engine.layers[-1][0, -1] = float(coreset.values.mean()) if says == "mean" else 0.0
    if rate > 0.01 and says == "mean":
        with pytest.raises(Diverged, match="ended in a constant"):
            train(engine, plan, coreset, TrainingProgress())
    else:  # a lower rate than the usual one would not help, nor does it where the training was too short
        assert train(engine, plan, coreset, TrainingProgress())


def test_a_budget_ends_the_training(coreset):
    plan, engine = setup(coreset, epochs=1000)
    course = TrainingProgress()
    assert not train(engine, plan, coreset, course, budget_seconds=0.2)
    assert course.epoch < 1000
