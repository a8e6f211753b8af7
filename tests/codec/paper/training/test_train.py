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
    batch_ends,
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


def test_tables_that_change_the_sizes_of_the_model_have_a_checkpoint_of_their_own(
    coreset, tmp_path
) -> None:
    def path(**settings):
        return checkpoint_path(tmp_path, coreset, EncodeConfig(profile="paper", **settings))

    published = {"fold": 2, "embedding_size": 2, "width": 64}
    assert path() == path(tables="uint8") == path(**published)
    assert path() == path(tables="transform", **published)
    for setting in published:
        assert path() != path(tables="transform", **(published | {setting: 0}))


def test_engines_that_go_on_from_each_other_share_a_checkpoint(coreset, tmp_path) -> None:
    def path(engine):
        return checkpoint_path(tmp_path, coreset, EncodeConfig(profile="paper", engine=engine))

    assert path("auto") == path("native") == path("slab")


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


def test_a_choice_of_bricks_has_some_of_the_coreset_in_each(field) -> None:
    # Only the last key frame holds the feature: the bricks of the first have neither.
    late = field * np.float32(0.5)
    late[2] = field[2]
    coreset = built(late, Interval(0.9, 1.0), fringe=True)
    assert set(coreset.bricks[:, 0]) == {1, 2}
    for limit in (None, 3, 1):
        probe = Probe(coreset, limit, seed=4)
        assert set(coreset.bricks[probe.bricks, 0]) == {2}
        assert len(probe.bricks) == (limit or np.count_nonzero(coreset.bricks[:, 0] == 2))
    assert Probe(coreset).samples == np.count_nonzero(late >= np.float32(0.9))


def test_the_error_of_a_constant_is_that_of_the_mean_of_all_samples(field) -> None:
    coreset = built(field, Interval(0.8, 1.0), fringe=True)
    values = field[field >= np.float32(0.8)].astype(np.float64)
    mean = coreset.values.mean(dtype=np.float64)
    assert Probe(coreset).error_of_constant() == pytest.approx(np.square(values - mean).mean())
    plain = built(field, Interval(0.8, 1.0), fringe=False)
    assert Probe(plain).error_of_constant() == pytest.approx(values.var())


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
