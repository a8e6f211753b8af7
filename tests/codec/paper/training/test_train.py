"""Checkpoints: stopping and going on changes nothing, and each belongs to one training."""

from __future__ import annotations

from dataclasses import replace
from math import log10

import numpy as np
import pytest
import torch

from fhash_codec.config import EncodeConfig
from fhash_codec.features import occupancy
from fhash_codec.features.bricks import Coreset, build_coreset
from fhash_codec.features.features import Everything, Interval
from fhash_codec.features.scan import scan
from fhash_codec.paper.engines import make_engine
from fhash_codec.paper.network import Architecture
from fhash_codec.paper.train import (
    Diverged,
    Probe,
    TrainingProgress,
    checkpoint_path,
    load_checkpoint,
    plan_training,
    save_checkpoint,
    train,
)
from fhash_codec.progress import silent
from fhash_formats.errors import InputError, TrainingError
from fhash_formats.series import ArraySeries
from fhash_formats.support.files import StopRequest


@pytest.mark.parametrize("moment", [1, 7, 20, 33])
def test_going_on_from_a_checkpoint_ends_at_the_same_bits(setup, coreset, tmp_path, moment) -> None:
    plan, whole = setup(coreset)
    train(whole, plan, coreset, TrainingProgress())

    _, engine = setup(coreset)
    stop, reached, path = StopRequest(), TrainingProgress(), tmp_path / "run.checkpoint"

    def ask(stage, done, total, note):
        stop.asked = done >= moment

    assert not train(
        engine,
        plan,
        coreset,
        reached,
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


def test_a_checkpoint_belongs_to_its_coreset_and_settings(coreset, other_coreset, tmp_path) -> None:
    output = tmp_path / "run.fhz"
    one = checkpoint_path(output, coreset, EncodeConfig(profile="paper"))
    assert one.parent == tmp_path
    assert one == checkpoint_path(
        output, coreset, EncodeConfig(profile="paper", psnr=50.0, tables="float32", timings=False)
    )
    assert one == checkpoint_path(output, coreset, EncodeConfig(profile="paper", device="cpu"))
    other_bits = EncodeConfig(profile="paper", deterministic=True)
    assert one != checkpoint_path(output, coreset, other_bits)
    assert one != checkpoint_path(output, coreset, EncodeConfig(profile="paper", epochs=3))
    assert one != checkpoint_path(output, other_coreset, EncodeConfig(profile="paper"))


def test_a_damaged_checkpoint_is_named_not_ignored(tmp_path) -> None:
    path = tmp_path / "run.checkpoint"
    assert load_checkpoint(path) is None
    for damaged in (b"PK\x03\x04 and then nothing", b""):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=r"run\.checkpoint cannot be read"):
            load_checkpoint(path)


SHAPE = (3, 9, 10, 21)


class Engine:
    """An engine whose values at the samples of bricks are given."""

    def __init__(self, coreset: Coreset, frames: np.ndarray) -> None:
        low, size = [span[0] for span in coreset.box], coreset.box.shape
        self.shape, self.bricks = coreset.brick_shape, coreset.bricks
        vertices = int(np.prod(self.shape))
        self.samples = np.unpackbits(coreset.mask_bits, axis=1, count=vertices).view(np.bool_)
        padded = [n * m for n, m in zip(coreset.brick_grid, self.shape, strict=True)]
        self.frames = np.zeros((len(frames), *padded))
        box = tuple(slice(a, a + n) for a, n in zip(low, size, strict=True))
        self.frames[:, : size[0], : size[1], : size[2]] = frames[(slice(None), *box)]

    def infer(self, chosen: np.ndarray) -> torch.Tensor:
        values = [
            self.frames[key][
                tuple(slice(i * n, (i + 1) * n) for i, n in zip(place, self.shape, strict=True))
            ].ravel()
            for key, *place in self.bricks[chosen].tolist()
        ]
        return torch.from_numpy(np.array(values)[self.samples[chosen]])


def built(field: np.ndarray, feature: object, fringe: bool) -> Coreset:
    series = ArraySeries(field)
    keys = range(len(field))
    return build_coreset(series, scan(series, silent), keys, [feature], 0, silent, fringe=fringe)


@pytest.fixture(scope="module")
def field() -> np.ndarray:
    values = np.random.default_rng(1).random(SHAPE, dtype=np.float32)
    values[0, 0, 0, :2] = (0.0, 1.0)
    return values


def test_the_fringe_does_not_count(field) -> None:
    coreset = built(field, Interval(0.8, 1.0), fringe=True)
    assert len(coreset.values) > 1.5 * sum(
        occupancy.unpack(bits, coreset.box.shape).sum() for bits in coreset.occupancy
    )
    wrong = np.where(field >= np.float32(0.8), field + np.float32(0.0), 1.0 - field)
    assert Probe(coreset).psnr(Engine(coreset, wrong)) is None
    wrong = np.where(field >= np.float32(0.8), field - np.float32(0.25), field)
    found = Probe(coreset).psnr(Engine(coreset, wrong))
    assert found == pytest.approx(-20 * log10(0.25), abs=1e-5)


def test_values_are_clipped_to_their_range_as_a_reader_does(field) -> None:
    coreset = built(field, Everything(), fringe=False)
    beyond = np.where(field > 0.5, 7.0, field.astype(np.float64))
    error = np.square(1 - field[field > 0.5], dtype=np.float64).sum() / field.size
    assert Probe(coreset).psnr(Engine(coreset, beyond)) == pytest.approx(-10 * log10(error))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_not_finite_ends_the_training(field, value) -> None:
    coreset = built(field, Everything(), fringe=False)
    broken = field.astype(np.float64)
    broken[1, 4, 4, 4] = value
    with pytest.raises(Diverged, match="no longer finite"):
        Probe(coreset).psnr(Engine(coreset, broken))


def test_every_epoch_visits_every_brick_once_in_an_order_of_its_own(setup, coreset) -> None:
    plan, _ = setup(coreset)
    orders = [np.concatenate(plan.order(epoch)) for epoch in range(4)]
    for order in orders:
        assert sorted(order) == list(range(plan.bricks))
    assert not np.array_equal(orders[0], orders[1])
    np.testing.assert_array_equal(orders[2], np.concatenate(setup(coreset)[0].order(2)))


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


@pytest.mark.parametrize(("batch", "epochs"), [(0, 50), (1, 20), (2**20, 1000)])
def test_epochs_that_suit_the_data(setup, coreset, batch, epochs) -> None:
    assert setup(coreset, epochs=0, batch=batch)[0].epochs == epochs


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
