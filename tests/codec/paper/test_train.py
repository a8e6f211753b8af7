"""Training: batches, rates, rounds, checkpoints, devices, and what ends one."""

from __future__ import annotations

from dataclasses import replace
from math import log10
from pathlib import Path

import numpy as np
import pytest

import fhash_codec
from fhash_codec.boxes import Box
from fhash_codec.config import EncodeConfig
from fhash_codec.features import occupancy
from fhash_codec.features.bricks import Coreset, build_coreset, with_steps_between
from fhash_codec.features.features import Everything, FeatureChoice, Interval
from fhash_codec.features.key_frames import KeyTimes
from fhash_codec.features.scan import scan
from fhash_codec.paper.engines import make_engine
from fhash_codec.paper.fit import (
    LEARNED,
    MAX_DOUBLINGS,
    MIN_STEPS,
    Goal,
    Round,
    decide,
    extended,
    train_model,
)
from fhash_codec.paper.network import Architecture
from fhash_codec.paper.storage import Bricks
from fhash_codec.paper.train import (
    LOWER,
    MAX_RESTARTS,
    Breaks,
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
from fhash_formats.errors import FhashWarning, InputError, TrainingError
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

    breaks = Breaks(stop=stop, save=lambda c: save_checkpoint(path, engine.state(), c))
    assert not train(engine, plan, coreset, reached, breaks, ask)
    state, later = load_checkpoint(path)
    _, resumed = setup(coreset)
    resumed.restore(state)
    assert train(resumed, plan, coreset, later)
    for name, array in whole.state().items():
        np.testing.assert_array_equal(array, resumed.state()[name], err_msg=name)
    assert len(later.history) == 4


def test_a_checkpoint_belongs_to_its_coreset_and_settings(coreset, other_coreset, tmp_path) -> None:
    output = tmp_path / "run.fhz"
    one = checkpoint_path(output, coreset, EncodeConfig(preset="published", tables="float16"))
    assert one.parent == tmp_path
    assert one == checkpoint_path(
        output,
        coreset,
        EncodeConfig(preset="published", psnr=50.0, tables="float32", timings=False),
    )
    assert one == checkpoint_path(
        output, coreset, EncodeConfig(preset="published", tables="float16", device="cpu")
    )
    other_bits = EncodeConfig(preset="published", tables="float16", deterministic=True)
    assert one != checkpoint_path(output, coreset, other_bits)
    assert one != checkpoint_path(
        output, coreset, EncodeConfig(preset="published", tables="float16", epochs=3)
    )
    assert one != checkpoint_path(
        output, other_coreset, EncodeConfig(preset="published", tables="float16")
    )


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

    def infer(self, chosen: np.ndarray) -> np.ndarray:
        values = [
            self.frames[key][
                tuple(slice(i * n, (i + 1) * n) for i, n in zip(place, self.shape, strict=True))
            ].ravel()
            for key, *place in self.bricks[chosen].tolist()
        ]
        return np.array(values)[self.samples[chosen]]


def built(field: np.ndarray, feature: object, fringe: bool) -> Coreset:
    series = ArraySeries(field)
    keys = range(len(field))
    return build_coreset(
        series, scan(series, silent), FeatureChoice(keys, [feature]), silent, fringe=fringe
    )


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
    engine.flat[:] = float("nan")
    with pytest.raises(TrainingError, match="diverged"):
        train(engine, plan, coreset, TrainingProgress())


@pytest.mark.parametrize("hidden_layers", [0, 1, 2])
def test_an_error_of_more_than_twice_the_range_is_seen_at_its_batch(coreset, hidden_layers) -> None:
    plan = plan_training(coreset, epochs=4, learning_rate=1.0, schedule="constant", batch=0, seed=5)
    architecture = Architecture.for_box(coreset.box.shape, 3, width=64, hidden_layers=hidden_layers)
    engine = make_engine(architecture, coreset, plan.rates, seed=5, device="cpu")
    reached = TrainingProgress()
    with pytest.raises(Diverged, match="training diverged in epoch 1: the error reached"):
        train(engine, plan, coreset, reached)
    assert reached.epoch == 0
    assert engine.step < plan.batches


@pytest.mark.parametrize(("rate", "says"), [(0.02, "mean"), (0.01, "mean"), (0.02, "zero")])
def test_a_network_that_died_of_its_rate_is_no_result(setup, coreset, rate, says) -> None:
    plan, engine = setup(coreset, learning_rate=rate)
    engine.rates = np.zeros_like(plan.rates)  # it learns nothing
    engine.flat[-17:] = 0.0  # the last layer: 16 weights and a bias
    engine.flat[-1] = float(coreset.values.mean()) if says == "mean" else 0.0
    if rate > 0.01 and says == "mean":
        with pytest.raises(Diverged, match="ended in a constant"):
            train(engine, plan, coreset, TrainingProgress())
    else:  # A lower rate than the usual one would not help, nor does it with a model still moving.
        assert train(engine, plan, coreset, TrainingProgress())


CONFIG = EncodeConfig(preset="published", tables="float16", epochs=1, width=8, batch=20_000)


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


def test_a_model_that_kernels_for_cuda_cannot_do_is_refused_there(
    coreset, architecture, tmp_path
) -> None:
    """Without torch, too; the CPU does it."""
    large, config = replace(architecture, embedding_size=30), replace(CONFIG, device="cuda")
    with pytest.raises(InputError, match=r"'cuda', but the network has 180 inputs, .*; use --"):
        train_model(coreset, large, config, tmp_path / "a.fhz")


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
    # Earlier, where the training has come far since its first epoch.
    assert decide(GOAL, psnr, 80, 1, 4.0, [first, last], psnr - LEARNED).round is not None
    early = decide(GOAL, psnr, 80, 1, 4.0, [first, last], psnr - LEARNED - 0.1)
    assert (early.round is not None) == goes_on
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


def test_a_training_goes_on_to_its_goal_but_for_epochs_asked_for(
    coreset, tmp_path, monkeypatch
) -> None:
    config = EncodeConfig(preset="published", tables="float16", epochs=5, width=16)
    architecture = Architecture.for_box(coreset.box.shape, 3, width=16)
    first = train_model(coreset, architecture, config, tmp_path / "a.fhz")
    goal = Goal(psnr=300.0, promised=300.0, seconds=1e6)
    exactly = train_model(coreset, architecture, config, tmp_path / "a.fhz", goal=goal)
    assert exactly.epochs == 5
    config = replace(config, epochs=0)
    for module in ("train", "fit"):
        monkeypatch.setattr(f"fhash_codec.paper.{module}.usual_epochs", lambda _: 5)
    psnr = first.history[-1]["psnr"]
    assert psnr is not None
    goal = Goal(psnr=psnr + 2.0, promised=psnr + 1.5, seconds=1e6)
    trained = train_model(coreset, architecture, config, tmp_path / "a.fhz", goal=goal)
    reached = trained.history[-1]["psnr"]
    assert reached is not None
    assert reached > goal.psnr - 0.01
    assert trained.epochs in (10, 20, 40, 80)
    # The first epochs are those of the training without a goal.
    assert trained.history[4]["psnr"] == pytest.approx(psnr, abs=0.01)
    assert [point["epoch"] for point in trained.history] == list(range(1, trained.epochs + 1))


def between() -> tuple[np.ndarray, Coreset, Coreset]:
    """Noise with gaps, 6 steps of uneven times; its coreset at steps 0, 2 and 5, and with all."""
    noise = np.random.default_rng(2).random((6, 5, 9, 11)).astype(np.float32)
    noise[3, :, 4] = np.nan
    series = ArraySeries(noise)
    scanned = scan(series, silent)
    choice = FeatureChoice((0, 2, 5), [Interval(0.6, 1.0)])
    coreset = build_coreset(series, scanned, choice, silent, fringe=True)
    times = KeyTimes(times=np.array([0.0, 1.0, 4.0, 5.0, 6.0, 10.0]), key_frames=(0, 2, 5))
    return noise, coreset, with_steps_between(coreset, series, scanned.value_range, times, silent)


def test_samples_between_key_frames_are_what_a_reader_decodes_there() -> None:
    noise, coreset, samples = between()
    np.testing.assert_allclose(samples.key_places, [0, 1, 2, 0.25, 1 + 1 / 6, 1 + 2 / 6])
    assert samples.lattice is coreset
    feature = noise[[0, 2, 5]] >= 0.6
    found = Bricks(samples)
    for number, (step, key) in enumerate(((1, 0), (3, 1), (4, 1)), 3):
        box = samples.box
        inside = Box.of([(0, n) for n in box.shape])
        expected = (feature[key] | feature[key + 1]) & np.isfinite(noise[step])
        np.testing.assert_array_equal(found.mask(number, inside), expected[box.slices()])
        span = np.nanmax(noise) - np.nanmin(noise)
        unit = (noise[step] - np.nanmin(noise)) / span
        read = found.samples(number, inside)[expected[box.slices()]]
        np.testing.assert_allclose(read, unit[expected], atol=1e-6)
    # Those of the key frames come first, as they were.
    assert np.array_equal(samples.values[: len(coreset.values)], coreset.values)
    assert samples.fringe is not None
    assert not samples.fringe[len(coreset.values) :].any()


def test_a_series_of_key_frames_alone_has_no_other_samples(coreset: Coreset) -> None:
    series = ArraySeries(np.zeros((3, 4, 4, 4), np.float32))
    times = KeyTimes(times=np.arange(3.0), key_frames=coreset.key_frames)
    value_range = scan(series, silent).value_range
    assert with_steps_between(coreset, series, value_range, times, silent) is coreset


@pytest.mark.parametrize("tables", ["float16", "transform"])
def test_training_on_all_steps_is_better_between_key_frames(tmp_path: Path, tables: str) -> None:
    t, z, y, x = np.meshgrid(*(np.arange(n) for n in (7, 6, 12, 20)), indexing="ij")
    front = np.tanh(x - 5 - 1.5 * t + np.sin(y / 2) + z / 3).astype(np.float32)
    found = {}
    for samples in ("keys", "all"):
        config = EncodeConfig(
            preset="published",
            key_frames="every:3",
            samples=samples,
            tables=tables,
            features=("interval:-0.9:0.9",),
            epochs=60,
        )
        found[samples] = fhash_codec.encode(front, tmp_path / f"{samples}.fhz", config)
    keys, all_ = (found[name]["quality"]["between"] for name in ("keys", "all"))
    assert all_["psnr"] > keys["psnr"] + 3
    assert all_["psnr"] > all_["psnr_linear"] + 3
    assert found["all"]["bytes"] < 1.1 * found["keys"]["bytes"]
